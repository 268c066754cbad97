"""A bubble dragged and twisted on a soft block: no frame has more friction than Coulomb's law allows."""

import numpy as np
import pytest

from measurements.drag import moved, rows_of
from vsfsim.physics.solve.frames import Reason


@pytest.mark.slow
@pytest.mark.parametrize("move", ["drag", "twist"])
def test_friction_stays_below_coulombs_bound_or_the_frame_is_marked(move):
    solved = moved(move, young=3e4, depth=0.004, frames=2, nodes=100, limit=6.0)
    rows = rows_of(move, solved, 2)
    good = [row for row in rows if row["converged"]]
    assert len(rows) == 3 and good
    # the bound counts vertical forces: where the skin slants by 15 degrees, its normal force is 1 / cos(15) of that
    assert all(float(row["share"]) <= 1.01 and float(row["torque_share"]) <= 1.035 for row in good)
    assert all(np.isnan(float(row["normal"])) for row in rows if not row["converged"])
    assert (solved.frames.converged | (solved.frames.reason != Reason.NONE)).all()
