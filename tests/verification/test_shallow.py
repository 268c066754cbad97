"""Shallow contact: the force of S1's ball at six places within an element, on meshes that do not know where."""

import numpy as np
import pytest

from benchmarks import shallow
from vsfsim.core.shape import Box, Plane, Sphere
from vsfsim.physics.contact.local_indentation import poisson_ratio
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.touches import Solver


def worst(tier, resolution):
    rows, spent = shallow.errors(tier, resolution)
    found = [max(abs(row["least"]), abs(row["most"])) for row in rows]
    print(f"{tier} {resolution}: errors {np.round(found, 3)} at 0.5, 1, 2.5 and 5 mm, {spent:.1f} s of processor")
    assert all(row["converged"] == 1.0 for row in rows)
    return np.array(found)


def test_elements_of_ten_millimetres(monkeypatch):
    """Observed 5.1, 5.9, 1.1 and 1.3 %; 37 to 70 % at 0.5 mm and 37 % at 1 mm without the local indentation. At
    three of the six places, among which are the worst of each depth."""
    monkeypatch.setattr(shallow, "PLACES", shallow.PLACES[[0, 2, 3]])
    assert (worst("fem", 0.010) < [0.10, 0.08, 0.025, 0.025]).all()


@pytest.mark.slow
def test_the_mesh_of_a_press():
    """Observed 3, 1.5, 1.3 and 1 %; 10, 4 and 1 % at the first three without the local indentation."""
    assert (worst("fem", None) < [0.10, 0.05, 0.02, 0.02]).all()


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.49])
def test_poissons_ratio_of_a_model(block, nu):
    assert poisson_ratio(block((0.02, 0.02, 0.02), 0.01, poisson_ratio=nu)) == pytest.approx(nu, abs=1e-6)


def test_only_round_bodies_are_softer(block, line, device):
    """A plane and a box are felt as stiffly as before: their contact is not Hertz's."""
    model = block((0.04, 0.04, 0.03), 0.02)
    for shape, expected in ((Sphere(0.012), True), (Plane(), False), (Box((0.01, 0.01, 0.01)), False)):
        solver = Solver(model, shape, device=device, options=SolverOptions(local_indentation=True))
        contact, _ = solver._make_contact(line([[0.0, 0.0, 0.0295]], shape)[:, :, None])
        contact.move(line([[0.0, 0.0, 0.0295]], shape)[0][:, None])
        softer = contact._local_indentation._share < 1.0
        assert bool(softer.any()) == expected
