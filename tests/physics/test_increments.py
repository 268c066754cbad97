"""The way between poses: nothing slips through, whatever the step."""

import numpy as np
import pytest
from frame_checks import from_above, ticked

from vsfsim.core.shape import Sphere
from vsfsim.core.solid import Solid
from vsfsim.physics.model import build_model
from vsfsim.physics.solve import increments
from vsfsim.physics.solve.frames import Reason, SolverOptions
from vsfsim.physics.solve.touches import Solver


@pytest.mark.parametrize("linear", [False, True])
def test_a_path_that_begins_inside_the_object_is_marked(block, line, device, linear):
    """From which side the ball came there is not known: of two touches the one that begins free has its force."""
    model, probe = block((0.06, 0.06, 0.03), 0.015), Sphere(0.012)
    both = np.concatenate([line([[x, 0.0, 0.04 - z] for z in (0.0, 0.004)], probe) for x in (0.0, 0.01)], axis=1)
    start = from_above(both)
    start[1, :3, 3] = 0.01, 0.0, 0.03
    solver = Solver(model, probe, device=device, linear=linear, options=SolverOptions(tolerance=5e-4))
    frames = solver.run(both, start=start)
    assert frames.converged[:, 0].all() and (frames.reason[:, 1] == Reason.PATH).all()
    assert np.isnan(frames.force[:, 1]).all()


@pytest.mark.parametrize(("x", "reason"), [(-0.015, Reason.NONE), (0.015, Reason.PATH)], ids=["post", "shelf"])
def test_a_way_counts_against_the_part_under_the_faces_in_it(line, device, monkeypatch, x, reason):
    """A post with a shelf of 0.4 mm. 1.5 mm in two steps at most: no more than a step on the post, too long a way for
    the shelf, whose other side it could meet."""
    monkeypatch.setattr(increments, "_MOST_PIECES", 2)
    vertices, tets = ticked((np.linspace(-0.03, 0.03, 5), np.linspace(-0.01, 0.01, 3), np.array([0, 0.0296, 0.03])))
    tets = tets[(vertices[tets].mean(axis=1) @ [1.0, 0.0, 0.0] < 0.0) | (vertices[tets][..., 2].min(axis=1) > 0.02)]
    used, tets = np.unique(tets, return_inverse=True)
    solid = Solid(vertices[used], tets.reshape(-1, 4), np.zeros(tets.size // 4, int), ("body",))
    model = build_model(solid, np.full((len(solid.tets), 4), 1e5), poisson_ratio=0.3, fixed="bottom",
                        bottom_tolerance=1e-9, where="test")
    at = line([[x, 0.0, 0.039], [x, 0.0, 0.0375]], Sphere(0.008))
    assert Solver(model, Sphere(0.008), device=device, linear=True).run(at[1:], start=at[0]).reason[0, 0] == reason
