"""The gate of the solver: its small cells give the recorded frames and forces within a budget of iterations."""

import json
from pathlib import Path

import numpy as np
import pytest

from measurements.gate.cells import CELLS, SMALL, press
from measurements.gate.compare import difference, earlier, measure
from measurements.gate.mechanisms import MECHANISMS
from vsfsim.core.errors import VsfsimError

RECORD = json.loads((Path(__file__).parent / "gate_expected.json").read_text())
"""Of each small cell: push at its last frame [N], Newton iterations and conjugate gradients, made by
`vsfsim measure solver --cell small`."""


def test_cells_have_names_of_their_own():
    assert len({c.name for c in CELLS}) == len(CELLS) == 40
    assert set(SMALL) < {c.name for c in CELLS}


@pytest.mark.parametrize("name", SMALL)
def test_small_cells_converge_to_their_forces_within_their_budget(name):
    run, known = press(next(c for c in CELLS if c.name == name)), RECORD[name]
    assert run.frames == run.asked, run.reasons
    assert np.linalg.norm(run.force[-1]) == pytest.approx(known["push"], rel=2e-3)  # of a released reading
    assert run.newton <= 1.3 * known["newton"] + 2  # another CPU rounds otherwise
    assert run.cg <= 1.3 * known["cg"] + 10


@pytest.mark.slow
def test_a_box_in_four_frames_stays_on_the_branch_that_twelve_frames_follow():
    """A leaner Newton method ended at 15.2 N, balanced and unmarked; twelve frames give 16.137 N."""
    run = press(next(c for c in CELLS if c.name == "box"))
    assert run.frames == 4, run.reasons
    assert np.linalg.norm(run.force[-1]) == pytest.approx(16.137, rel=2e-3)


@pytest.mark.slow  # the predictor itself: tests/physics/solve/test_prediction.py
def test_without_the_predictor_a_cell_takes_more_iterations_to_the_same_force(tmp_path):
    found = measure(["ball"], names=["predictor"])
    row = found.tables[0].rows[0]
    assert row["before"] == row["frames"] == 4
    assert row["difference"] < 5e-3
    assert row["newton_ratio"] > 1.3
    file = tmp_path / "gate.json"
    file.write_text(json.dumps(found.record()))
    assert difference(earlier(file)["ball"], press(next(c for c in CELLS if c.name == "ball"))) < 5e-3


def test_mechanisms_are_there_again_after_they_were_switched_off():
    from measurements.gate.mechanisms import without
    from vsfsim.physics.solve.touches import Solver

    before = Solver._predict
    with without(list(MECHANISMS)):
        assert Solver._predict is not before
    assert Solver._predict is before


def test_a_file_that_is_no_record_is_named(tmp_path):
    file = tmp_path / "other.json"
    file.write_text("{}")
    with pytest.raises(VsfsimError, match=r"other\.json is not a record"):
        earlier(file)
