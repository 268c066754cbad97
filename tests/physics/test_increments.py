"""The way between poses: nothing slips through, whatever the step."""


import numpy as np
import pytest
from frame_checks import from_above

from vsfsim.core.shape import Sphere
from vsfsim.physics.solve.frames import Reason, SolverOptions
from vsfsim.physics.solve.increments import thinnest
from vsfsim.physics.solve.touches import Solver

USUAL = SolverOptions(tolerance=5e-4)


@pytest.mark.parametrize("linear", [False, True])
def test_twenty_millimetres_in_one_frame_give_what_small_steps_give(block, line, device, linear):
    model = block((0.06, 0.06, 0.03), 0.015)
    at = [[0, 0, 0.03 + 0.012 + z] for z in (0.015, -0.005)]
    options = SolverOptions(tolerance=1e-5)
    once = Solver(model, Sphere(0.012), device=device, options=options, linear=linear).run(line(at, Sphere(0.012)))
    slow = Solver(model, Sphere(0.012), device=device, options=options, linear=linear).run(
        line([[0, 0, z] for z in np.linspace(at[0][2], at[1][2], 21)], Sphere(0.012)))
    assert once.converged.all() and slow.converged.all()
    assert once.force[-1, 0] == pytest.approx(slow.force[-1, 0], rel=5e-4, abs=1e-4)


@pytest.mark.parametrize("linear", [False, True])
def test_a_path_that_begins_inside_the_object_is_marked(block, line, device, linear):
    """From which side the ball came there is not known: of two touches the one that begins free has its force."""
    model, probe = block((0.06, 0.06, 0.03), 0.015), Sphere(0.012)
    both = np.concatenate([line([[x, 0.0, 0.04 - z] for z in (0.0, 0.004)], probe) for x in (0.0, 0.01)], axis=1)
    start = from_above(both)
    start[1, :3, 3] = 0.01, 0.0, 0.03
    frames = Solver(model, probe, device=device, linear=linear, options=USUAL).run(both, start=start)
    assert frames.converged[:, 0].all() and (frames.reason[:, 1] == Reason.PATH).all()
    assert np.isnan(frames.force[:, 1]).all()


def test_the_thinnest_part_is_that_under_the_faces_in_the_way(block):
    """Of a block: its height under its top, its width under a side."""
    model = block((0.06, 0.04, 0.01), 0.02)
    middle = model.mesh.points[model.mesh.faces[:, :3]].mean(axis=1)
    top, side = (np.flatnonzero(middle[:, axis] == middle[:, axis].max()) for axis in (2, 1))
    assert [thinnest(model, [faces]) for faces in (top, side)] == pytest.approx([0.01, 0.04])
