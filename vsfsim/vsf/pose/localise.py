"""Where a known object lies, from an estimate of stiffness alone (Neural VSF section III-E).

Points stiffer than a threshold, chosen above the cover's stiffness, make a cloud. The object's surface is registered to
it again and again:
RANSAC over triples of points with equal distances (Fischler and Bolles 1981), then iterative closest points (Besl and
McKay 1992). Of all poses the one is kept whose inside is stiffest, by the loss of eq. 7,

    L = sum over touched points inside the object of max(threshold - K, 0)

A pose that covers few stiff points has few terms, too, so the loss is taken together with what it leaves out: the stiff
points outside the object, each counted as the threshold. The cloud fills the object's touched part while the
registration sees a surface, which tips poses by some ten degrees; so the best one is at last refined on the loss
itself, by a shrinking random search (``refine=0`` is the papers' way). `contact_pose` is the papers' baseline without
stiffness: it registers contact points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.core.errors import VsfError
from vsfsim.core.rotation import pose_errors

_TRIPLES = 20_000  # of model points, whose edge lengths are looked up
_CLOUD = 400  # points of the cloud that vote
_GRID = 32  # cells along the longest edge of the inside test
# Poses that the random search starts from, and by how much they must be turned against each other to be two [rad].
_STARTS, _APART = 3, 0.5


@dataclass(frozen=True)
class KnownObject:
    """A closed triangle mesh, and what localisation asks of it.

    surface: points spread evenly over it (s, 3) [m]. low: lower corner (3,) [m],
    cell: spacing [m] of a grid, inside: whether its nodes are inside (i, j, k) bool.
    """

    surface: np.ndarray
    low: np.ndarray
    cell: float
    inside: np.ndarray

    @classmethod
    def of(cls, vertices: np.ndarray, triangles: np.ndarray, *, samples: int = 1500, seed: int = 0) -> KnownObject:
        """From vertices (n, 3) [m] and triangles (m, 3), wound outwards and closed; closed parts may overlap.

        Raises:
            VsfError: no triangle, or a mesh that is not closed (its inside is not defined).
        """
        corners = np.asarray(vertices, float)[np.asarray(triangles)]
        if len(corners) == 0:
            raise VsfError("vsf.localise: the object's mesh has no triangle.")
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        size = np.linalg.norm(normal, axis=1)
        if np.linalg.norm(normal.sum(axis=0)) > 1e-6 * size.sum():
            raise VsfError("vsf.localise: the object's mesh is not closed (its face areas do not add up to zero); "
                           "repair it first.")
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        pick = rng.choice(len(corners), samples, p=size / size.sum())
        a, b = np.sqrt(rng.uniform(size=samples)), rng.uniform(size=samples)
        weight = np.stack([1 - a, a * (1 - b), a * b], axis=1)
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        cell = float((high - low).max()) / _GRID
        axes = [np.arange(lo + 0.5 * cell, hi + 0.5 * cell, cell) for lo, hi in zip(low, high)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        inside = _winding(points.reshape(-1, 3), corners) > 0.5
        surface = np.einsum("kj,kji->ki", weight, corners[pick])
        # Closed parts may overlap: what lies just outside a triangle must be outside of all of them.
        out = _winding(surface + 1e-4 * (high - low).max() * normal[pick] / size[pick, None], corners) < 0.5
        return cls(surface[out], low, cell, inside.reshape(points.shape[:3]))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which points (k, 3) [m], in the object's frame, lie inside it (k,) bool; to half a cell."""
        index = np.floor((points - self.low) / self.cell).astype(int)
        ok = np.all((index >= 0) & (index < self.inside.shape), axis=1)
        index = np.where(ok[:, None], index, 0)
        return ok & self.inside[tuple(index.T)]


@dataclass(frozen=True)
class Pose:
    """transform: object to world (4, 4) [m]. loss: [-] of eq. 7 with the points left out, or the registration's own for
    `contact_pose`."""

    transform: np.ndarray
    loss: float


def stiffness_pose(known: KnownObject, points: np.ndarray, stiffness: np.ndarray, *, threshold: float, tries: int = 10,
                   refine: int = 400,
                   seed: int = 0) -> Pose:
    """The pose that best explains an estimate of stiffness.

    Args:
        known: the object. points: that were touched, world (n, 3) [m]. stiffness: there (n,). threshold: above the
        cover's.
        tries: registrations, of which the best is kept. refine: steps of the random search after them, from
            each of the best three that are turned against each other. seed: of the draws.

    Raises:
        VsfError: fewer than 10 points are stiffer than the threshold.
    """
    stiff = stiffness > threshold
    if stiff.sum() < 10:
        raise VsfError(f"vsf.localise: {int(stiff.sum())} of {len(points)} points are stiffer than {threshold:g}; "
                       f"lower the threshold (the stiffest has {np.max(stiffness, initial=0.0):g}), or touch more.")
    lack = np.maximum(threshold - stiffness, 0.0)

    def judged(transform: np.ndarray) -> Pose:
        inside = known.contains((points - transform[:3, 3]) @ transform[:3, :3])
        return Pose(transform, float(lack[inside].sum() + threshold * np.count_nonzero(stiff & ~inside)))

    found = sorted((judged(register(known.surface, points[stiff], seed=seed * 1000 + attempt)[0])
                    for attempt in range(tries)), key=lambda p: p.loss)
    if not refine:
        return found[0]
    # A pose that is turned over may fit the sheet of stiff points nearly as well: the search starts from the best of
    # each kind.
    starts: list[Pose] = []
    for pose in found:
        if len(starts) < _STARTS and all(pose_errors(pose.transform, other.transform)[1] > _APART for other in starts):
            starts.append(pose)
    return min((_searched(pose, judged, points[stiff].mean(axis=0), 0.1 * _GRID * known.cell, refine, seed)
                for pose in starts), key=lambda p: p.loss)


def _searched(best: Pose, judged: Callable[[np.ndarray], Pose], centre: np.ndarray, reach: float, steps: int,
              seed: int) -> Pose:
    """A random search from ``best``, about ``centre`` (3,) [m]: from ``reach`` [m] and 0.2 rad down to a thirtieth of
    that."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    for step in range(steps):
        size = 30.0 ** (-step / steps)
        turn = _turned(0.2 * size * rng.standard_normal(3))
        moved = best.transform.copy()
        moved[:3, :3] = turn @ moved[:3, :3]
        moved[:3, 3] = centre + turn @ (moved[:3, 3] - centre) + reach * size * rng.standard_normal(3)
        trial = judged(moved)
        best = trial if trial.loss <= best.loss else best
    return best


def contact_pose(known: KnownObject, contacts: np.ndarray, *, tries: int = 10, seed: int = 0) -> Pose:
    """The baseline: the object's surface registered to points (n, 3) [m] where a contact force passed a limit.

    Raises:
        VsfError: fewer than 10 contact points.
    """
    if len(contacts) < 10:
        raise VsfError(f"vsf.localise: {len(contacts)} contact points are too few to register an object to; lower the "
                       f"force limit, or touch more.")
    found = [register(known.surface, contacts, seed=seed * 1000 + attempt) for attempt in range(tries)]
    transform, error = min(found, key=lambda item: item[1])
    return Pose(transform, error)


def register(surface: np.ndarray, cloud: np.ndarray, *, draws: int = 400, seed: int = 0) -> tuple[np.ndarray, float]:
    """Object-to-world transform (4, 4) that lays ``cloud`` (n, 3) on ``surface`` (s, 3), and the root mean square
    distance [m]."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    cloud = cloud[rng.permutation(len(cloud))[:_CLOUD]]
    tree = cKDTree(surface)
    span = float(np.linalg.norm(np.ptp(surface, axis=0)))
    triples = rng.integers(len(surface), size=(_TRIPLES, 3))
    lookup = cKDTree(_edges(surface[triples]))
    chosen = np.stack([rng.choice(len(cloud), 3, replace=False) for _ in range(draws)])
    # Of a cloud's triples the wide ones fix a rotation best.
    wide = np.argsort(-_edges(cloud[chosen]).min(axis=1))[: draws // 2]
    away, match = lookup.query(_edges(cloud[chosen[wide]]))
    best, least = None, np.inf
    for triple, gap, index in zip(chosen[wide], away, match):
        if gap > 0.1 * span:
            continue
        transform = _rigid(surface[triples[index]], cloud[triple])
        cost = float(np.minimum(tree.query((cloud - transform[:3, 3]) @ transform[:3, :3])[0], 0.05 * span).mean())
        if cost < least:
            best, least = transform, cost
    if best is None:
        best = np.eye(4)
        best[:3, 3] = cloud.mean(axis=0) - surface.mean(axis=0)
    return _closest_points(surface, tree, cloud, best, span)


def _closest_points(surface: np.ndarray, tree: cKDTree, cloud: np.ndarray, transform: np.ndarray,
                    span: float) -> tuple[np.ndarray, float]:
    limit, before = 0.2 * span, np.inf
    for _ in range(60):
        away, index = tree.query((cloud - transform[:3, 3]) @ transform[:3, :3])
        near = away <= max(limit, np.quantile(away, 0.5))
        error = float(np.sqrt(np.mean(np.minimum(away, limit) ** 2)))
        transform = _rigid(surface[index[near]], cloud[near])
        limit = max(0.9 * limit, 0.05 * span)
        if abs(before - error) < 1e-7 * span and limit <= 0.05 * span:
            break
        before = error
    away = tree.query((cloud - transform[:3, 3]) @ transform[:3, :3])[0]
    return transform, float(np.sqrt(np.mean(np.minimum(away, 0.1 * span) ** 2)))


def _edges(corners: np.ndarray) -> np.ndarray:
    """Edge lengths (k, 3) of triangles (k, 3, 3), edge j opposite corner j."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)


def _rigid(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The rigid transform that takes points (k, 3) to others in the least squares sense (Kabsch 1976)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((source - a).T @ (target - b))
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(vt.T @ u.T)) or 1.0])
    out = np.eye(4)
    out[:3, :3] = vt.T @ flip @ u.T
    out[:3, 3] = b - out[:3, :3] @ a
    return out


def _turned(rotation: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(rotation))
    axis = rotation / max(angle, 1e-300)
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def _winding(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Winding number of closed triangles (m, 3, 3) around points (k, 3) (van Oosterom and Strackee 1983)."""
    out = np.zeros(len(points))
    for start in range(0, len(points), 2048):
        a, b, c = (corners[None, :, k] - points[start:start + 2048, None] for k in range(3))
        la, lb, lc = (np.linalg.norm(x, axis=2) for x in (a, b, c))
        over = np.einsum("kmi,kmi->km", a, np.cross(b, c))
        under = la * lb * lc + np.einsum("kmi,kmi->km", a, b) * lc + np.einsum("kmi,kmi->km", b,
                                                                               c) * la + np.einsum("kmi,kmi->km", c,
                                                                                                   a) * lb
        out[start:start + 2048] = np.arctan2(over, under).sum(axis=1) / (2.0 * np.pi)
    return out
