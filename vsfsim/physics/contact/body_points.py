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

from collections.abc import Sequence

import numpy as np
import torch

from vsfsim.core.shape import Plane
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import inner_radius, sharp_samples
from vsfsim.physics.contact.intrusion import Enclosure
from vsfsim.physics.contact.patch import NO_PART, PENALTY, Patch, poisson_ratio
from vsfsim.physics.model import Model

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


_MET = np.dtype([("sample", np.int64), ("face", np.int64), ("values", float, 6), ("normal", float, 3), ("gap", float)])
# a point of a body that a touch meets: which of the points, the boundary triangle that it meets, the shape values of
# the place on it, the direction in which the object is left there [-], world, and the gap [m], negative inside


class BodyPoints:
    """The points of the bodies of a batch of B touches.

    Args:
        model: the object; a sheet meets none, since it has no inside.
        bodies: the rigid bodies (K).
        batch: B.
        device: Warp device.
    """

    met: list[np.ndarray]
    """The points that each touch meets (B), (n,) of `_MET`."""
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
        self.met = [np.zeros(0, _MET)] * batch
        self._renewals = 0
        if len(self.spot):
            self._surface = Enclosure(model.mesh.faces, np.zeros((0, 3)), device=device)
            self._rest = torch.as_tensor(model.mesh.points, device=device)

    def begin_step(self) -> None:
        """A step begins: the points may be found again."""
        self._renewals = 0

    def parts(self, touch: int, patch: Patch) -> np.ndarray:
        """The points that a touch meets, as parts (n,) of `PART` with one point each, of its ``patch``."""
        met, faces = self.met[touch], self.model.mesh.faces
        young, length = self.model.surface_modulus[met["face"]], self._length[met["sample"]]
        most = _AREA * PENALTY * young * self._size
        plane = young / (1.0 - (poisson_ratio(self.model) or 0.0) ** 2)
        soft = plane * np.where(length > 0.0, _LINE * length, self._soft)
        out = np.repeat(NO_PART, len(met))
        out["local"][:, :faces.shape[1]] = np.searchsorted(patch.nodes, faces[met["face"]])
        out["shape"][:, 0], out["stiffness"][:, 0], out["leave"] = met["values"], most, met["normal"]
        out["key"] = len(faces) + met["sample"]
        out["host"], out["spot"] = self.body[met["sample"]], self.spot[met["sample"]]
        out["share"], out["soft"] = np.minimum(soft / most, 1.0), self._soft
        return out

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
            known = np.isin(new["face"], patches[b].faces)
            outside[b, new["face"][~known & (new["gap"] < 0.0)]] = True
            new = new[known]
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
            new = new[np.isin(new["face"], patches[b].faces) & ~np.isin(new["sample"], self.met[b]["sample"])]
            if len(new):
                self.met[b], more = np.concatenate([self.met[b], new]), True
        return more

    def _differ(self, old: np.ndarray, new: np.ndarray, pose: np.ndarray, points: np.ndarray) -> bool:
        """Whether the contact at ``new`` is another than that at ``old``, with the nodes at ``points`` (n, 3) [m] and
        the bodies at ``pose`` (K, 4, 4)."""
        place, depth = np.full((2, len(self.spot), 3), np.nan), np.zeros((2, len(self.spot)))
        for k, met in enumerate((old, new)):
            sample, at = met["sample"], self.body[met["sample"]]
            spot = pose[at, :3, 3] + np.einsum("nij,nj->ni", pose[at, :3, :3], self.spot[sample])
            place[k, sample] = np.einsum("na,nac->nc", met["values"], points[self.model.mesh.faces[met["face"]]])
            depth[k, sample] = np.einsum("nc,nc->n", met["normal"], spot - place[k, sample]).clip(max=0.0)
        shift = np.linalg.norm(place[0] - place[1], axis=1)  # NaN of points that only one of them has
        most = np.where(np.isnan(shift), _TINY * self._size, _GAP * self._soft)
        acts = depth.min(axis=0) < 0.0
        return bool(((np.abs(depth[0] - depth[1]) > most) | (acts & (shift > _SHIFT * self._size))).any())

    def _find(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor, near: float) -> list[np.ndarray]:
        count, here = len(columns), pose[columns.cpu().numpy()][:, self.body]
        x = self._rest + u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        spot = here[..., :3, 3] + np.einsum("kmij,mj->kmi", here[..., :3, :3], self.spot)
        outward = np.einsum("kmij,mj->kmi", here[..., :3, :3], self._outward)
        point, outward = (torch.as_tensor(a, device=self.device) for a in (spot, outward))
        _, face, values, normal = self._surface.nearest(x, point, outward, near=near, facing=_FACING)
        corners = x[torch.arange(count, device=self.device)[:, None, None], self._surface.faces[0][face.long()].long()]
        away = point - (values[..., None] * corners).sum(dim=2)
        above = (away * normal).sum(dim=2, keepdim=True) > 0.0
        leave = torch.nn.functional.normalize(torch.where(above, away, -away) + 1e-3 * self._size * normal, dim=2)
        met = np.zeros((count, len(self.spot)), _MET)
        met["sample"] = np.arange(len(self.spot))
        for name, found in (("face", face), ("values", values), ("normal", leave), ("gap", (leave * away).sum(dim=2))):
            met[name] = found.cpu().numpy()
        return [own[own["face"] >= 0] for own in met]


def stacked(rows: Sequence[np.ndarray], fill: np.ndarray) -> np.ndarray:
    """Arrays (n,) padded by ``fill`` (1,) to their longest, to one at the least."""
    width = max(1, *map(len, rows))
    return np.stack([np.concatenate([row, np.repeat(fill, width - len(row))]) for row in rows])


def remember(tensors: Sequence[torch.Tensor], kept: Sequence[torch.Tensor], parts: tuple[np.ndarray, np.ndarray],
             touches: Sequence[int]) -> None:
    """Write the friction state of some ``touches`` into the ``tensors`` (B, f, 6, ...) of their contact points:
    anchors, owners, limits and normals of the tangent planes.

    Points of a face that was in the patch with as many parts, and points of bodies that were met, take what they
    remembered; the others remember nothing.

    Args:
        tensors, touches: see above.
        kept: such tensors of the old points.
        parts: of the old points and of those of the tensors (B, f) of `PART`.
    """
    for b in touches:
        _, was, now = np.intersect1d(*(_names(own["key"][b]) for own in parts), return_indices=True)
        for mine, theirs, nothing in zip(tensors, kept, (0.0, -1, 0.0, 0.0), strict=True):
            mine[b] = nothing
            mine[b, now] = theirs[b, was]


def _names(key: np.ndarray) -> np.ndarray:
    """A number for each part (f,) from its ``key``, how many parts have that key, and which of these it is; those with
    the same key stand together. Padding has numbers of its own, below 0."""
    _, first, of, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    at = np.arange(len(key))
    return np.where(key >= 0, (key * 100 + count[of]) * 100 + at - first[of], -1 - at)
