"""The motion of the rigid bodies between two poses, in increments so short that no contact is missed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import has_edges, inner_radius
from vsfsim.physics.contact.intrusion import Intrusion
from vsfsim.physics.mesh.surface_distance import crossings
from vsfsim.physics.model import Model

# longest step over the thinnest body's inner radius: a wall is then met in the nearer half of the body. With friction
# the way counts: a ball that drags a post aside has a force that is off by 11 % with 0.5, and by 0.01 % with 0.25. A
# surface slides around an edge within short ways: a flat face that is pressed in steps of a fifth ends elsewhere
_PART, _PART_FRICTION, _PART_EDGES = 0.5, 0.25, 0.05
_MOST_PIECES = 400  # pieces of one frame
_ADVANCES, _SHORT = 50, 0.01  # most steps to the first pose that may touch; the shortest, of the whole way
_RAYS = 200  # faces whose thickness is measured
_DEEP = 0.2  # depth over the same radius from which on a path begins inside the object


def stride(bodies: RigidBodies, thickness: float, *, friction: bool = False) -> float:
    """Longest step of the bodies [m] against an object of this mean ``thickness`` [m] (see `mean_thickness`): a longer
    one would meet the other side of a wall as well."""
    part = _PART_EDGES if any(map(has_edges, bodies.shapes)) else _PART_FRICTION if friction else _PART
    return min(thickness, part * min(map(inner_radius, bodies.shapes)))


def mean_thickness(model: Model) -> float:
    """Twice the volume over the surface [m], which is the wall of a sheet or a hollow body.

    For a membrane it is a third of an element: a tip that moves further in one step meets points that the prediction
    did not include, and the sheet has no stiffness of its own across. Where the mesh was refined for the tip, it is a
    third of the mean of all elements, or three quarters of those under the tip.
    """
    if model.mesh.faces.shape[1] == 3:
        return min(model.mesh.edge() / 3.0, 0.75 * model.element_size)
    return 2.0 * float(model.mesh.volume.sum()) / float(model.mesh.face_area().sum())


def clear(start: np.ndarray, end: np.ndarray, bodies: RigidBodies, model: Model) -> np.ndarray:
    """Poses (B, K, 4, 4) on the way from ``start`` to ``end``, as far along it as the bodies certainly meet nothing of
    the object at rest: the way there needs no steps. An object with weight hangs elsewhere, and is come to from the
    start.

    The way goes on by the least gap, which no point of a body can cross (Mirtich 1996, Impulse-based Dynamic Simulation
    of Rigid Body Systems, section 2.3, conservative advancement). Gaps are those of nodes, less how far a point of a
    face may be from its nodes.
    """
    if model.load.any():
        return start
    mesh, out = model.mesh, start.copy()
    surface, corners = mesh.points[mesh.surface_nodes()], mesh.points[mesh.faces[:, :3]]
    edge = float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max())
    between_nodes = edge / (3.0 if mesh.faces.shape[1] == 6 else 1.5)
    length = _lengths(start, end, bodies.reaches)
    for b in range(len(start)):
        moving = np.flatnonzero(length[b])
        part = 0.0
        for _ in range(_ADVANCES):
            at = out[b] = between(start[b], end[b], part)
            gaps = [float(bodies.distance(k, (surface - at[k, :3, 3]) @ at[k, :3, :3]).min()) for k in moving]
            step = min([gap / length[b, k] for gap, k in zip(gaps, moving, strict=True)], default=1.0)
            step -= max([between_nodes / length[b, k] for k in moving], default=0.0)
            if part >= 1.0 or step <= _SHORT:
                break
            part = min(1.0, part + step)
    return out


def thinnest(model: Model, faces: Sequence[np.ndarray]) -> float:
    """Least thickness [m] of the solid under boundary faces that are in the bodies' way, lists (f,) of each touch: from
    the middle of a face straight in to the other side, of `_RAYS` of them; infinite for a membrane, and without any.
    The thinnest twentieth, at edges, does not count."""
    mesh, sides = model.mesh, np.unique(np.concatenate(list(faces)))
    if mesh.faces.shape[1] == 3 or not len(sides):
        return float("inf")
    sides = sides[np.linspace(0, len(sides) - 1, min(len(sides), _RAYS)).astype(int)]
    corners = mesh.points[mesh.faces[:, :3]]
    inward = -np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    found = np.array([ways(corners[side].mean(axis=0)[None], corners, inward[side], least=1e-6 * model.element_size)[0]
                      for side in sides])
    found = found[np.isfinite(found)]
    return float(np.percentile(found, 5.0)) if len(found) else float("inf")


def ways(points: np.ndarray, triangles: np.ndarray, axis: np.ndarray, *, least: float = -1e-9) -> np.ndarray:
    """Shortest way [m] of each of ``points`` (p, 3) along the unit ``axis`` (3,) to any of the ``triangles`` (f, 3, 3)
    that is no shorter than ``least``; infinite where it meets none."""
    out = np.empty(len(points))
    for some in np.array_split(np.arange(len(points)), max(1, len(points) // 200)):
        found = crossings(points[some], axis[None], triangles)
        out[some] = np.where(found > least, found, np.inf).min(axis=1, initial=np.inf)
    return out


def between(a: np.ndarray, b: np.ndarray, part: float) -> np.ndarray:
    """Poses (..., 4, 4) at ``part`` of the way from a to b: straight, and about one axis."""
    out = np.array(b, dtype=float)
    out[..., :3, 3] = (1.0 - part) * a[..., :3, 3] + part * b[..., :3, 3]
    turn = np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3]
    if not np.array_equal(a[..., :3, :3], b[..., :3, :3]):
        vector = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec()
        out[..., :3, :3] = a[..., :3, :3] @ Rotation.from_rotvec(part * vector).as_matrix().reshape(turn.shape)
    return out


def pieces(a: np.ndarray, b: np.ndarray, longest: float, reaches: np.ndarray) -> Iterator[np.ndarray]:
    """Poses (B, K, 4, 4) on the way from a to b, ending with b, none further than ``longest`` [m] from the one
    before; ``reaches``: how far each body extends from its origin (K,) [m]."""
    count = int(np.clip(np.ceil(_lengths(a, b, reaches).max() / longest - 1e-9), 1, _MOST_PIECES))
    for i in range(1, count):
        yield between(a, b, i / count)
    yield b


def _lengths(a: np.ndarray, b: np.ndarray, reaches: np.ndarray) -> np.ndarray:
    """How far any point of each body moves at most from a to b (B, K) [m]."""
    way = np.linalg.norm(b[..., :3, 3] - a[..., :3, 3], axis=-1)
    cosine = 0.5 * (np.einsum("...ij,...ij->...", a[..., :3, :3], b[..., :3, :3]) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) * (cosine < 1.0 - 1e-12)
    return way + angle * np.minimum(reaches, 1.0)


def too_far(a: np.ndarray, b: np.ndarray, longest: float, reaches: np.ndarray) -> np.ndarray:
    """Whether `pieces` are longer than ``longest`` [m] because there would be too many (B,) bool: what a thin part does
    on such a way is not known."""
    return (_lengths(a, b, reaches) > (_MOST_PIECES + 1e-6) * longest).any(axis=1)


def ratio(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Length of the step second -> third over that of first -> second for each touch (B,) [-]: 1 for even steps, at
    most 2, and 0 if it turns back."""
    last = (second - first)[..., :3, 3].reshape(len(second), -1)
    now = (third - second)[..., :3, 3].reshape(len(second), -1)
    size = np.linalg.norm(last, axis=1)
    even = np.linalg.norm(now, axis=1) / np.where(size > 0.0, size, 1.0)
    return np.minimum(np.where(((now * last).sum(axis=1) > 0.0) & (size > 0.0), even, 0.0), 2.0)


def inside(bodies: RigidBodies, model: Model, pose: np.ndarray, device: str = "cpu") -> np.ndarray:
    """Which touches begin with a body inside the object at rest (B,) bool: what brought it there is not known.

    An overlap of a fifth of the body's inner radius and of the wall is none: the surface gives way on the side that
    is met, whatever came before.

    Args:
        bodies: the rigid bodies (K).
        model: the object.
        pose: where the paths begin (B, K, 4, 4).
        device: Warp device.
    """
    inner, solid = min(map(inner_radius, bodies.shapes)), model.mesh.faces.shape[1] == 6
    deep = _DEEP * inner if np.isfinite(inner) else model.element_size
    if solid:  # of a thin wall both faces may lie in a large body that is barely in it
        deep = min(deep, mean_thickness(model))
    check = Intrusion(model.mesh, bodies, model.element_size, device=device)
    faces, near = check.check(torch.arange(len(pose), device=device), pose, torch.zeros(
        (model.mesh.points.size, len(pose)), dtype=torch.float64, device=device))
    return ((torch.maximum(faces, near) if solid else faces).amax(dim=1) > deep).cpu().numpy()
