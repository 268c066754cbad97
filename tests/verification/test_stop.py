"""The stop of a bubble's nodes at the plate in the plane of its rim."""

import sys
from pathlib import Path

import numpy as np
import pytest
from texts import scene

sys.path.insert(0, str(Path(__file__).parents[1] / "physics"))
from element_body import Body

from vsfsim.core.bubble import Bubble
from vsfsim.core.errors import SceneError
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Sphere
from vsfsim.core.solid import Solid
from vsfsim.generate.effectors.bubble import solve
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.physics.elements import stop
from vsfsim.physics.mesh.membrane import TriangleMesh
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.touches import Solver


def test_energy_force_and_tangent_against_the_closed_form(device):
    points = np.array([[0.0, 0.0, 0.006], [0.01, 0.0, 0.005], [0.0, 0.01, 0.007], [0.01, 0.01, 0.005]])
    mesh = TriangleMesh.of(points, np.array([[0, 1, 2], [1, 3, 2]], np.int32), np.arange(4))
    model = Model(mesh, (stop.block(np.arange(3), 3, points, 7000.0),), np.ones(1), np.ones(12),
                  np.zeros(12), np.ones(1), Solid(np.zeros((0, 3)), np.zeros((0, 4), int),
                                                  np.zeros(0, int), ("sheet",)), 0.01, None)
    body, down = Body(model, device), np.array([0.0011, 0.0003, 0.0015])
    # the plate itself moves by a millimetre
    u = np.column_stack([np.full(4, 0.004), np.full(4, -0.003), np.append(0.001 - down, 0.001)]).ravel()
    deep = np.array([0.0001, 0.0003, 0.0])
    force, energy, _ = body(u[:, None])
    close = 1e-9  # of a depth of 0.1 mm, the difference of heights of 1 mm
    assert energy[0] == pytest.approx((7000.0 * deep**2 * (0.5 + deep / 6e-4)).sum(), rel=close)
    push = 7000.0 * deep * (1.0 + deep / 2e-4)
    assert force.reshape(4, 3)[:, 2] == pytest.approx([*-push, push.sum()], rel=close, abs=1e-12)
    assert (force.reshape(4, 3)[:, :2] == 0.0).all()
    tangent = body.tangent_times(u, np.eye(12), projected=False)[2::3, 2::3]
    stiffness = np.where(deep > 0.0, 7000.0 * (1.0 + deep / 1e-4), 0.0)
    expected = np.diag([*stiffness, stiffness.sum()])
    expected[3, :3] = expected[:3, 3] = -stiffness
    assert np.abs(tangent - expected).max() < 10.0 * close * stiffness.max()
    assert np.abs(body.tangent_times(np.zeros(12), np.eye(12), projected=False)).max() == 0.0


def lowest(sensor, shape, place, heights, device):
    """Height of the lowest node of the membrane in every frame (T,) [m], and the frames."""
    poses = np.tile(np.eye(4), (len(heights), 1, 1))
    poses[:, :2, 3], poses[:, 2, 3] = place, heights
    above = np.zeros((4, 4))
    above[2, 3] = 0.03
    solver = Solver(sensor, shape, friction=0.3, device=device, options=SolverOptions(tolerance=5e-4, seconds=1e9))
    frames = solver.run(poses[:, None], start=poses[:1] + above, keep=True)
    return np.array([(sensor.mesh.points + u[:, 0].reshape(-1, 3))[:, 2].min() for u in solver.history]), frames


def test_the_membrane_bottoms_out_on_its_housing(device):
    """A ball near the rim goes down to half a millimetre above the plate. Without the plate the membrane bulges
    0.135 mm below the plane of the rim."""
    sensor = build_bubble(Bubble(nodes=200))
    low, frames = lowest(sensor, Sphere(0.012), (0.042, 0.0), 0.012 + np.array([0.011, 0.004, 0.0005]), device)
    assert frames.converged.all() and (np.diff(frames.force[:, 0, 2]) > 0.0).all()
    assert -1e-4 < low.min() < 0.0 and (low[:-1] > -1e-9).all()


def test_an_obstacle_in_the_housing_is_refused():
    deep = scene("bubble", nodes=100, obstacles="[{ shape = { sphere = 0.01 }, pose = [0.0, 0.0, 0.0] }]",
                 press="{ path = [[0.0, 0.0, 0.0405], [0.0, 0.0, 0.008]], frames = 3 }")
    with pytest.raises(SceneError, match=r"in frame 2 of .press. obstacle 1 is .* mm behind the plane"):
        solve(deep.sample(0), Request())


def test_a_flat_drum_is_pressed_into_its_chamber():
    """A membrane without a dome, 3 mm deep in its middle; a plane wider than the rim meets the rim."""
    def press(chamber, shape, start, stop):
        drum = scene("bubble", nodes=150, gauge_pressure=1.0, chamber=chamber,
                     obstacles=f"[{{ shape = {{ {shape} }}, pose = [0.0, 0.0, 0.0] }}]",
                     press=f"{{ path = {[[0.0, 0.0, start], [0.0, 0.0, stop]]}, frames = 3 }}")
        return solve(drum.sample(0), Request()).solved

    ball = "sphere = 0.012", 0.013, 0.009
    solved = press(0.01, *ball)
    push = solved.wrench()[:, 2]
    assert solved.frames.converged.all() and (push[1:] < push[:-1]).all() and push[-1] < -0.1
    assert -0.0033 < solved.in_mount()[0][-1, :, 2].min() < -0.003
    for case in ((0.002, *ball), (0.01, "plane = true", 0.001, -0.002)):
        with pytest.raises(SceneError, match="behind the plane of the sensor's rim or the floor of its chamber"):
            press(*case)
