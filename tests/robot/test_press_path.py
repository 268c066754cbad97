"""Scripted paths: straight, the same poses in and out, pointing where they go."""

import numpy as np
import pytest
import texts

from vsfsim.core.rigid import PressSpec
from vsfsim.core.rotation import between, rotation_matrix, rotation_vector
from vsfsim.core.scene import TouchSpec
from vsfsim.core.shape import Box, Capsule, Plane, Sphere
from vsfsim.robot.path import body_poses, press_path, touch_path, turn_to

AXES = [[0, 0, -1], [0, 0, 1], [1e-9, 1.0, 0.0], [-0.5, 0.1, -0.8]]


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


START, STOP = (0.01, 0.02, 0.08), (0.02, 0.02, 0.06)


def on_a_line(points, start, stop):
    direction = (np.array(stop) - start) / np.linalg.norm(np.array(stop) - start)
    offset = points - start
    return np.abs(offset - np.outer(offset @ direction, direction)).max()


@pytest.mark.parametrize(("frames", "hold", "retract"), [(4, 3, 0), (6, 1, 6), (6, 0, 3), (5, 2, 9)])
def test_press_path(frames, hold, retract):
    poses = press_path(PressSpec((START, STOP), (frames,), hold, retract), Sphere(0.01))
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


@pytest.mark.parametrize("frames", [(2, 6, 1, 3), (1, 5, 0, 5), (3, 4, 2, 0)])
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


def test_rotation_vectors_there_and_back():
    rng = np.random.default_rng(0)
    for angle in (0.0, 1e-12, 1e-6, 0.5, 3.0, np.pi - 1e-9, np.pi):
        axis = rng.standard_normal(3)
        v = angle * axis / np.linalg.norm(axis)
        m = rotation_matrix(v)
        assert m.T @ m == pytest.approx(np.eye(3), abs=1e-14) and np.linalg.det(m) == pytest.approx(1.0)
        back = rotation_vector(m)
        # at pi both axes are right
        assert min(np.abs(back - v).max(), np.abs(back + v).max() if angle > 3.14 else 9.9) < 1e-14 + 1e-9 * angle
    assert rotation_matrix((0.0, 0.0, np.pi / 2)) @ [1, 0, 0] == pytest.approx([0, 1, 0])
    a, b = rotation_matrix((0.3, 0.1, -0.2)), rotation_matrix((0.1, 0.9, 0.4))
    assert between(a, b, 0.0) == pytest.approx(a) and between(a, b, 1.0) == pytest.approx(b, abs=1e-12)
    half = between(a, b, 0.5)
    assert half @ a.T @ half == pytest.approx(b, abs=1e-12), "half the way twice is the whole way"


def test_a_path_with_corners_and_turns():
    path = ((0.0, 0.0, 0.07), (0.0, 0.0, 0.06), (0.02, 0.0, 0.06))
    turns = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    poses = press_path(PressSpec(path, (2, 4), 1, 6, turns), Sphere(0.01))
    assert poses.shape == (13, 4, 4)
    assert poses[:6, :3, 3] == pytest.approx(np.array([[0, 0, 0.065], [0, 0, 0.06], [0.005, 0, 0.06], [0.01, 0, 0.06],
                                                       [0.015, 0, 0.06], [0.02, 0, 0.06]]))
    assert [rotation_vector(p[:3, :3])[2] for p in poses[:6]] == pytest.approx([0, 0, 0.25, 0.5, 0.75, 1.0])
    assert np.array_equal(poses[6], poses[5])
    # back over the very same poses, then to the first point
    assert np.array_equal(poses[7:12], poses[:5][::-1]) and poses[12, :3, 3] == pytest.approx(path[0])
    # more frames back than in: still on the path
    long = press_path(PressSpec(path, (2, 4), 0, 12, turns), Sphere(0.01))[6:]
    for frame, place in ((1, [0.015, 0, 0.06]), (9, [0, 0, 0.065]), (-1, path[0])):
        assert long[frame, :3, 3] == pytest.approx(place)
    # without rotation the probe keeps pointing along the first part
    assert (press_path(PressSpec(path, (2, 4)), Box((0.01, 0.02, 0.03)))[:, :3, :3] == np.eye(3)).all()


def test_parts_go_with_the_probe_and_obstacles_stay():
    scene = texts.scene(
        "block", press="{ path = [[0, 0, 0.07], [0, 0, 0.06]], rotation = [[0, 0, 0], [0, 0, 1.5707963267948966]], "
                       "frames = 2 }\nobstacles = [{ shape = { plane = true }, pose = [0.06, 0, 0], "
                       "rotation = [0, -1.5707963267948966, 0] }]",
        probe="{ shape = { sphere = 0.01 }, parts = [{ shape = { sphere = 0.01 }, offset = [0.03, 0, 0] }] }").sample()
    every = body_poses(scene, press_path(scene.press, scene.probe))
    assert every.shape == (2, 3, 4, 4)
    assert every[1, 1, :3, 3] == pytest.approx([0.0, 0.03, 0.06]), "a quarter turn about z takes the part from x to y"
    assert np.array_equal(every[0, 2], every[1, 2])
    assert every[0, 2, :3, :3] @ [0, 0, 1] == pytest.approx([-1, 0, 0]), "the wall looks back at the object"
