"""The comparison of laws: closed forms without Poisson's effect, and the same modulus at rest."""

import numpy as np
import pytest
from typer.testing import CliRunner

from measurements.laws import LAWS, measure, pressure
from vsfsim.cli.main import app

S = 0.6
WITHOUT_POISSONS_EFFECT = {
    "vsfsim": 0.5 * (1.0 / S - S), "neo-Hookean, (ln J)^2": 0.5 * (1.0 / S - S), "small strain": 1.0 - S,
    "St Venant-Kirchhoff": 0.5 * S * (1.0 - S**2), "hyperfoam, alpha 4": 0.25 * (1.0 - S**4) / S,
    "hyperfoam, alpha 8": 0.125 * (1.0 - S**8) / S}
"""Nominal pressure over E at a stretch of 0.6."""


@pytest.mark.parametrize("name", WITHOUT_POISSONS_EFFECT)
def test_a_law_without_poissons_effect(name):
    assert pressure(LAWS[name], 1.0 - S, 0.0) == pytest.approx(WITHOUT_POISSONS_EFFECT[name], rel=1e-9)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("name", LAWS)
def test_all_laws_have_the_same_modulus_at_rest(name, nu):
    # second order in the strain: a few times 1e-5
    assert pressure(LAWS[name], 1e-5, nu) / 1e-5 == pytest.approx(1.0, abs=1e-4)


def test_the_law_before_had_no_equilibrium_where_a_foam_is_pressed():
    assert np.isnan(pressure(LAWS["stable neo-Hookean"], 0.4, 0.0))
    assert pressure(LAWS["stable neo-Hookean"], 0.4, 0.1) / pressure(LAWS["vsfsim"], 0.4, 0.1) < 0.6


def test_the_command_prints_the_table():
    done = CliRunner().invoke(app, ["measure", "laws"])
    assert done.exit_code == 0 and "St Venant-Kirchhoff" in done.output
    assert len(measure().tables[0].rows) == 24
