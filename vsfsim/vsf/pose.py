"""The pose of a known object from an estimate of stiffness alone (Neural VSF section III-E), in two ways.

`stiffness_pose` is the papers'. The points stiffer than a threshold, chosen above the cover's stiffness, form a cloud.
The object's surface is registered to it repeatedly: RANSAC over triples of points with equal distances (Fischler and
Bolles 1981), then iterative closest points (Besl and McKay 1992). The pose with the stiffest inside is kept, by the
loss of eq. 7,

    L = sum over touched points inside the object of max(threshold - K, 0)

`outline_pose` finds an object on one of its flat sides, from its outline: the loss seen from above. Touch reaches a few
millimetres deep, and a stiff object under a soft layer stiffens the layer above it before a probe reaches it. The stiff
points of an estimate are therefore a thin sheet above the object, to which a registration of surfaces fits it in many
ways. Such a sheet determines the outline of the object. So the stiffness of each column of touched points is compared
with the outline at all angles and positions,

    L = sum over columns under the outline of max(threshold - K, 0) + threshold * (number of stiff columns outside it)

on a grid first, then by a random search of shrinking steps, of which only improvements are taken. An outline that
covers no stiff column is no answer: it explains none of the contacts, and where nothing was touched it costs nothing.
The threshold makes the same fraction of the columns stiff as the outline has of the area that can be touched, so that
the cover's stiffness need not be known. An object turned over has nearly the same outline, mirrored; that is not tried.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from trimesh.registration import procrustes

from vsfsim.core.errors import VsfError
from vsfsim.physics.mesh.surface_distance import SurfaceDistance

TRIES = 40
"""Registrations of the papers' procedure, of which the best is kept."""

_TRIPLES = 20_000
"""Triples of surface points whose edge lengths RANSAC looks up."""
_CLOUD = 400
"""The most points of the cloud that are registered."""
_GRID = 32
"""Cells along the longest edge of the inside test."""

_ANGLES = 48
"""Angles of the grid, over a whole turn."""
_STEPS, _STEP = 6, 0.004
"""Positions of the grid on either side of the centre of the stiff columns, and their distance [m]."""
_MOST_STIFF = 0.5
"""The largest fraction of the columns that counts as stiff."""
_COLUMNS = 500
"""The most columns that are evaluated on the grid."""


@dataclass(frozen=True)
class KnownObject:
    """A closed triangle mesh, sampled for registration and for inside tests."""

    surface: np.ndarray
    """Points spread evenly over the surface (s, 3) [m]."""
    low: np.ndarray
    """Lower corner of the grid of the inside test (3,) [m]."""
    cell: float
    """Edge of a cell of that grid [m]."""
    inside: np.ndarray
    """Whether the centre of a cell is inside (i, j, k) bool."""

    @classmethod
    def of(cls, vertices: np.ndarray, triangles: np.ndarray, *, samples: int = 1500, seed: int = 0) -> KnownObject:
        """From vertices (n, 3) [m] and triangles (m, 3), wound outwards and closed; closed parts may overlap.

        Args:
            samples: points on the surface.
            seed: of their places.

        Raises:
            VsfError: no triangle, or a mesh that is not closed (its inside is not defined).
        """
        vertices, triangles = np.asarray(vertices, float), np.asarray(triangles)
        corners = vertices[triangles]
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
        body = SurfaceDistance(vertices, triangles)
        surface = np.einsum("kj,kji->ki", weight, corners[pick])
        # Closed parts may overlap: a point of the surface is outside all parts just in front of its triangle.
        front = surface + 1e-4 * (high - low).max() * normal[pick] / size[pick, None]
        inside = body.inside(points.reshape(-1, 3)).reshape(points.shape[:3])
        return cls(surface[~body.inside(front)], low, cell, inside)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (k, 3) [m] in the object's frame are inside it (k,) bool; to half a cell."""
        index = np.floor((points - self.low) / self.cell).astype(int)
        on_grid = np.all((index >= 0) & (index < self.inside.shape), axis=1)
        index = np.where(on_grid[:, None], index, 0)
        return on_grid & self.inside[tuple(index.T)]


@dataclass(frozen=True)
class Pose:
    """A pose and how well it fits."""

    transform: np.ndarray
    """Object to world (4, 4) [m]."""
    loss: float
    """The module's loss, in the unit of the stiffness."""


def stiffness_pose(known: KnownObject, points: np.ndarray, stiffness: np.ndarray, *, threshold: float,
                   tries: int = TRIES, seed: int = 0) -> Pose:
    """The pose of the registration that best explains an estimate of stiffness.

    Args:
        known: the object.
        points: touched points, world (n, 3) [m].
        stiffness: at the points (n,).
        threshold: above the cover's stiffness, in the unit of ``stiffness``.
        tries: registrations.
        seed: of the draws.

    Raises:
        VsfError: fewer than 10 points are stiffer than the threshold.
    """
    stiff = stiffness > threshold
    if stiff.sum() < 10:
        raise VsfError(f"vsf.localise: {int(stiff.sum())} of {len(points)} points are stiffer than {threshold:g}; "
                       f"lower the threshold (the stiffest has {np.max(stiffness, initial=0.0):g}), or touch more.")
    lack, poses = np.maximum(threshold - stiffness, 0.0), []
    for attempt in range(tries):
        at = register(known.surface, points[stiff], seed=seed * 1000 + attempt)[0]
        poses.append(Pose(at, float(lack[known.contains((points - at[:3, 3]) @ at[:3, :3])].sum())))
    return min(poses, key=lambda p: p.loss)


def register(surface: np.ndarray, cloud: np.ndarray, *, draws: int = 400, seed: int = 0) -> tuple[np.ndarray, float]:
    """Object-to-world transform (4, 4) that places the points ``surface`` (s, 3) on ``cloud`` (n, 3), and the root mean
    square distance of the cloud from the surface [m], each distance cut at a tenth of the surface's extent."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    cloud = cloud[rng.permutation(len(cloud))[:_CLOUD]]
    tree = cKDTree(surface)
    span = float(np.linalg.norm(np.ptp(surface, axis=0)))
    triples = rng.integers(len(surface), size=(_TRIPLES, 3))
    lookup = cKDTree(_edges(surface[triples]))
    chosen = np.stack([rng.choice(len(cloud), 3, replace=False) for _ in range(draws)])
    # Wide triples of the cloud determine a rotation best.
    wide = np.argsort(-_edges(cloud[chosen]).min(axis=1))[: draws // 2]
    difference, match = lookup.query(_edges(cloud[chosen[wide]]))

    def distances(to_surface: np.ndarray, cut: float) -> np.ndarray:
        moved = cloud @ to_surface[:3, :3].T + to_surface[:3, 3]
        return np.minimum(tree.query(moved, distance_upper_bound=cut)[0], cut)  # beyond the bound it gives infinity

    best, least = np.eye(4), np.inf
    best[:3, 3] = surface.mean(axis=0) - cloud.mean(axis=0)
    for triple, gap, index in zip(chosen[wide], difference, match):
        if gap > 0.1 * span:
            continue
        trial = procrustes(cloud[triple], surface[triples[index]], reflection=False, scale=False, return_cost=False)
        cost = float(distances(trial, 0.05 * span).mean())
        if cost < least:
            best, least = trial, cost
    best = _trimmed_closest_points(surface, tree, cloud, best, span)
    return np.linalg.inv(best), float(np.sqrt(np.mean(distances(best, 0.1 * span) ** 2)))


def _trimmed_closest_points(surface: np.ndarray, tree: cKDTree, cloud: np.ndarray, transform: np.ndarray,
                            span: float) -> np.ndarray:
    """Iterative closest points from ``transform`` (4, 4), cloud to surface, without the points beyond a limit.

    The limit falls from a fifth to a twentieth of ``span``, and at least half of the points count. `trimesh` and
    `small_gicp` have no such limit; on clouds with stiff points outside the object they end in worse poses.
    """
    limit, before = 0.2 * span, np.inf
    for _ in range(60):
        moved = cloud @ transform[:3, :3].T + transform[:3, 3]
        distance, index = tree.query(moved)
        near = distance <= max(limit, np.quantile(distance, 0.5))
        error = float(np.sqrt(np.mean(np.minimum(distance, limit) ** 2)))
        transform = procrustes(cloud[near], surface[index[near]], reflection=False, scale=False, return_cost=False)
        limit = max(0.9 * limit, 0.05 * span)
        if abs(before - error) < 1e-7 * span and limit <= 0.05 * span:
            break
        before = error
    return transform


def _edges(corners: np.ndarray) -> np.ndarray:
    """Edge lengths (k, 3) of triangles (k, 3, 3), edge j opposite corner j."""
    return np.linalg.norm(np.roll(corners, -1, axis=1) - np.roll(corners, -2, axis=1), axis=2)


def outline_area(known: KnownObject) -> float:
    """Area of the object's outline from above [m^2]."""
    return float(known.inside.any(axis=2).sum()) * known.cell**2


def outline_pose(known: KnownObject, columns: np.ndarray, stiffness: np.ndarray, *, area: float, top: float,
                 refine: int = 400, seed: int = 0) -> Pose:
    """The pose that best explains the stiffness of columns.

    Args:
        known: the object, upright as in its own frame.
        columns: positions of the columns, world (n, 2) [m].
        stiffness: of each column, >= 0 (n,).
        area: the area that can be touched [m^2].
        top: z of the object's upper side [m].
        refine: steps of the random search.
        seed: of the random search.

    Raises:
        VsfError: fewer than 10 columns, or all of one stiffness.
    """
    if len(columns) < 10 or not np.ptp(stiffness) > 0.0:
        raise VsfError(f"vsf.outline: {len(columns)} columns of stiffnesses {np.min(stiffness, initial=0.0):g} to "
                       f"{np.max(stiffness, initial=0.0):g} do not determine a pose; touch more.")
    share = min(outline_area(known) / area, _MOST_STIFF)
    cut = float(np.quantile(stiffness, 1.0 - share))
    if not cut > 0.0:
        cut = float(stiffness[stiffness > 0.0].min())
    stiff = stiffness >= cut
    # What covering a column takes off the loss of an outline that covers nothing.
    gain = np.where(stiff, 1.0, -np.maximum(cut - stiffness, 0.0) / cut)
    flat = np.pad(known.inside.any(axis=2), 1).astype(float)
    middle = np.average(columns[stiff], axis=0)
    shifts = _STEP * np.stack(np.meshgrid(*[np.arange(-_STEPS, _STEPS + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)

    def covered(angle: float, places: np.ndarray, every: int = 1) -> np.ndarray:
        """Gain (p,) of the outline at positions ``places`` (p, 2), from every ``every``-th column; -inf where it covers
        no stiff one."""
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) / known.cell
        index = (columns[::every] @ turn - known.low[:2] / known.cell)[None] - (places @ turn)[:, None]
        # Columns off the outline's grid fall into the zeros padded around it.
        index = np.clip(np.floor(index).astype(np.int32) + 1, 0, np.array(flat.shape, np.int32) - 1)
        under = flat[index[..., 0], index[..., 1]]
        return np.where((under * stiff[::every]).any(axis=1), (under * gain[::every]).sum(axis=1), -np.inf)

    best, most, every = (0.0, middle), -np.inf, -(-len(columns) // _COLUMNS)
    for angle in 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES:
        gains = covered(angle, middle + shifts, every)
        k = int(np.argmax(gains))
        if gains[k] > most:
            best, most = (angle, middle + shifts[k]), float(gains[k])
    most = float(covered(best[0], best[1][None])[0])
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    for step in range(refine):
        size = 20.0 ** (-step / max(refine, 1))
        trial = (best[0] + 0.15 * size * rng.standard_normal(), best[1] + _STEP * size * rng.standard_normal(2))
        found = float(covered(trial[0], trial[1][None])[0])
        if found > most:  # of equal poses the search would drift along
            best, most = trial, found
    angle, place = best
    high = known.low[2] + known.cell * (1 + int(np.flatnonzero(known.inside.any(axis=(0, 1)))[-1]))
    c, s = np.cos(angle), np.sin(angle)
    out = np.eye(4)
    out[:3, :3] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    out[:3, 3] = [*place, top - high]
    return Pose(out, float(stiff.sum() - most) * cut)
