"""The gate of the solver: its small cells give the recorded frames and forces within a budget of iterations."""

import json
from pathlib import Path

import numpy as np
import pytest
from frame_checks import some_slow

from measurements.gate.cells import CELLS, SMALL, press
from measurements.gate.compare import earlier
from vsfsim.core.errors import VsfsimError

RECORD = json.loads((Path(__file__).parent / "gate_expected.json").read_text())
"""Of each small cell: push at its last frame [N], Newton iterations and conjugate gradients, made by
`vsfsim measure solver --cell small`."""


@pytest.mark.parametrize("name", some_slow(SMALL, "capsule", "one frame", "contrast 1e4", "nu 0.499", "bubble tip"))
def test_small_cells_converge_to_their_forces_within_their_budget(name):
    run, known = press(next(c for c in CELLS if c.name == name)), RECORD[name]
    assert run.frames == run.asked, run.reasons
    assert np.linalg.norm(run.force[-1]) == pytest.approx(known["push"], rel=2e-3)  # of a released reading
    assert run.newton <= 1.3 * known["newton"] + 2  # another CPU rounds otherwise
    assert run.cg <= 1.3 * known["cg"] + 10


def test_a_file_that_is_no_record_is_named(tmp_path):
    file = tmp_path / "other.json"
    file.write_text("{}")
    with pytest.raises(VsfsimError, match=r"other\.json is not a record"):
        earlier(file)
