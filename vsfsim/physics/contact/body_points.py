"""Edges, corners and rims of rigid bodies as contact points against the deformed faces of an object.

The contact points of a face (`patch`) do not feel an edge or a corner that lies between them. So the sharp features of
the bodies carry points of their own, and each acts on the face that it meets:

    g = n . (p - x(xi)),   f = -k(g) g n     on the face at xi

p is the point of the body, x(xi) the nearest point of the deformed boundary and n the direction between them, outward.
Face, xi and n are found by geometry and are fixed while Newton's method runs, so that the step has a potential; they
are found again at the equilibrium, which is repeated until they stay (`BodyPoints.renew`). So they depend on the state
that is found and not on the way to it.

A load on a point or a line sinks into a solid further than elements of size h can show. The stiffness k is therefore
that of the indentation that is missing down to the depth `SOFT` h, and that of the penalty below it:

    line of length l:  0.7 E/(1 - nu^2) l        (a wedge of 90 degrees: its force grows with its depth)
    corner:            E/(1 - nu^2) times that depth     (a cone: its force grows with its depth squared)

(Johnson 1985, Contact Mechanics, sections 5.2 and 5.3, without the logarithm of the wedge).
"""

import functools
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.core.shape import Plane
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import inner_radius, sharp_samples
from vsfsim.physics.contact.patch import PENALTY, Patch, poisson_ratio
from vsfsim.physics.elements import closest_point
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import real, vec3

SPACING = 0.15
"""Distance of the points along an edge, over the element size [-]."""
SOFT = 0.03
"""Depth down to which a point sinks in locally, over the element size [-]: below what the check by geometry allows."""
_SMALL = 0.15  # the same over the inner radius of the smallest body
_AREA = 0.06  # of the face that a point stands for below that depth, over the square of the element size
_LINE = 0.7  # stiffness of a line over E/(1 - nu^2) and its length
_NEAR = 0.3  # gap up to which a point of a body is kept ready, over the element size
_FACING = -0.1  # largest cosine between the outward directions of a body and of the object where they meet
_GAP, _SHIFT = 1.0, 0.3  # changes that ask for a new equilibrium: of a gap over the soft depth, of a place over h
_TINY = 1e-4  # depth at which a point is added or taken away, over the element size
_RENEWALS = 3  # times in a step; a body that is then inside is marked all the same, see `intrusion`


@dataclass(frozen=True)
class Met:
    """The points of the bodies that one touch meets (n)."""

    sample: np.ndarray
    """Which of the points (n,)."""
    face: np.ndarray
    """Boundary triangle that each meets (n,)."""
    values: np.ndarray
    """Shape values of the place on it (n, 6)."""
    normal: np.ndarray
    """Direction in which the object is left there (n, 3) [-], world."""
    gap: np.ndarray
    """Gap there when it was found (n,) [m], negative inside."""

    def pick(self, which: np.ndarray) -> "Met":
        """Some of them."""
        return Met(self.sample[which], self.face[which], self.values[which], self.normal[which], self.gap[which])

    def places(self, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Where they lie (n, 3) [m] on ``faces`` (f, 6) whose nodes are at ``points`` (m, 3) [m]."""
        return np.einsum("na,nac->nc", self.values, points[faces[self.face]])


NONE = Met(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 6)), np.zeros((0, 3)), np.zeros(0))
"""No point."""


class BodyPoints:
    """The points of the bodies of a batch of B touches.

    Args:
        model: the object; a sheet meets none, since it has no inside.
        bodies: the rigid bodies (K).
        batch: B.
        device: Warp device.
    """

    met: list[Met]
    """What each touch meets (B)."""
    spot: np.ndarray
    """The points in the frames of their bodies (m, 3) [m]."""
    body: np.ndarray
    """Their bodies (m,)."""
    least: float
    """Least element size for the stiffness of the faces under these bodies [m], 0 without any point, see
    `patch.make_patch`."""

    def __init__(self, model: Model, bodies: RigidBodies, batch: int, *, device: str):
        self.model, self.device = model, device
        size = model.element_size
        least = min(inner_radius(s) for s in bodies.shapes)
        solid = model.mesh.faces.shape[1] == 6
        found = [sharp_samples(s if solid else Plane(), SPACING * size) for s in bodies.shapes]
        self.spot, self._outward, self._length = (np.concatenate([f[i] for f in found]) for i in range(3))
        self.body = np.repeat(np.arange(len(found)), [len(f[0]) for f in found])
        self.least = size if len(self.spot) else 0.0
        self._soft = min(SOFT * size, _SMALL * least)
        self._size, self._near = size, min(_NEAR * size, 2.0 * least)
        self.met = [NONE] * batch
        self._renewals = 0
        if len(self.spot):
            self._kernels = kernels()
            self._faces = torch.as_tensor(model.mesh.faces[None].astype(np.int32), device=device)
            self._rest = torch.as_tensor(model.mesh.points, device=device)

    def begin_step(self) -> None:
        """A step begins: the points may be found again."""
        self._renewals = 0

    def stiffness(self, met: Met) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Stiffness below the soft depth (n,) [N/m], the part of it that acts down to there (n,) [-], and that depth
        (n,) [m]."""
        young = self.model.surface_modulus[met.face]
        most = _AREA * PENALTY * young * self._size
        length = self._length[met.sample]
        plane = young / (1.0 - (poisson_ratio(self.model) or 0.0) ** 2)
        soft = plane * np.where(length > 0.0, _LINE * length, self._soft)
        return most, np.minimum(soft / most, 1.0), np.full(len(young), self._soft)

    def renew(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor,
              patches: Sequence[Patch]) -> tuple[list[int], np.ndarray]:
        """Find the places of the points on the deformed boundary again.

        Args:
            columns: touches (k,).
            pose: poses (B, K, 4, 4).
            u: displacements (3 n, B) [m].
            patches: of all touches (B).

        Returns:
            The touches whose points have changed, and faces outside their patches that are met (B, F) bool.
        """
        outside = np.zeros((len(self.met), len(self.model.mesh.faces)), bool)
        if not len(self.spot) or self._renewals >= _RENEWALS:
            return [], outside
        changed = []
        points = self.model.mesh.points
        for b, new in zip(columns.tolist(), self._find(columns, pose, u, self._near), strict=True):
            known = np.isin(new.face, patches[b].faces)
            outside[b, new.face[~known & (new.gap < 0.0)]] = True
            new = new.pick(known)
            moved = points + u[:, b].cpu().numpy().reshape(-1, 3)
            if outside[b].any() or self._differ(self.met[b], new, pose[b], moved):
                self.met[b] = new
                changed.append(b)
        self._renewals += bool(changed)
        return changed, outside

    def add(self, columns: torch.Tensor, poses: tuple[np.ndarray, np.ndarray], u: torch.Tensor,
            patches: Sequence[Patch]) -> bool:
        """Add points that a step may meet, before it is made: their places are those of the boundary as it was.

        A long step would otherwise begin without them and end deep in the object, where the nearest boundary is that
        beside the body.

        Args:
            columns, u, patches: see `renew`; the displacements are those before the step.
            poses: before and after the step (B, K, 4, 4).

        Returns:
            Whether any touch has more points.
        """
        more = False
        if not len(self.spot):
            return more
        way = float(np.linalg.norm((poses[1] - poses[0])[..., :3, 3], axis=-1).max())
        for b, new in zip(columns.tolist(), self._find(columns, poses[1], u, self._near + way), strict=True):
            new = new.pick(np.isin(new.face, patches[b].faces) & ~np.isin(new.sample, self.met[b].sample))
            if len(new.sample):
                both = zip(astuple(self.met[b]), astuple(new), strict=True)
                self.met[b], more = Met(*(np.concatenate(pair) for pair in both)), True
        return more

    def _differ(self, old: Met, new: Met, pose: np.ndarray, points: np.ndarray) -> bool:
        """Whether the contact at ``new`` is another than that at ``old``, with the nodes at ``points`` (n, 3) [m] and
        the bodies at ``pose`` (K, 4, 4)."""
        place, depth = np.full((2, len(self.spot), 3), np.nan), np.zeros((2, len(self.spot)))
        for k, met in enumerate((old, new)):
            at = self.body[met.sample]
            spot = pose[at, :3, 3] + np.einsum("nij,nj->ni", pose[at, :3, :3], self.spot[met.sample])
            place[k, met.sample] = met.places(self.model.mesh.faces, points)
            depth[k, met.sample] = np.einsum("nc,nc->n", met.normal, spot - place[k, met.sample]).clip(max=0.0)
        shift = np.linalg.norm(place[0] - place[1], axis=1)  # NaN of points that only one of them has
        most = np.where(np.isnan(shift), _TINY * self._size, _GAP * self._soft)
        acts = depth.min(axis=0) < 0.0
        return bool(((np.abs(depth[0] - depth[1]) > most) | (acts & (shift > _SHIFT * self._size))).any())

    def _find(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor, near: float) -> list[Met]:
        k, device, count = self._kernels, self.device, len(columns)
        host = columns.cpu().numpy()
        moved = u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        x = (self._rest + moved).contiguous()
        turn, origin = pose[host][:, :, :3, :3][:, self.body], pose[host][:, :, :3, 3][:, self.body]
        spot = origin + np.einsum("kmij,mj->kmi", turn, self.spot)
        outward = np.einsum("kmij,mj->kmi", turn, self._outward)
        face = torch.full((count, len(self.spot)), -1, dtype=torch.int32, device=device)
        values = torch.zeros((count, len(self.spot), 6), dtype=torch.float64, device=device)
        normal = torch.zeros((count, len(self.spot), 3), dtype=torch.float64, device=device)
        gap = torch.zeros((count, len(self.spot)), dtype=torch.float64, device=device)
        wp.launch(k.find, dim=face.shape, device=device, inputs=[
            wp.from_torch(self._faces.expand(count, -1, -1)), near, 1e-3 * self._size,
            wp.array(spot, dtype=k.vec3, device=device), wp.array(outward, dtype=k.vec3, device=device),
            wp.from_torch(x, dtype=k.vec3), wp.from_torch(closest_point.balls(x, self._faces), dtype=k.vec4),
            wp.from_torch(face),
            wp.from_torch(values, dtype=k.vec6), wp.from_torch(normal, dtype=k.vec3), wp.from_torch(gap)])
        out = []
        for f, v, n, g in zip(*(t.cpu().numpy() for t in (face, values, normal, gap)), strict=True):
            on = np.flatnonzero(f >= 0)
            out.append(Met(on, f[on].astype(np.int64), v[on], n[on], g[on]))
        return out


@dataclass(frozen=True)
class Padded:
    """The patches of B touches and the points of bodies that they meet, padded to s nodes and f parts."""

    nodes: np.ndarray
    """Nodes of the patches (B, s); -1 is padding."""
    member: np.ndarray
    """Boundary triangles of the patches (B, F) bool."""
    local: np.ndarray
    """Positions in `nodes` of the nodes of each part (B, f, 6)."""
    shape: np.ndarray
    """Shape values of the points of the parts (B, f, 6, 6)."""
    stiffness: np.ndarray
    """Of each contact point (B, f, 6) [N/m]; a point of a body is the first of a part of its own."""
    key: np.ndarray
    """Of each part (B, f): its boundary triangle, or F and the number of the point of a body; -1 is padding."""
    area: np.ndarray
    """Of each part (B, f) [m^2], 0 of points of bodies."""
    host: np.ndarray
    """The body whose point a part is (B, f); -1 for parts of a face."""
    spot: np.ndarray
    """That point in the frame of its body (B, f, 3) [m]."""
    leave: np.ndarray
    """Direction in which it leaves the object (B, f, 3) [-]."""
    share: np.ndarray
    """Share of the stiffness of points of bodies that acts at first (B, f) [-]."""
    soft: np.ndarray
    """Depth down to which it does (B, f) [m]."""

    def places(self, touch: int, points: np.ndarray) -> np.ndarray:
        """The contact points of a touch (6 f, 3) [m] on a mesh whose nodes are at ``points`` (n, 3) [m]."""
        return (self.shape[touch] @ points[self.nodes[touch][self.local[touch]]]).reshape(-1, 3)


def pad(patches: Sequence[Patch], faces: np.ndarray, least: int, points: BodyPoints) -> Padded:
    """The patches (B) of a mesh with the boundary triangles ``faces`` (F, 6 or 3), of ``least`` parts, and the points
    of bodies that they meet."""
    member = np.zeros((len(patches), len(faces)), bool)
    parts = []
    for p, met, row in zip(patches, points.met, member, strict=True):
        row[p.faces] = True
        n, more = len(met.sample), (len(met.sample), 6)
        local, shape, stiffness = np.zeros(more, np.int64), np.zeros((*more, 6)), np.zeros(more)
        local[:, :faces.shape[1]], shape[:, 0] = np.searchsorted(p.nodes, faces[met.face]), met.values
        stiffness[:, 0], share, soft = points.stiffness(met)
        none = np.zeros((len(p.local), 3))
        of_face = p.local, p.shapes, p.stiffness, np.repeat(p.faces, p.cuts**2), p.area, none[:, 0] - 1, none, none
        of_body = (local, shape, stiffness, len(faces) + met.sample, np.zeros(n), points.body[met.sample],
                   points.spot[met.sample], met.normal)
        parts.append([*(np.concatenate(both) for both in zip(of_face, of_body, strict=True)),
                      *(np.concatenate([none[:, 0], own]) for own in (share, soft))])
    local, shape, stiffness, key, area, host, *others = (
        _stacked(own, least, fill) for own, fill in zip(zip(*parts, strict=True), (
            0, 0, 0, -1, 0, -1, 0, 0, 0, 0), strict=True))
    return Padded(_stacked([p.nodes for p in patches], 1, -1), member, local.astype(np.int32), shape, stiffness, key,
                  area, host.astype(np.int32), *others)


def _stacked(rows: Sequence[np.ndarray], least: int, fill: int) -> np.ndarray:
    """Arrays (n, ...) padded to their longest, or to ``least``."""
    out = np.full((len(rows), max(least, *map(len, rows)), *rows[0].shape[1:]), fill, rows[0].dtype)
    for own, row in zip(out, rows, strict=True):
        own[:len(row)] = row
    return out


@functools.cache
def kernels() -> Any:
    """The kernel that finds the places of points on a deformed boundary, and its types."""
    vec4 = wp.types.vector(length=4, dtype=real)
    vec6 = wp.types.vector(length=6, dtype=real)
    module = "vsfsim_body_points"
    closest = closest_point.functions(module)
    facing = wp.constant(real(_FACING))

    @wp.kernel(module=module, enable_backward=False)
    def find(
        # model
        faces: wp.array3d(dtype=wp.int32),
        near: real,
        tiny: real,
        # state in
        spot: wp.array2d(dtype=vec3),
        outward: wp.array2d(dtype=vec3),
        x_in: wp.array2d(dtype=vec3),
        ball_in: wp.array2d(dtype=vec4),
        # state out
        face_out: wp.array2d(dtype=wp.int32),
        values_out: wp.array2d(dtype=vec6),
        normal_out: wp.array2d(dtype=vec3),
        gap_out: wp.array2d(dtype=real),
    ):
        # the nearest face; behind the middle of a sheet that is its far side, and the nearest that faces the body is
        # taken
        b, i = wp.tid()
        p = spot[b, i]
        least = near
        least_facing = near
        other = real(1.0)
        face = int(-1)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
        values = vec6()
        at = vec3()
        normal = vec3()
        for f in range(faces.shape[1]):
            ball = ball_in[b, f]
            if wp.length(p - vec3(ball[0], ball[1], ball[2])) - ball[3] < least_facing:
                v, c, n = closest.nearest(p, b, f, 6, faces, x_in)
                away = wp.length(p - c)
                if away < least:
                    least = away
                    other = wp.dot(n, p - c)
                if away < least_facing and wp.dot(n, outward[b, i]) < facing:
                    least_facing = away
                    face = f
                    values = v
                    at = c
                    normal = n
        # outside the object, beside a face that does not face the body: no contact
        if face >= 0 and not (least < least_facing and other >= real(0.0)):
            gap = wp.dot(normal, p - at)
            n = (at - p) + tiny * normal
            if gap > real(0.0):
                n = (p - at) + tiny * normal
            n = wp.normalize(n)
            face_out[b, i] = face
            values_out[b, i] = values
            normal_out[b, i] = n
            gap_out[b, i] = wp.dot(n, p - at)

    return SimpleNamespace(find=find, vec3=vec3, vec4=vec4, vec6=vec6)
