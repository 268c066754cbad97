"""Distances of the arm's capsules from each other and from the table."""

from __future__ import annotations

import numpy as np

from vsfsim.robot.arm import Arm, Postures

ALLOWED_NEIGHBOURS = 1  # neighbouring links share a housing, so their capsules overlap by construction


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance (...) [m] between the segments a-b and c-d, end points (..., 3) [m] (Ericson, Real-Time Collision
    Detection, 5.1.9)."""
    along, across, r = b - a, d - c, a - c
    aa, ee = _dot(along, along), _dot(across, across)
    f, g, h = _dot(across, r), _dot(along, r), _dot(along, across)
    det = aa * ee - h * h
    parallel = det <= 1e-12 * aa * ee
    s = np.where(parallel, 0.0, np.clip((h * f - g * ee) / np.where(parallel, 1.0, det), 0.0, 1.0))
    t = np.clip((h * s + f) / ee, 0.0, 1.0)
    s = np.clip((h * t - g) / aa, 0.0, 1.0)
    # the second clamp may move the first point once more; after one further pass the result is exact
    t = np.clip((h * s + f) / ee, 0.0, 1.0)
    return np.linalg.norm(r + s[..., None] * along - t[..., None] * across, axis=-1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def ends(arm: Arm, at: Postures) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of the capsules' axes, two arrays (T, K, 3) [m], and their radii (K,) [m]."""
    poses = arm.capsule_poses(at)
    half = np.array([s.length for s in arm.shapes])[None, :, None] / 2 * poses[..., :3, 2]
    return poses[..., :3, 3] - half, poses[..., :3, 3] + half, np.array([s.radius for s in arm.shapes])


def self_gaps(arm: Arm, at: Postures) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (T, P) [m] of all pairs of capsules whose links are not neighbours, negative where they overlap, and the
    pairs (P, 2)."""
    first, last, radii = ends(arm, at)
    # the Punyo is fixed to the bracelet, so it has the bracelet's neighbours
    place = np.minimum(arm.capsule_links, arm.links.index("bracelet_link"))
    pairs = np.argwhere(np.triu(np.abs(place[:, None] - place[None, :]) > ALLOWED_NEIGHBOURS))
    i, j = pairs.T
    return segment_distance(first[:, i], last[:, i], first[:, j], last[:, j]) - radii[i] - radii[j], pairs


def table_gaps(arm: Arm, at: Postures, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (T, M) [m] of the capsules of the moving links from the table at ``height`` [m], and their numbers (M,).

    The base stands on the table, and the shoulder turns above it.
    """
    first, last, radii = ends(arm, at)
    moving = np.flatnonzero(arm.capsule_links >= arm.links.index("half_arm_1_link"))
    return np.minimum(first[:, moving, 2], last[:, moving, 2]) - radii[moving] - height, moving
