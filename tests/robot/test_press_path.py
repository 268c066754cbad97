"""Scripted paths: straight, the same poses in and out, pointing where they go."""

import numpy as np
import pytest

from vsfsim.core.scene import PressSpec, TouchSpec
from vsfsim.core.shape import Box, Capsule, Plane, Sphere
from vsfsim.robot.press import FRAME_SECONDS, press_path, straight, times, touch_path, turn_to

AXES = [[0, 0, -1], [0, 0, 1], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0.3, -0.9, 0.2], [1e-9, 1.0, 0.0], [-0.5, 0.1, -0.8]]


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("probe", [Sphere(0.01), Capsule(0.01, 0.02), Box((0.01, 0.02, 0.03)), Plane()])
def test_turn_is_a_rotation_that_points_the_probe_along_the_axis(axis, probe):
    turn = turn_to(np.array(axis, float), probe)
    unit = np.array(axis) / np.linalg.norm(axis)
    assert turn.T @ turn == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    # a plane looks along its +z, what has a body leads with its -z
    lead = [0, 0, 1] if isinstance(probe, Plane) else [0, 0, -1]
    assert turn @ lead == pytest.approx(unit, abs=1e-12)
    assert np.array_equal(turn, turn_to(np.array(axis, float), probe)), "the same axis gives the same rotation"


def test_a_vertical_press_leaves_the_probe_upright():
    assert turn_to(np.array([0.0, 0.0, -1.0]), Sphere(0.01)) == pytest.approx(np.eye(3))


def test_straight_starts_one_step_away_and_ends_at_the_stop():
    way = straight(np.zeros(3), np.array([0.0, 3.0, -6.0]), 3)
    assert way == pytest.approx(np.array([[0, 1, -2], [0, 2, -4], [0, 3, -6]]))


START, STOP = (0.01, 0.02, 0.08), (0.02, 0.02, 0.06)


def on_a_line(points, start, stop):
    direction = (np.array(stop) - start) / np.linalg.norm(np.array(stop) - start)
    offset = points - start
    return np.abs(offset - np.outer(offset @ direction, direction)).max()


@pytest.mark.parametrize(("frames", "hold", "retract"), [(10, 0, 0), (4, 3, 0), (6, 1, 6), (6, 0, 3), (5, 2, 9), (1, 0, 1)])
def test_press_path(frames, hold, retract):
    poses = press_path(PressSpec(START, STOP, frames, hold, retract), Sphere(0.01))
    assert poses.shape == (frames + hold + retract, 4, 4)
    at = poses[:, :3, 3]
    assert on_a_line(at, START, STOP) < 1e-15
    assert at[frames - 1] == pytest.approx(STOP) and (at[frames - 1:frames + hold] == at[frames - 1]).all()
    assert (poses[:, :3, :3] == poses[0, :3, :3]).all() and (poses[:, 3] == [0, 0, 0, 1]).all()
    if retract:
        assert at[-1] == pytest.approx(START)
        depth = (at - START) @ (np.array(STOP) - START)
        assert (np.diff(depth[frames + hold - 1:]) < 0.0).all()
    if 0 < retract <= frames:
        # the way back meets the very poses of the way in, so that the same equilibria come again
        inward = {p.tobytes() for p in poses[:frames]}
        assert all(p.tobytes() in inward for p in poses[frames + hold:-1])


@pytest.mark.parametrize("frames", [(2, 6, 1, 3), (1, 5, 0, 5), (3, 4, 2, 0), (1, 1, 0, 1)])
def test_touch_path(frames):
    spec = TouchSpec(count=1, depth=0.01, approach=0.02, force_limit=30.0, frames=frames)
    contact, axis = np.array([0.1, 0.2, 0.3]), np.array([0.6, 0.0, -0.8])
    poses = touch_path(spec, Sphere(0.01), contact, axis)
    free, inward, hold, out = frames
    assert len(poses) == sum(frames)
    depth = (poses[:, :3, 3] - contact) @ axis
    assert on_a_line(poses[:, :3, 3], contact, contact + axis) < 1e-15
    assert depth[:free] == pytest.approx([-0.02] * free)
    assert depth[free:free + inward] == pytest.approx(0.01 * np.arange(1, inward + 1) / inward)
    assert depth[free + inward:free + inward + hold] == pytest.approx([0.01] * hold)
    if out:
        assert depth[-1] == pytest.approx(0.0, abs=1e-12)
        assert (np.diff(depth[free + inward + hold - 1:]) < 0.0).all()
        inside = {p.tobytes() for p in poses[free:free + inward]}
        assert all(p.tobytes() in inside for p in poses[free + inward + hold:-1])


def test_touch_depth_may_be_cut():
    spec = TouchSpec(count=1, depth=0.01, approach=0.02, force_limit=30.0, frames=(1, 4, 0, 2))
    poses = touch_path(spec, Plane(), np.zeros(3), np.array([0.0, 0.0, -1.0]), depth=0.004)
    assert poses[:, 2, 3].min() == pytest.approx(-0.004)


def test_time_runs_at_the_sensors_rate():
    assert times(4) == pytest.approx(FRAME_SECONDS * np.array([0, 1, 2, 3])) and pytest.approx(30.0) == 1.0 / FRAME_SECONDS
