"""Blind localisation of an object that is buried in soft material and touched from above only."""

import numpy as np
import pytest

from vsfsim.core.rotation import pose_errors
from vsfsim.vsf.pose import KnownObject, outline_pose, register, stiffness_pose


def box(low, high):
    """A closed box, wound outwards."""
    x = np.array([[(high if (i >> k) & 1 else low)[k] for k in range(3)] for i in range(8)], float)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return x, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def wedge():
    """A prism on a lopsided L of 10 x 6 cm, 3 cm high at one end and 2 at the other: no symmetry. Wound outwards."""
    outline = np.array([[0, 0], [0.10, 0], [0.10, 0.025], [0.035, 0.025], [0.035, 0.06], [0, 0.06]])
    height = 0.03 - 0.01 * outline[:, 0] / 0.10
    n = len(outline)
    vertices = np.concatenate([np.c_[outline, np.zeros(n)], np.c_[outline, height]]) - [0.04, 0.02, 0.015]
    cap = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]
    sides = [t for i in range(n) for j in [(i + 1) % n] for t in ((i, j, n + j), (i, n + j, n + i))]
    return vertices, np.array([(a, c, b) for a, b, c in cap] + [(n + a, n + b, n + c) for a, b, c in cap] + sides)


def pose(angle, shift, tilt=0.0):
    c, s, ct, st = np.cos(angle), np.sin(angle), np.cos(tilt), np.sin(tilt)
    out = np.eye(4)
    out[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array([[1, 0, 0], [0, ct, -st], [0, st, ct]])
    out[:3, 3] = shift
    return out


def buried(known, truth, *, noise, seed=0):
    """Touched points, the upper 1.5 cm of a soft block down to just under the object's top, and stiffnesses with the
    object's a hundred times the cover's."""
    axes = [np.arange(-0.1, 0.1, 0.004), np.arange(-0.1, 0.1, 0.004), np.arange(-0.012, 0.018, 0.004)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = known.contains((points - truth[:3, 3]) @ truth[:3, :3])
    rng = np.random.default_rng(seed)
    return points, np.where(inside, 1000.0, 10.0) * rng.lognormal(0, noise, len(points))


def test_inside_is_inside():
    known = KnownObject.of(*box((-0.02, -0.03, 0.0), (0.02, 0.03, 0.05)))
    points = np.random.default_rng(0).uniform(-0.06, 0.06, (3000, 3))
    margin = np.min(np.minimum(points - [-0.02, -0.03, 0.0], [0.02, 0.03, 0.05] - points), axis=1)
    clear = np.abs(margin) > 0.001  # half a cell of 0.06 / 32 m
    np.testing.assert_array_equal(known.contains(points)[clear], (margin > 0)[clear])
    assert np.min(np.abs(np.abs(known.surface) - [0.02, 0.03, 0.05]), axis=1).min() < 1e-9


def test_registration_recovers_a_rigid_motion(trial_seed):
    known = KnownObject.of(*wedge())
    truth = pose(2.1 + 2.4 * trial_seed, [0.03, -0.02, 0.01], tilt=0.4)
    other = KnownObject.of(*wedge(), seed=5 + trial_seed).surface
    found = [register(known.surface, other @ truth[:3, :3].T + truth[:3, 3], seed=3 * trial_seed + s) for s in range(3)]
    shift, turn = pose_errors(min(found, key=lambda f: f[1])[0], truth)
    assert shift < 0.002 and turn < 0.06


def test_the_literal_loss_is_that_of_equation_7():
    known = KnownObject.of(*wedge())
    truth = pose(0.3, [0.01, -0.015, 0.0])
    points, stiffness = buried(known, truth, noise=0.3)
    found = stiffness_pose(known, points, stiffness, threshold=100.0, tries=4)
    at = found.transform
    inside = known.contains((points - at[:3, 3]) @ at[:3, :3])
    assert 0 < inside.sum() and found.loss == pytest.approx(np.maximum(100.0 - stiffness, 0.0)[inside].sum())


def test_the_outline_gives_the_pose_of_a_flat_object(trial_seed):
    known, truth = KnownObject.of(*wedge()), pose(2.1 + 2.4 * trial_seed, [0.03, -0.02, 0.002])
    points, stiff = buried(known, truth, noise=0.3, seed=trial_seed)
    at = outline_pose(known, points[::8, :2], stiff.reshape(-1, 8).max(1), area=0.04, top=0.017)
    shift, turn = pose_errors(at.transform, truth)
    print(f"errors: {1000 * shift:.2f} mm, {turn:.4f} rad")
    assert shift < 0.002 and turn < 0.02
