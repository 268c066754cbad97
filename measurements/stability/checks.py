"""Checks of a press that do not trust the solver's verdict: each looks at the frames that are called converged.

A check returns sentences, one for each frame that it contradicts. The tolerances are wide of what a correct frame can
do, so that a sentence means a wrong frame and not a coarse one.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import cKDTree
from trimesh.triangles import closest_point

from measurements.stability.evidence import Evidence
from vsfsim.core.shape import Plane, ProbeShape
from vsfsim.generate.boundary import deformed_surface
from vsfsim.physics.contact import sdf
from vsfsim.sensing.tessellate import tessellate

FALL = 0.03  # of the largest push so far, by which the push may fall in a press that only goes inward [-]
SHALLOW = 0.01  # of an element's edge, up to which a body may rest in the surface without a push [-]
WORK = 0.03  # of the largest energy, by which a step's work may leave its bounds [-]
BALANCE = 0.02  # unbalanced over acting force of a converged frame [-]
BURIED = 0.05  # of an element's edge, that a point of a rigid body may lie inside the body beyond what is reported [-]
INSIDE = 0.02  # of an element's edge, likewise for the surface inside a rigid body [-]
PATH = 0.02  # difference of the last push when the number of frames is doubled, without friction [-]
TIER = 0.10  # difference of the last push between tier fem-coarse and tier fem, where the mesh resolves both [-]
DEEPEST = 50  # points of a rigid body, deepest behind tangent planes, whose distance is computed
CLOSELY = 12  # parts of an edge of a boundary triangle, when a contradiction is looked at again
SAMPLES = 20_000  # points on a rigid body, at most


def contradictions(e: Evidence) -> list[str]:
    """All sentences of all checks of one press."""
    return [sentence for check in (_balanced, _monotone, _work, _geometry, _pair, _volume, _jump)
            for sentence in check(e)]


def compare(e: Evidence, other: Evidence, allowed: float, what: str) -> list[str]:
    """Compare the last push of a press with that of another way to it."""
    if not (e.resolved[-1] and other.resolved[-1]):
        return []
    a, b = float(e.push[-1]), float(other.push[-1])
    if abs(a - b) <= allowed * max(abs(a), abs(b)):
        return []
    return [f"last frame: the push is {a:.4g} N, and {b:.4g} N {what}"]


def _balanced(e: Evidence) -> Iterator[str]:
    for t in np.flatnonzero(e.converged):
        if not (np.isfinite(e.force[t]).all() and np.isfinite(e.balance[t])):
            yield f"frame {t + 1}: a number is not finite"
        elif e.balance[t] > BALANCE:
            yield f"frame {t + 1}: {100 * e.balance[t]:.2g} % of the force is unbalanced"


def _monotone(e: Evidence) -> Iterator[str]:
    """A body that only goes deeper is pushed back harder."""
    if e.jumped is not None:
        return  # a rod slips off, and its push falls as it leans
    most = 0.0
    for t in range(e.straight):
        if e.converged[t] and e.depth[t] > SHALLOW * e.edge:
            if e.push[t] < (1.0 - FALL) * most or (e.push[t] <= 0.0 and not e.heavy):
                yield (f"frame {t + 1}: the push is {e.push[t]:.4g} N after {most:.4g} N in an earlier frame, and the "
                       f"body went only deeper")
            most = max(most, float(e.push[t]))


def _work(e: Evidence) -> Iterator[str]:
    """The energy grows by the work of the push, which is between those of the push before and after the step."""
    if not e.conservative:
        return
    largest = np.nanmax(np.where(e.converged, e.energy, np.nan), initial=0.0)
    before = (0.0, 0.0, 0.0)  # depth, push, energy
    for t in range(e.straight):
        now = (float(e.depth[t]), float(e.push[t]), float(e.energy[t]))
        if not e.converged[t]:
            return
        way, low, high = now[0] - before[0], min(now[1], before[1]), max(now[1], before[1])
        gained = now[2] - before[2]
        slack = WORK * largest
        if e.jumped is None and not low * way - slack <= gained <= high * way + slack:
            yield (f"frame {t + 1}: the energy grew by {gained:.3g} J, and the push did between {low * way:.3g} and "
                   f"{high * way:.3g} J of work")
        before = now


def _geometry(e: Evidence) -> Iterator[str]:
    """No point of a rigid body lies inside the deformed body, and no point of its surface inside a rigid body, by more
    than what is reported."""
    if e.poses is None:
        return
    for t in np.flatnonzero(e.converged):
        if not np.isfinite(e.surface[t][0]).all():
            continue
        found = list(_overlaps(e, t, *e.surface[t]))
        if found and e.mesh is not None and e.moved is not None:
            # flat triangles cut off what a curved face of a few of them bulges: look again with many
            found = list(_overlaps(e, t, *deformed_surface(e.mesh, e.moved[t], parts=CLOSELY)[:2]))
        yield from found


def _overlaps(e: Evidence, t: int, vertices: np.ndarray, triangles: np.ndarray) -> Iterator[str]:
    """Sentences on frame t with this deformed surface."""
    bodies = [] if e.poses is None else list(zip(e.shapes, e.poses[t], strict=True))
    inside = max(float(-sdf.distance(shape, (vertices - pose[:3, 3]) @ pose[:3, :3]).min()) for shape, pose in bodies)
    told = float(e.penetration[t])
    if inside > 1.5 * told + INSIDE * e.edge:
        yield (f"frame {t + 1}: the surface lies {1e6 * inside:.3g} um inside a rigid body, and {1e6 * told:.3g} "
               f"um are reported (element edge {1e3 * e.edge:.3g} mm)")
    buried = max((_buried(shape, pose, vertices, triangles, e.edge) for shape, pose in bodies), default=0.0)
    if buried > 1.5 * told + BURIED * e.edge:
        yield (f"frame {t + 1}: a rigid body lies {1e6 * buried:.3g} um inside the object, and {1e6 * told:.3g} um "
               f"are reported (element edge {1e3 * e.edge:.3g} mm)")


def _pair(e: Evidence) -> Iterator[str]:
    """No point of a membrane lies inside the deformed object, and none of the object behind the membrane, by more than
    what is reported."""
    for t in np.flatnonzero(e.converged) if len(e.membrane) else ():
        depth = 0.0
        for own, other in ((e.membrane[t], e.surface[t]), (e.surface[t], e.membrane[t])):
            depth = max(depth, _inside(_samples(*own, e.edge / 4.0), *other, e.edge))
        if depth > 1.5 * e.penetration[t] + INSIDE * e.edge:
            yield (f"frame {t + 1}: object and membrane lie {1e6 * depth:.3g} um in one another, and "
                   f"{1e6 * e.penetration[t]:.3g} um are reported (element edge {1e3 * e.edge:.3g} mm)")


def _buried(shape: ProbeShape, pose: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, edge: float) -> float:
    """How deep the points of a rigid body lie inside a closed surface, at most [m]."""
    if isinstance(shape, Plane):
        return 0.0  # the surface would lie inside the half-space
    return _inside(_samples(*tessellate(shape, 1.0), edge / 4.0) @ pose[:3, :3].T + pose[:3, 3], vertices, triangles,
                   edge)


def _inside(points: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, edge: float) -> float:
    """How deep points lie inside a closed surface, at most [m].

    A point is inside if it is behind the tangent plane of the nearest vertex; its depth is its distance to the nearest
    triangle.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    points = points[((points > low) & (points < high)).all(axis=1)]
    if not len(points):
        return 0.0
    corner = vertices[triangles]
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normal, triangles[:, k], across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    used = np.unique(triangles)
    _, nearest = cKDTree(vertices[used]).query(points)
    nearest = used[nearest]
    behind = np.einsum("pc,pc->p", vertices[nearest] - points, normal[nearest])
    deepest = 0.0
    middles = cKDTree(corner.mean(axis=1))
    for p in np.argsort(-behind)[:DEEPEST]:
        _, around = middles.query(points[p], k=min(60, len(corner)))
        # in units of an edge: trimesh's function has a tolerance that is a length
        there = closest_point(corner[around] / edge, np.repeat(points[p][None] / edge, len(around), axis=0))
        distance = edge * np.linalg.norm(there - points[p] / edge, axis=1)
        face = around[int(np.argmin(distance))]
        if behind[p] > 0.0 and (points[p] - corner[face, 0]) @ across[face] < 0.0:
            deepest = max(deepest, float(distance.min()))
    return deepest


def _samples(vertices: np.ndarray, triangles: np.ndarray, spacing: float) -> np.ndarray:
    """Points (s, 3) [m] on triangles, ``spacing`` [m] apart or `SAMPLES` in all."""
    points, corner = [vertices], vertices[triangles]
    while len(corner):
        side = np.linalg.norm(corner - np.roll(corner, 1, axis=1), axis=2).max(axis=1)
        corner = corner[side > spacing]
        if 3 * len(corner) + sum(map(len, points)) > SAMPLES:
            break
        middle = 0.5 * (corner + np.roll(corner, -1, axis=1))
        points.append(middle.reshape(-1, 3))
        corner = np.concatenate([np.stack([corner[:, k], middle[:, k], middle[:, k - 1]], axis=1) for k in range(3)]
                                + [middle])
    return np.concatenate(points)


def _volume(e: Evidence) -> Iterator[str]:
    """No element is inside out or nearly without volume at its Gauss points."""
    if e.mesh is None or e.moved is None or not e.large:
        return
    rest = e.mesh.points[e.mesh.tets]
    edges = np.swapaxes(rest[:, 1:4] - rest[:, :1], 1, 2)
    inner = np.linalg.inv(edges)  # rows: gradients of the barycentric coordinates 1 to 3
    slope = np.concatenate([-inner.sum(axis=1, keepdims=True), inner], axis=1)
    a, b = 0.5854101966249685, 0.1381966011250105
    for t in np.flatnonzero(e.converged):
        moved = e.moved[t][e.mesh.tets]
        least = np.inf
        for q in range(4):
            at = np.full(4, b)
            at[q] = a
            rows = [(4 * at[i] - 1) * slope[:, i] for i in range(4)]
            rows += [4 * (at[i] * slope[:, j] + at[j] * slope[:, i])
                     for i, j in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))]
            change = np.einsum("mai,maj->mij", moved, np.stack(rows, axis=1))
            least = min(least, float(np.linalg.det(np.eye(3) + change).min()))
        if least < 0.1:
            yield f"frame {t + 1}: det F is {least:.3g} at a Gauss point, below 0.1"


def _jump(e: Evidence) -> Iterator[str]:
    if e.jumped is not None:
        for t in np.flatnonzero(e.converged & e.jumped):
            yield f"frame {t + 1}: the rod stands behind the capsule, which it cannot have passed"
