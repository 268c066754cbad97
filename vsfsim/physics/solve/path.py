"""The path of the rigid bodies between two poses, in pieces so short that no contact is missed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from vsfsim.core.shape import Plane
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.mesh.winding import winding_number
from vsfsim.physics.model import Model

_PART = 0.5  # longest step over the thinnest body's inner radius: a wall is then met in the nearer half of the body
_MOST = 100  # pieces of one frame
_DEEP = 0.2  # depth over the same radius above which a first pose is approached from outside
_SAMPLES = 4000  # random points for the inner radius


def stride(bodies: RigidBodies, thickness: float) -> float:
    """Longest step of the bodies [m] against an object of this mean ``thickness`` [m] (see `mean_thickness`): a longer
    one would meet the other side of a wall as well."""
    return min(thickness, _PART * min(_inner_ball(bodies, k)[0] for k in range(len(bodies))))


def mean_thickness(model: Model) -> float:
    """Twice the volume over the surface [m], which is the wall of a sheet or a hollow body.

    For a membrane it is a third of an element: a tip that moves further in one step meets points that the prediction
    did not include, and the sheet has no stiffness of its own across. Where the mesh was refined for the tip, it is a
    third of the mean of all elements, or three quarters of those under the tip.
    """
    if model.mesh.faces.shape[1] == 3:
        return min(model.mesh.edge() / 3.0, 0.75 * model.element_size)
    return 2.0 * float(model.mesh.volume.sum()) / float(model.mesh.face_area().sum())


def _inner_ball(bodies: RigidBodies, k: int) -> tuple[float, np.ndarray]:
    """Radius [m] of the largest ball inside body k, from samples, and its centre (3,) [m]; infinite for a plane."""
    if isinstance(bodies.shapes[k], Plane):
        return float("inf"), np.zeros(3)
    cube = np.random.default_rng(0).uniform(-1.0, 1.0, (_SAMPLES, 3))
    places = bodies.reach(k) * np.vstack([np.zeros((1, 3)), cube])
    inside = -bodies.distance(k, places)
    return float(inside.max()), places[inside.argmax()]


def between(a: np.ndarray, b: np.ndarray, part: float) -> np.ndarray:
    """Poses (..., 4, 4) at ``part`` of the way from a to b: straight, and about one axis."""
    out = np.array(b, dtype=float)
    out[..., :3, 3] = (1.0 - part) * a[..., :3, 3] + part * b[..., :3, 3]
    turn = np.swapaxes(a[..., :3, :3], -1, -2) @ b[..., :3, :3]
    if not np.array_equal(a[..., :3, :3], b[..., :3, :3]):
        vector = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec()
        out[..., :3, :3] = a[..., :3, :3] @ Rotation.from_rotvec(part * vector).as_matrix().reshape(turn.shape)
    return out


def pieces(a: np.ndarray, b: np.ndarray, longest: float, bodies: RigidBodies) -> Iterator[np.ndarray]:
    """Poses (B, K, 4, 4) on the way from a to b, ending with b, none further than ``longest`` [m] from the one
    before."""
    way = np.linalg.norm(b[..., :3, 3] - a[..., :3, 3], axis=-1)
    cosine = 0.5 * (np.einsum("...ij,...ij->...", a[..., :3, :3], b[..., :3, :3]) - 1.0)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0)) * (cosine < 1.0 - 1e-12)
    reach = np.array([min(bodies.reach(k), 1.0) for k in range(len(bodies))])
    count = int(np.clip(np.ceil(((way + angle * reach) / longest).max() - 1e-9), 1, _MOST))
    for i in range(1, count):
        yield between(a, b, i / count)
    yield b


def ratio(first: np.ndarray, second: np.ndarray, third: np.ndarray) -> np.ndarray:
    """Length of the step second -> third over that of first -> second for each touch (B,) [-]: 1 for even steps, at
    most 2, and 0 if it turns back."""
    last = (second - first)[..., :3, 3].reshape(len(second), -1)
    now = (third - second)[..., :3, 3].reshape(len(second), -1)
    size = np.linalg.norm(last, axis=1)
    even = np.linalg.norm(now, axis=1) / np.where(size > 0.0, size, 1.0)
    return np.minimum(np.where(((now * last).sum(axis=1) > 0.0) & (size > 0.0), even, 0.0), 2.0)


def outside(bodies: RigidBodies, model: Model, pose: np.ndarray, gap: np.ndarray) -> np.ndarray:
    """First poses (B, K, 4, 4) to approach from: ``pose`` where it is clear of the object at rest or barely in it, else
    a pose moved straight out of it.

    Args:
        bodies: the rigid bodies (K).
        model: the object.
        pose: poses (B, K, 4, 4).
        gap: least gap of each touch there (B,) [m].
    """
    out, mesh = pose.copy(), model.mesh
    surface, solid = mesh.points[mesh.surface_nodes()], mesh.faces.shape[1] == 6
    for k in range(len(bodies)):
        inner, centre = _inner_ball(bodies, k)
        deep = _DEEP * inner if np.isfinite(inner) else model.element_size
        if solid:  # of a thin wall both faces may lie in a large body that is barely in it
            deep = min(deep, mean_thickness(model))
        within = np.zeros(len(pose), bool)
        if solid and np.isfinite(inner):  # a body wholly inside has no surface in it
            middle = pose[:, k, :3, 3] + pose[:, k, :3, :3] @ centre
            within = winding_number(mesh.points, mesh.faces[:, :3], middle) > 0.5
        for b in np.flatnonzero((gap < -deep) | within):
            turn, at = pose[b, k, :3, :3], pose[b, k, :3, 3]

            def depth(shift: np.ndarray, k: int = k, turn: np.ndarray = turn, at: np.ndarray = at,
                      centre: np.ndarray = centre) -> float:
                """Of the deepest surface node in the body; infinite where the whole body is within the object."""
                deepest = -float(bodies.distance(k, (surface - at - shift) @ turn).min())
                within = solid and deepest <= 0.0 and winding_number(
                    mesh.points, mesh.faces[:, :3], (at + shift + turn @ centre)[None])[0] > 0.5
                return float("inf") if within else deepest

            if depth(np.zeros(3)) > deep:
                out[b, k, :3, 3] = at + _way_out(depth, turn, bodies, k, (surface - at) @ turn,
                                                 np.ptp(surface, axis=0).max())
    return out


def _way_out(depth: Callable[[np.ndarray], float], turn: np.ndarray, bodies: RigidBodies, k: int, local: np.ndarray,
             size: float) -> np.ndarray:
    """The shortest straight shift (3,) [m] that frees a body, among the axes (not down) and away from its deepest
    point."""
    deepest = local[bodies.distance(k, local).argmin()]
    h = 1e-6
    slope = np.array([bodies.distance(k, deepest + h * e) - bodies.distance(k, deepest - h * e) for e in np.eye(3)])
    normal = turn @ (slope / max(float(np.linalg.norm(slope)), 1e-12))
    ways = [np.array(w, float) for w in ((0, 0, 1), (1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0))] + [-normal]
    for length in size * np.linspace(0.02, 2.0, 100):
        for way in ways:
            if depth(length * way) <= 0.0:
                return length * way
    return np.zeros(3)
