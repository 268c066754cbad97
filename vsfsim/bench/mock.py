"""A small object whose forces obey the papers' particle model exactly: for conformance runs and tests, in milliseconds.

The object is a block of independent springs on a grid (SBML appendix A: f_i = -K_i (p_i - p_i0)). A frictionless ball
moves every particle that it reaches to the nearest point of its surface. This is not the physics of the benchmark, but
a ground truth against which a method can be run without a dataset.
"""

from __future__ import annotations

import numpy as np

from vsfsim.core.shape import Sphere
from vsfsim.data.records import ObjectView, Touch, Truth, View

BLOCK = (0.06, 0.06, 0.03)
"""Edges of the block [m]; its base centre is the origin."""

BALL = Sphere(0.015)
SPACING = 0.005
"""Distance of the particles [m]."""

_FREE, _IN, _HOLD, _OUT = 2, 6, 1, 3
_CLEARANCE, _DEPTH = 0.006, 0.008


def mock_view(index: int, *, split: str = "test", touches: int = 8, seed: int = 0,
              stiffness: float = 1.0) -> ObjectView:
    """One mock object with its touches and truth.

    Args:
        index: of the object; with ``seed`` it determines all random numbers.
        split: written into the record.
        touches: how many; the last one misses the block.
        seed: root of the random streams.
        stiffness: factor on every spring [-].
    """
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    points = particles()
    spring = stiffness * rng.uniform(0.5, 2.0) * np.where(points[:, 0] > 0, 300.0, 60.0)
    spring = spring * rng.uniform(0.8, 1.2, len(points))
    made = tuple(_touch(points, spring, rng, miss=k == touches - 1) for k in range(touches))
    return ObjectView(f"mock-{index:04d}-v0", index, 0, split, BALL, camera_view(), made,
                      _truth(points, spring))


def particles() -> np.ndarray:
    """The block's particles (n, 3) [m], world."""
    axes = [np.arange(low + 0.5 * SPACING, high, SPACING)
            for low, high in ((-BLOCK[0] / 2, BLOCK[0] / 2), (-BLOCK[1] / 2, BLOCK[1] / 2), (0.0, BLOCK[2]))]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def displacement(points: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """How far the ball at ``centre`` (3,) [m] pushes each of ``points`` (n, 3) [m]: (n, 3) [m], zero outside it."""
    offset = points - centre
    distance = np.linalg.norm(offset, axis=1)
    push = np.maximum(BALL.radius - distance, 0.0)
    return offset * (push / np.maximum(distance, 1e-12))[:, None]


def camera_view() -> View:
    """The block from straight above, 0.4 m over its base, 64 x 64 pixels; the stiff half is darker."""
    size, focal, height, centre, depth = 64, 300.0, 0.4, 31.5, 0.4 - BLOCK[2]
    u = (np.arange(size) - centre) / focal * depth
    mask = (np.abs(u)[:, None] <= BLOCK[1] / 2) & (np.abs(u)[None, :] <= BLOCK[0] / 2)
    rgb = np.where(mask[..., None], np.array([150, 120, 90], np.uint8), np.uint8(0)).astype(np.uint8)
    rgb[:, size // 2:] //= 2  # columns of a high number show x > 0, the stiff half
    intrinsics = np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    pose = np.array([[1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -1.0, height], [0, 0, 0, 1.0]])
    return View(rgb, np.where(mask, depth, 0.0).astype(np.float32), mask, intrinsics, pose)


def _touch(points: np.ndarray, spring: np.ndarray, rng: np.random.Generator, *, miss: bool) -> Touch:
    spot = rng.uniform(-0.02, 0.02, 2) + (0.2 if miss else 0.0)
    target, axis = np.array([spot[0], spot[1], BLOCK[2]]), np.array([0.0, 0.0, -1.0])
    travel = np.concatenate([np.linspace(-_CLEARANCE, -_CLEARANCE / 2, _FREE), np.linspace(0.0, _DEPTH, _IN),
                             np.full(_HOLD, _DEPTH), np.linspace(_DEPTH, -_CLEARANCE / 2, _OUT + 1)[1:]])
    centres = target + np.array([0, 0, BALL.radius]) + travel[:, None] * axis
    frames = len(travel)
    pose, zero, none = np.tile(np.eye(4), (frames, 1, 1)), np.zeros(frames), np.zeros(frames, np.int64)
    pose[:, :3, 3] = centres
    pushed = np.stack([displacement(points, centre) for centre in centres])
    force = -np.einsum("n,tnk->tk", spring, pushed)
    energy = 0.5 * np.einsum("n,tnk,tnk->t", spring, pushed, pushed)
    audit = {"force_balance": zero, "min_det_f": zero + 1.0, "energy": energy, "penetration": zero,
             "contact_points": none, "contact_radius": zero}
    return Touch(0.1 * np.arange(frames), pose, axis, target, -axis, force, force, zero == 0.0, zero, none + 1,
                 bool(np.any(pushed)), none, audit=audit)


def _truth(points: np.ndarray, spring: np.ndarray) -> Truth:
    x = np.linspace(-0.025, 0.025, 6)
    spots = np.stack([*np.meshgrid(x, x, indexing="ij"), np.full((6, 6), BLOCK[2])], axis=-1).reshape(-1, 3)
    # The spring constant of the column under a spot represents the stiffness that a small cone would measure there.
    near = np.linalg.norm(points[None, :, :2] - spots[:, None, :2], axis=2) < 0.006
    return Truth(points=points, young_modulus=spring / SPACING, region=(points[:, 0] > 0).astype(np.int64),
                 region_names=("soft", "stiff"), probe_points=spots, probe_stiffness=near @ spring,
                 probe_normals=np.tile([0.0, 0.0, 1.0], (len(spots), 1)),
                 vsf_points=points, vsf_stiffness=spring, vsf_touched=np.ones(len(points), bool))
