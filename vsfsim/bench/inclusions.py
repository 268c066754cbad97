"""What the touches of an object reached, and the stiff inclusions hidden in it: the mask and the pose that a method is
scored against.

A surface point is reached where the distance to a rigid probe along its path is small.

Mask: in the view from above, a pixel of 3 mm is stiff if an inclusion lies within 15 mm below it (Neural VSF table I).
The value of a pixel is the largest stiffness that a method gives where the probe swept the column below; pixels that no
touch swept do not count. The threshold is the best one for the method on this object, as in the paper.

Pose: that of the union of the inclusions, whose shape the method knows (Neural VSF section IV-C).

The inclusions are those of the dataset's own scene text, sampled again with its seed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.core import shape as shapes
from vsfsim.core.chain import Chain
from vsfsim.core.dome import Dome
from vsfsim.core.errors import TaskError
from vsfsim.core.material import Inclusion
from vsfsim.core.scene import parse_scene
from vsfsim.core.shape import Capsule, MeshFile, ProbeShape
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView
from vsfsim.data.streams import Stream, stream

REACH = 0.005
"""A point counts as reached within this distance of the probe [m]: the spacing of the papers' particles on shoes."""
SIMPLE = "touches of a dataset have a simple probe"
PIXEL = 0.003
"""Edge of a pixel of the mask [m]."""
STEP = 0.001
"""Distance of the query points in depth [m]."""
DEPTH = 0.015
"""Depth of a column of the mask [m]."""

_SECTORS = 12  # around the axis of a capsule's mesh


def reached(points: np.ndarray, probe: ProbeShape, poses: np.ndarray, *, q: np.ndarray | None = None,
            reach: float = REACH) -> np.ndarray:
    """True where the probe comes within ``reach`` [m] of a point in any frame: (k,) bool.

    Args:
        points: world (k, 3) [m]. probe: its shape. poses: probe-to-world (T, 4, 4) [m]. q: joint angles (T, dof) [rad]
        of an arm, which is reached by all of its capsules.
    """
    out, parts = np.zeros(len(points), bool), [(probe, poses)]
    if isinstance(probe, Chain):
        assert q is not None, "an arm's touch has joint angles"
        at = probe.capsule_poses(probe.links(q))
        parts = [(Capsule(c.radius, float(np.linalg.norm(np.subtract(c.stop, c.start)))), at[:, k])
                 for k, c in enumerate(probe.capsules) if probe.moves(c.link).any()]
    for part, path in parts:
        _mark(out, points, part, path, reach)
    return out


def reached_in(view: ObjectView, points: np.ndarray, *, reach: float = REACH) -> np.ndarray:
    """True where the probe itself comes within ``reach`` [m] of a point (k, 3) [m], world, in some touch: (k,) bool.

    A spring lets the probe give way, so its mount goes deeper than it does. Where the spring's force is unknown, so is
    the place of the probe: such a frame reaches nothing.
    """
    near = np.zeros(len(points), bool)
    for touch in view.touches:
        left = np.flatnonzero(~near)
        known = np.isfinite(touch.force).all(axis=1) if touch.mount_stiffness is not None else slice(None)
        near[left] = reached(points[left], view.probe_of(touch), touch.probe_pose()[known],
                             q=None if touch.q is None else touch.q[known], reach=reach)
    return near


def _mark(out: np.ndarray, points: np.ndarray, probe: ProbeShape, poses: np.ndarray, reach: float) -> None:
    """Set ``out`` where the probe comes near. Only points in a ball about the probe are measured: an arm has a dozen
    capsules, most of them far from the object in every frame, and most points are far from any path."""
    assert not isinstance(probe, MeshFile | Chain), SIMPLE
    ball = 1.001 * (shapes.reach(probe) + 2.0 * reach)
    at = poses[:, :3, 3]
    low, high = at.min(axis=0, initial=np.inf) - ball, at.max(axis=0, initial=-np.inf) + ball
    inside = np.flatnonzero(~out & ((points >= low) & (points <= high)).all(axis=1))
    for pose in poses:
        left = inside[~out[inside]]
        local = points[left] - pose[:3, 3]
        near = (local**2).sum(axis=1) <= ball**2
        if near.any():
            out[left[near]] = distance(local[near] @ pose[:3, :3], probe) <= reach


def distance(local: np.ndarray, probe: ProbeShape) -> np.ndarray:
    """Distance (k,) [m] from points (k, 3) [m] in the probe's frame to its solid; 0 or negative inside."""
    if isinstance(probe, Dome):
        return _from_dome(local, probe)
    assert not isinstance(probe, MeshFile | Chain), SIMPLE
    return shapes.distance(probe, local)


def _from_dome(local: np.ndarray, dome: Dome) -> np.ndarray:
    """To its nearest vertex, negative under the skin; one farther than twice `REACH` outside its bounding box is not
    measured: infinite."""
    out = np.full(len(local), np.inf)
    low, high = dome.points.min(axis=0) - 2.0 * REACH, dome.points.max(axis=0) + 2.0 * REACH
    near = np.flatnonzero(((local >= low) & (local <= high)).all(axis=1))
    if not len(near):
        return out
    at = local[near]
    away = dome.to_vertices(at)
    beside = np.flatnonzero((at[:, 2] >= 0.0) & (at[:, 2] <= dome.height))  # the others are over or behind the skin
    under = beside[at[beside, 2] <= dome.heights(at[beside, :2])]
    away[under] *= -1.0
    out[near] = away
    return out


@dataclass(frozen=True)
class Inclusions:
    """The inclusions of one object."""

    parts: tuple[Inclusion, ...]
    """In the object's frame."""
    rotation: np.ndarray
    """From there to the world (3, 3)."""
    shift: np.ndarray
    """From there to the world (3,) [m]."""

    @classmethod
    def of(cls, recipe: Recipe, view: ObjectView) -> Inclusions:
        """The inclusions of an object of a dataset.

        Raises:
            TaskError: the scene has no inclusions.
        """
        seed = stream(recipe.seed, Stream.SCENE, view.object_index)
        scene = parse_scene(recipe.scene_text, f"{recipe.scene}.toml").sample(seed, number=view.object_index)
        assert scene.object is not None
        parts = scene.object.young_modulus.inclusions
        if not parts:
            raise TaskError(f"object view '{view.name}' has no inclusions to find; use a scene with "
                            f"[object.young_modulus] inclusions.")
        c, s = np.cos(scene.object.yaw), np.sin(scene.object.yaw)
        return cls(parts, np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array(scene.object.pose))

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Whether each point (k, 3) [m], world, lies in an inclusion (k,) bool."""
        local = (points - self.shift) @ self.rotation
        return np.min([part.distance(local) for part in self.parts], axis=0) <= 0.0

    def known_object(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (n, 3) [m] and triangles (m, 3) of the union, closed parts that may overlap, around its centre; and
        its pose (4, 4)."""
        vertices, triangles, count = [], [], 0
        for part in self.parts:
            v, t = mesh_of(part)
            vertices.append(v)
            triangles.append(t + count)
            count += len(v)
        joined = np.concatenate(vertices)
        centre = 0.5 * (joined.min(axis=0) + joined.max(axis=0))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = self.rotation, self.rotation @ centre + self.shift
        return joined - centre, np.concatenate(triangles), pose


@dataclass(frozen=True)
class Columns:
    """The columns under the p pixels of an object seen from above which its touches swept."""

    points: np.ndarray
    """Query points that the probe swept, world (q, 3) [m]."""
    pixel: np.ndarray
    """Pixel of each query point (q,) int."""
    every: np.ndarray
    """All points of the columns, swept or not, (p, m, 3) [m]."""

    @classmethod
    def of(cls, surface: np.ndarray, view: ObjectView) -> Columns:
        """The columns under the surface points (P, 3) [m] of one object view.

        Raises:
            TaskError: no touch swept anything.
        """
        axes = [np.arange(low + 0.5 * PIXEL, high, PIXEL)
                for low, high in zip(surface[:, :2].min(axis=0), surface[:, :2].max(axis=0), strict=True)]
        plane = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        nearest = np.argmin(np.linalg.norm(plane[:, None] - surface[None, :, :2], axis=2), axis=1)
        top = np.concatenate([plane, surface[nearest, 2:]], axis=1)
        columns = top[:, None] - np.arange(0.5 * STEP, DEPTH, STEP)[:, None] * np.array([0.0, 0.0, 1.0])
        reach = reached_in(view, columns.reshape(-1, 3), reach=0.0).reshape(columns.shape[:2])
        swept = reach.any(axis=1)
        if not swept.any():
            raise TaskError(f"object view '{view.name}': no touch swept any of it, so that no mask can be found; "
                            f"generate touches that go deeper.")
        return cls(columns[reach], np.nonzero(reach[swept])[0], columns[swept])

    def covers(self, inclusions: Inclusions) -> np.ndarray:
        """The mask: whether an inclusion lies under each pixel (p,) bool."""
        return np.any(inclusions.inside(self.every.reshape(-1, 3)).reshape(len(self.every), -1), axis=1)

    def largest(self, stiffness: np.ndarray) -> np.ndarray:
        """The largest of a method's stiffnesses at the query points (q,) under each pixel (p,)."""
        value = np.full(len(self.every), -np.inf)
        np.maximum.at(value, self.pixel, stiffness)
        return value


def mesh_of(part: Inclusion) -> tuple[np.ndarray, np.ndarray]:
    """A closed mesh, wound outwards: vertices (n, 3) [m], triangles (m, 3)."""
    n = np.asarray(part.numbers)
    if part.kind == "box":
        low, high = np.minimum(n[:3], n[3:]), np.maximum(n[:3], n[3:])
        corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
        faces = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
        return low + corners * (high - low), np.array([t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])
    start, end, radius = (n[:3], n[:3], n[3]) if part.kind == "sphere" else (n[:3], n[3:6], n[6])
    along = end - start
    length = float(np.linalg.norm(along))
    axis = along / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(axis, side), axis], axis=1)
    # Rings from the lower pole to the upper one; there are two equators, one at each end of the axis.
    angle = np.linspace(-0.5 * np.pi, 0.0, _SECTORS // 2 + 1)[1:]
    rings = [(radius * np.cos(a), radius * np.sin(a)) for a in angle]
    rings += [(radius * np.cos(a), radius * np.sin(-a) + length) for a in angle[::-1]]
    turn = 2.0 * np.pi * np.arange(_SECTORS) / _SECTORS
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    local = [np.array([[0.0, 0.0, -radius]]),
             *(np.concatenate([r * circle, np.full((_SECTORS, 1), h)], axis=1) for r, h in rings),
             np.array([[0.0, 0.0, length + radius]])]
    triangles, last = [], 1 + _SECTORS * len(rings)
    for j in range(_SECTORS):
        k = (j + 1) % _SECTORS
        triangles += [(0, 1 + k, 1 + j), (last, last - _SECTORS + j, last - _SECTORS + k)]
        for ring in range(len(rings) - 1):
            a, b = 1 + ring * _SECTORS, 1 + (ring + 1) * _SECTORS
            triangles += [(a + j, a + k, b + k), (a + j, b + k, b + j)]
    return start + np.concatenate(local) @ frame.T, np.array(triangles)
