"""A press comes from where it is stated to start, however few its frames: thin objects are met from that side."""

import numpy as np
import pytest

from vsfsim.core.shape import Capsule, Sphere
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver

POST = (0.01, 0.01, 0.06)
TURN = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])  # a capsule's axis along y


def way(start, stop, frames):
    """``frames`` poses (T, 1, 4, 4) from ``start`` (3,) to ``stop`` (3,) [m], and the pose (1, 4, 4) at the start."""
    poses = np.tile(np.eye(4), (frames + 1, 1, 1, 1))
    poses[:, 0, :3, 3] = np.linspace(start, stop, frames + 1)
    return poses[1:], poses[0]


def press(model, probe, start, stop, frames):
    poses, first = way(start, stop, frames)
    return Solver(model, probe).run(poses, start=first)


@pytest.mark.slow
def test_a_post_is_pushed_away_by_a_ball_that_comes_from_the_side(block):
    """In one frame a ball of 4 mm from x = -12 mm to +3 mm was brought in from the other side, and pulled; in
    two frames on the way to +12 mm, too. A beam that is 12 mm aside 50 mm above its foot pushes back with
    3 E I w / L^3."""
    model = block(POST, 0.01, young_modulus=1e5, poisson_ratio=0.3)
    one, two, many = (press(model, Sphere(0.004), (-0.012, 0.0, 0.05), (0.003, 0.0, 0.05), n) for n in (1, 2, 8))
    assert many.converged.all() and many.force[-1, 0, 0] == pytest.approx(
        -3.0 * 1e5 * (0.01**4 / 12.0) * 0.012 / 0.05**3, rel=0.1)  # 0.024 N
    for few in (one, two):
        assert few.converged.all()
        assert few.force[-1, 0] == pytest.approx(many.force[-1, 0], rel=0.02, abs=0.02 * np.abs(many.force[-1]).max())


@pytest.mark.slow
def test_a_ball_does_not_pass_through_a_plate_at_the_linear_tier(block):
    """50 mm down onto a plate of 3 mm in one frame. With friction it ended below, and read 0 N. Friction changes the
    force along the plate, by a hundredth that across it. Under a tighter limit than the tier's it came through, too."""
    model = block((0.06, 0.06, 0.003), 0.01, young_modulus=1e5, fixed=(-0.06, -0.06, -1, -0.02, 0.06, 1))
    poses, first = way((0.01, 0.0, 0.03), (0.01, 0.0, -0.02), 1)
    smooth, rough, tight = (
        Solver(model, Sphere(0.008), friction=friction, linear=True, options=options).run(poses, start=first)
        for friction, options in ((0.0, tiers.options("linear")), (0.5, tiers.options("linear")), (0.0, None)))
    assert smooth.converged.all() and smooth.force[-1, 0, 2] > 0.05
    for other in (rough, tight):  # where the CPU's rounding loses the frame it is marked, never through in silence
        assert not other.converged.any() or other.force[-1, 0, 2] == pytest.approx(smooth.force[-1, 0, 2], rel=0.05)


def test_an_obstacle_in_the_way_holds_the_post(block):
    """A ball pushes a post against a rigid rod behind it, which bears most of the push, in one frame as in four."""
    model = block(POST, 0.01, young_modulus=1e5, poisson_ratio=0.3)
    last = []
    for count in (1, 4):
        poses = np.tile(np.eye(4), (count + 1, 1, 2, 1, 1))
        poses[:, 0, 0, :3, 3] = np.linspace([-0.012, 0.0, 0.05], [-0.007, 0.0, 0.05], count + 1)
        poses[:, 0, 1, :3, 3] = 0.009, 0.0, 0.045  # a millimetre from the post
        poses[:, 0, 1, :3, :3] = TURN
        frames = Solver(model, [Sphere(0.004), Capsule(0.003, 0.03)]).run(poses[1:], start=poses[0])
        assert frames.converged.all()
        last.append(frames.body_force[-1, 0])
    assert last[1][1, 0] > 0.5 * -last[1][0, 0] > 0.0
    assert last[0] == pytest.approx(last[1], rel=0.02, abs=0.02 * np.abs(last[1]).max())


@pytest.mark.parametrize(("probe", "start", "stop", "linear"), [
    (Sphere(0.004), (-0.012, 0.001, 0.045), (0.003, 0.001, 0.045), True),
    pytest.param(Capsule(0.004, 0.02), (-0.012, 0.0, 0.05), (0.002, 0.003, 0.047), False,
                 marks=pytest.mark.slow)], ids=["ball", "capsule"])
def test_friction_does_not_depend_on_the_number_of_frames(block, probe, start, stop, linear):
    """A ball that pushed a post aside with friction 0.5 at the tier `linear` had 0.174 N upwards in one frame and 0.617
    N in eight."""
    model = block(POST, 0.01, young_modulus=1e6, poisson_ratio=0.45)
    last = []
    for count in (1, 8):
        poses, first = way(start, stop, count)
        frames = Solver(model, probe, friction=0.5, linear=linear, options=tiers.options(
            "linear" if linear else "fem-coarse")).run(poses, start=first)
        assert frames.converged[-1].all()
        last.append(frames.force[-1, 0])
    assert np.abs(last[0] - last[1]).max() < 0.03 * np.linalg.norm(last[1])
