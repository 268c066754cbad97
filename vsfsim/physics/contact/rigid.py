"""Contact of a batch of touches with one body: who can meet whom, gaps, forces, and the stiffness that they add.

Each touch (column) has a patch: the boundary triangles that its rigid bodies can reach. All are tensors over all
touches, padded to the largest patch.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
import warp as wp

from vsfsim.core.shape import Capsule, Plane, Sphere
from vsfsim.physics.contact import condensed
from vsfsim.physics.contact import rigid_points as contact
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.face_sums import FaceSums
from vsfsim.physics.contact.relaxation import Relaxation
from vsfsim.physics.contact.stiffness_block import ContactBlock
from vsfsim.physics.linear.rest_factor import Response, response
from vsfsim.physics.model import Model

_MOST_CUTS = 4  # of a linear face along its edge
_FACTOR = (0.1, 20.0)  # on the contact stiffness of a sheet


class Touching:
    """Contact state of B touches on the device.

    patches: one a touch. dof: degrees of freedom of the patches (B, 3 s), -1 pads. softening: factor on the contact
    stiffness of each touch (B,), 1 but on the way to a hard frame. stick: tangential stiffness of stuck points over the
    normal one. The results of `evaluate` are gap (B, 6 f) [m], body (B, 6 f), force (B, 6 f, 3) [N], energy (B,) [J]
    and slips (B, 6 f), with f the faces of the patch, or the parts they are cut into.

    Args:
        model: the body. bodies: rigid bodies. friction: Coulomb's coefficient of each body's pair with the object (K,)
        [-].
        poses: bodies to world (T, B, K, 4, 4), to find what is in reach. device: Warp device.
        exact: the object's answer to contact forces in double, see `factor.response`.
    """

    # measure under which a step that brings it to this part is good whatever the potential says, which rounding hides
    near_balance, shrinks = 0.05, 0.5
    within = 0.03  # measure at which friction's limit is renewed for the first time
    # iterations in which the measure may fail to fall by a tenth before a touch is given up: their limit ends them
    patience = 10**9

    def __init__(self, model: Model, bodies: RigidBodies, friction: np.ndarray, poses: np.ndarray, *, device: str,
                 exact: bool = True):
        self.model, self.bodies, self.device, self._exact = model, bodies, device, exact
        self.kernels = contact.kernels()
        self.rubs = bool((friction > 0.0).any())
        self.stick = contact.STICK
        self._friction = wp.array(friction, dtype=wp.float64, device=device)
        self._set = bodies.upload(self.kernels.sdf, device)
        corners = model.mesh.faces.shape[1]
        cuts, self._factor = (1, 1.0) if corners == 6 else sheet_contact(bodies, model.element_size)
        self._table = contact.shape_table(corners, cuts)
        self._parts = len(self._table)
        self._shape = wp.array(self._table, dtype=wp.float64, device=device)
        # where penetration is looked for besides: corners, edges and inside of every linear face; a quadratic one has
        # its Gauss points
        self._fine = torch.as_tensor(contact.shape_grid(3 * cuts) if corners == 3 else np.zeros((0, 6)), device=device)
        self._surface = model.mesh.surface_nodes()
        self._faces = torch.as_tensor(model.mesh.faces.astype(np.int64), device=device)
        rest = torch.as_tensor(model.mesh.points[self._surface], device=device)[:, None]
        self.first_gap = self._nearest(poses[:1], rest).amin(dim=0).cpu().numpy()
        self._area = model.mesh.face_area()
        reachable = self._reachable(self._nearest(poses, rest)).cpu().numpy()
        self.patches = [self._patch(np.flatnonzero(within)) for within in reachable]
        self.softening = torch.ones(poses.shape[1], dtype=torch.float64, device=device)
        self._upload()

    def _nearest(self, poses: np.ndarray, points: torch.Tensor) -> torch.Tensor:
        """Least gap (s, B) [m] of points (s, 1 or B, 3) over the poses (T, B, K, 4, 4)."""
        k = self.kernels
        out = torch.empty((len(points), poses.shape[1]), dtype=torch.float64, device=self.device)
        wp.launch(k.nearest, dim=out.shape, device=self.device, inputs=[
            self._set, len(self.bodies), wp.array(poses[..., :3, 3], dtype=k.vec3, device=self.device),
            wp.array(poses[..., :3, :3], dtype=k.mat33, device=self.device),
            wp.from_torch(points.contiguous(), dtype=k.vec3), wp.from_torch(out)])
        return out

    def _reachable(self, gap: torch.Tensor) -> torch.Tensor:
        """Boundary triangles (B, f) bool that may be met on the way, by rest position (gap (s, B) of the surface nodes)
        and a margin for what bulges up."""
        nearest = torch.full((len(self.model.mesh.points), gap.shape[1]), float("inf"), dtype=gap.dtype,
                             device=self.device)
        nearest[torch.as_tensor(self._surface, device=self.device)] = gap
        margin = 0.15 * (-gap.amin(dim=0)).clamp(min=0.0) + 0.1 * self.model.element_size
        return (torch.stack([nearest[nodes] for nodes in self._faces.T]).amin(dim=0) < margin).T

    @property
    def batch(self) -> int:
        """Number of touches B."""
        return len(self.patches)

    def _patch(self, faces: np.ndarray) -> contact.Patch:
        return contact.make_patch(self.model.mesh, faces, self._area[faces], self.model.surface_modulus[faces],
                                  parts=self._parts, factor=self._factor)

    def _upload(self) -> None:
        batch, k = len(self.patches), self.kernels
        faces = self._parts * max(1, max(len(p.faces) for p in self.patches))
        nodes = max(1, max(len(p.nodes) for p in self.patches))
        listed = np.full((batch, nodes), -1, np.int64)
        local = np.zeros((batch, faces, 6), np.int32)
        stiffness = np.zeros((batch, faces, 6))
        member = np.zeros((batch, len(self.model.mesh.faces)), bool)
        for b, p in enumerate(self.patches):
            f = len(p.local)
            listed[b, :len(p.nodes)], local[b, :f], stiffness[b, :f], member[b,
                                                                             p.faces] = p.nodes, p.local, p.stiffness, True

        def tensor(values: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(values, device=self.device)

        def zeros(*size: int) -> torch.Tensor:
            return torch.zeros(size, dtype=torch.float64, device=self.device)

        dof = np.where(listed[:, :, None] >= 0, 3 * listed[:, :, None] + np.arange(3), -1).reshape(batch, 3 * nodes)
        self.dof = tensor(dof)
        self._index = self.dof.clamp(min=0)
        self.free = tensor(np.where(dof >= 0, self.model.free[np.maximum(dof, 0)], 0.0))
        self.real = (self.dof >= 0).to(torch.float64)
        self.rest = tensor(np.where(dof >= 0, self.model.mesh.points.ravel()[np.maximum(dof, 0)], 0.0))
        # shape values of every Gauss point (B, 6 f, s); a padded face has all its nodes at 0 and no stiffness
        at = tensor(local.astype(np.int64))[:, :, None, :].expand(-1, -1, 6, -1).reshape(batch, 6 * faces, 6)
        values = tensor(self._table.reshape(-1, 6)).repeat(faces // self._parts, 1).expand(batch, -1, -1)
        # added: the columns that a linear face does not use are 0, and may name any node
        self._points = zeros(batch, 6 * faces, nodes).scatter_add_(2, at, values)
        self._sums = FaceSums(self._table, self.patches, faces // self._parts, nodes,
                              device=self.device) if self.model.mesh.faces.shape[1] == 3 else None
        self._member = tensor(member)
        self._local = wp.array(local, dtype=wp.int32, device=self.device)
        self._stiffness = wp.array(stiffness, dtype=wp.float64, device=self.device)
        size = (batch, 6 * faces)
        self.gap, self.energy_of_face = torch.full(size, 1e30, dtype=torch.float64,
                                                   device=self.device), zeros(batch, faces)
        self.body = torch.zeros(size, dtype=torch.int32, device=self.device)
        self.slips = torch.zeros(size, dtype=torch.int32, device=self.device)
        self._astray = torch.zeros((batch, faces), dtype=torch.int32, device=self.device)
        self.normal, self.force = zeros(*size, 3), zeros(*size, 3)
        self._rows, self._bend = zeros(*size, 3, 3), zeros(*size, 3, 3)
        self._x, self._x_before = zeros(batch, nodes, 3), self.rest.view(batch, nodes, 3).clone()
        # friction's memory: anchors in the frame of their body, their owners, the limit and the tangent plane
        self._anchor, self._across, self._limit = zeros(*size, 3), zeros(*size, 3), zeros(*size)
        self._owner = torch.full(size, -1, dtype=torch.int32, device=self.device)
        cut = (batch, faces, 6)
        self._relaxation = Relaxation(cut, self.device)
        view = {"dtype": k.vec3}
        self._w = {
            "gap": wp.from_torch(self.gap.view(cut)), "body": wp.from_torch(self.body.view(cut)),
                   "slips": wp.from_torch(self.slips.view(cut)),
            "normal": wp.from_torch(self.normal.view(*cut, 3), **view),
                   "force": wp.from_torch(self.force.view(*cut, 3), **view),
            "rows": wp.from_torch(self._rows.view(*cut, 3, 3), dtype=k.mat33),
                   "bend": wp.from_torch(self._bend.view(*cut, 3, 3), dtype=k.mat33),
            "energy": wp.from_torch(self.energy_of_face), "astray": wp.from_torch(self._astray),
                   "x": wp.from_torch(self._x, **view), "before": wp.from_torch(self._x_before, **view),
            "anchor": wp.from_torch(self._anchor.view(*cut, 3), **view),
                   "across": wp.from_torch(self._across.view(*cut, 3), **view),
            "limit": wp.from_torch(self._limit.view(cut)), "owner": wp.from_torch(self._owner.view(cut)),
            "softening": wp.from_torch(self.softening)}
        self.response: Response = response(self.model.factor, self.dof, device=self.device, exact=self._exact)
        self.compliance = self.response.compliance()

    # ------------------------------------------------------------------------------------------ poses and history

    def _placed(self, pose: np.ndarray) -> tuple[wp.array, wp.array]:
        k = self.kernels
        return (wp.array(pose[..., :3, 3], dtype=k.vec3, device=self.device),
                wp.array(pose[..., :3, :3], dtype=k.mat33, device=self.device))

    def begin(self, before: np.ndarray, u: torch.Tensor) -> None:
        """A step begins: bodies at ``before`` (B, K, 4, 4), displacements u (3 n, B) [m]. Friction counts way from
        here."""
        self._before, self._u_before = self._placed(before), u.clone()
        self._relaxation.begin()
        self._x_before.copy_(self.positions(self.gather(u)).view_as(self._x_before))

    def move(self, pose: np.ndarray, columns: torch.Tensor | None = None) -> None:
        """The bodies are at ``pose`` (B, K, 4, 4) from now on (who is about to be solved, ``columns``, makes no
        difference here)."""
        self._pose = self._placed(pose)

    def gather(self, u: torch.Tensor) -> torch.Tensor:
        """Displacements (B, 3 s) [m] of all patches out of u (3 n, B)."""
        return u.gather(0, self._index.T).T.to(torch.float64) * self.real

    def positions(self, displacement: torch.Tensor) -> torch.Tensor:
        """Positions (B, 3 s) [m] of the patches' nodes."""
        return self.rest + displacement

    # ------------------------------------------------------------------------------------------ evaluation

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        """Gaps, forces and stiffness of the touches ``columns`` (k,) for displacements (k, 3 s) [m] of their
        patches."""
        w = self._w
        self._x[columns] = (self.rest[columns] + displacement).view(len(columns), -1, 3)
        wp.launch(self.kernels.evaluate, dim=(self._local.shape[1], len(columns)), device=self.device, inputs=[
            self._shape, self._set, len(self.bodies), wp.from_torch(columns.to(torch.int32)), self._local, self._stiffness, w["softening"],
            self.stick, *self._pose, w["x"], w["anchor"], w["owner"], w["limit"], w["across"],
            w["gap"], w["body"], w["normal"], w["force"], w["rows"], w["bend"], w["slips"], w["astray"], w["energy"]])

    def lag(self, columns: torch.Tensor) -> None:
        """Renew friction's limit and tangent plane from what `evaluate` found last."""
        if self.rubs:
            w = self._w
            wp.launch(self.kernels.lag, dim=(self._local.shape[1], len(columns)), device=self.device, inputs=[
                self._shape, self._set, wp.from_torch(columns.to(torch.int32)), self._local, self._stiffness, w["softening"], self._friction,
                *self._pose, w["x"], *self._before, w["before"], w["gap"], w["body"], w["normal"],
                w["anchor"], w["owner"], w["limit"], w["across"], *self._relaxation.arrays()])

    def settle(self, columns: torch.Tensor) -> None:
        """The step is done: let slipping points drag their anchors, and forget those that left."""
        if self.rubs and len(columns):
            w = self._w
            wp.launch(self.kernels.settle, dim=(self._local.shape[1], len(columns)), device=self.device, inputs=[
                self._shape, wp.from_torch(columns.to(torch.int32)), self._local, self._stiffness, contact.STICK, *self._pose, w["x"], w["gap"], w["body"],
                w["limit"], w["across"], w["anchor"], w["owner"]])

    def memory(self) -> tuple[torch.Tensor, ...]:
        """Friction's memory, to return to if a step fails; see `restore`."""
        return (self._anchor.clone(), self._owner.clone(), self._limit.clone(),
                self._across.clone()) if self.rubs else ()

    def unlawful(self, columns: torch.Tensor) -> torch.Tensor:
        """By how much friction's limits miss Coulomb's after `lag` (k,) [N]."""
        return self._relaxation.unlawful(columns)

    def restore(self, columns: torch.Tensor, memory: tuple[torch.Tensor, ...]) -> None:
        """Set friction's memory of ``columns`` back."""
        for mine, theirs in zip((self._anchor, self._owner, self._limit, self._across), memory, strict=False):
            if mine.shape == theirs.shape:
                mine[columns] = theirs[columns]

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Potential of the contact (k,) [J]."""
        return self.energy_of_face[columns].sum(dim=1)

    def astray(self, columns: torch.Tensor) -> torch.Tensor:
        """Points (k,) that lie past the middle of a body: none, in a solution."""
        return self._astray[columns].sum(dim=1)

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces (k, 3 s) [N] on the patches' nodes."""
        if self._sums is not None:
            return self._sums.nodal(columns, self.force[columns])
        return (self._points[columns].mT @ self.force[columns]).flatten(1)

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Force on every rigid body (k, K, 3) [N]."""
        held = torch.nn.functional.one_hot(self.body[columns].long(), len(self.bodies)).to(torch.float64)
        return -(held.mT @ self.force[columns])

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Moment on every rigid body about its origin, in the world (k, K, 3) [N m]."""
        held = torch.nn.functional.one_hot(self.body[columns].long(), len(self.bodies)).to(torch.float64)
        places = self._points[columns] @ self._x[columns]
        origin = wp.to_torch(self._pose[0])[columns]  # (k, K, 3)
        about_world = held.mT @ torch.linalg.cross(places, -self.force[columns])
        return about_world - torch.linalg.cross(origin, self.on_bodies(columns))

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        """Is any Gauss point inside a body? (k,) bool."""
        return (self.gap[columns] < 0.0).any(dim=1)

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """Deepest Gauss point (k,) [m]; of linear faces, deepest of a grid that is finer than the Gauss points."""
        deepest = (-self.gap[columns].amin(dim=1)).clamp(min=0.0)
        if len(self._fine):
            local = wp.to_torch(self._local)[columns, ::self._parts].long()  # (k, f, 6)
            k, f = local.shape[:2]
            corner = self._x[columns].gather(1, local.reshape(k, 6 * f, 1).expand(-1, -1, 3)).view(k, f, 6, 3)
            spots = torch.einsum("sa,kfac->fskc", self._fine, corner).reshape(-1, k, 3)
            origin, turn = (wp.to_torch(a)[columns][None].contiguous() for a in self._pose)
            gap = torch.empty(spots.shape[:2], dtype=torch.float64, device=self.device)
            wp.launch(self.kernels.nearest, dim=gap.shape, device=self.device, inputs=[
                self._set, len(self.bodies), wp.from_torch(origin,
                                                           dtype=self.kernels.vec3),
                                                                                       wp.from_torch(turn, dtype=self.kernels.mat33),
                wp.from_torch(spots.contiguous(), dtype=self.kernels.vec3), wp.from_torch(gap)])
            # a padded face is none
            real = torch.as_tensor(wp.to_torch(self._stiffness)[columns, ::self._parts, 0] > 0.0)
            gap = torch.where(real.T.repeat_interleave(len(self._fine), dim=0), gap, torch.inf)
            deepest = torch.maximum(deepest, -gap.amin(dim=0))
        return deepest

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        """Share of the Gauss points in contact that slip (k,) [-]; 0 without contact."""
        inside = (self.gap[columns] < 0.0).sum(dim=1)
        return self.slips[columns].sum(dim=1) / inside.clamp(min=1)

    # ------------------------------------------------------------------------------------------ stiffness

    def stiffness(self, columns: torch.Tensor, bend: torch.Tensor | None = None) -> torch.Tensor:
        """Contact stiffness (k, 3 s, 3 s) [N/m] on the patches.

        Args:
            columns: touches (k,). bend: whose counts with its geometric term (k,) bool; deep inside a body that term is
            large, and wrong.
        """
        curved = bend is not None and bool(bend.any())
        if self._sums is not None:
            own = self._rows[columns].mT @ self._rows[columns]
            if curved:
                own[bend] += self._bend[columns[bend]]
            return self._sums.matrix(columns, own) * self.free[columns][:, :, None] * self.free[columns][:, None, :]
        rows = self.rows(columns)
        out = rows.mT @ rows
        if curved:
            points, which = self._active(columns[bend])
            out[bend] += _assemble(points,
                                   which(self._bend)) * self.free[columns[bend]][:, :,
                                                                                 None] * self.free[columns[bend]][:,
                                                                                                                  None, :]
        return out

    def _active(self, columns: torch.Tensor) -> tuple[torch.Tensor, Callable[[torch.Tensor], torch.Tensor]]:
        """Of the points in contact, padded to the most: shape values (k, a, s), 0 where padded, and what picks them
        from a table (B, 6 f, ...)."""
        active = (self.gap[columns] < 0.0) | (self._limit[columns] > 0.0)
        most = max(1, int(active.sum(dim=1).amax()))
        on, order = torch.sort(active.to(torch.int8), dim=1, descending=True, stable=True)
        order = order[:, :most]
        return (self._points[columns[:, None], order] * on[:, :most, None],
                lambda table: table[columns[:, None], order])

    def rows(self, columns: torch.Tensor) -> torch.Tensor:
        """Rows R (k, m, 3 s) [sqrt(N/m)] of the points in contact, padded with 0: R^T R is the contact stiffness."""
        points, which = self._active(columns)
        roots = which(self._rows)
        if not self.rubs:
            roots = roots[:, :, :1]
        k, a, s = points.shape
        rows = (roots[:, :, :, None, :] * points[:, :, None, :, None]).reshape(k, a * roots.shape[2], 3 * s)
        return rows * self.free[columns][:, None, :]

    def block(self, columns: torch.Tensor) -> ContactBlock:
        """The contact of ``columns``, ready to be inverted together with the body at rest."""
        if self._sums is not None:
            own = self._rows[columns].mT @ self._rows[columns]
            nodes = self._sums.pushed(columns, own)
            free = self.free[columns].view(len(columns), -1, 3)[torch.arange(len(columns), device=self.device)[:, None],
                                                                nodes].flatten(1)
            return ContactBlock.joined_of(nodes, self._sums.matrix(columns, own,
                                                                   nodes) * free[:, :, None] * free[:, None, :],
                                          self.compliance[columns])
        return ContactBlock.of(self.rows(columns), self.compliance[columns])

    def condensed(self, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
                  tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
        """See `condensed.solve`."""
        return condensed.solve(self, columns, base, pushed, iterations=iterations, tolerance=tolerance)

    # ------------------------------------------------------------------------------------------ between steps

    def remember(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces of ``columns`` (k,) as a later step can read them (k, 3 s) [N]."""
        return self.nodal(columns)

    def recall(self, remembered: torch.Tensor) -> torch.Tensor:
        """Remembered forces (B, 3 s) [N] on the present patches."""
        return remembered

    def nothing(self) -> torch.Tensor:
        """What touches without contact remember."""
        return torch.zeros_like(self.rest)

    # ------------------------------------------------------------------------------------------ nothing slips through

    def grow(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> bool:
        """Extend the patch of any touch whose bodies have met surface outside it; True if one grew.

        Args:
            columns: touches (k,). pose: (B, K, 4, 4). u: displacements (3 n, B) [m].
        """
        mesh = self.model.mesh
        surface = torch.as_tensor(self._surface, device=self.device)
        points = torch.as_tensor(mesh.points[self._surface], device=self.device)[:,
                                                                                 None] + u.view(-1,
                                                                                                3, u.shape[1])[surface].transpose(1, 2)
        inside = torch.zeros((len(mesh.points), u.shape[1]), dtype=torch.bool, device=self.device)
        inside[surface] = self._nearest(pose[None], points) < 0.0
        met = inside[self._faces].any(dim=1).T & ~self._member  # (B, faces)
        if not bool(met[columns].any()):
            return False
        old = [p.faces for p in self.patches]
        kept = self.memory()
        for b in columns.tolist():
            extra = np.flatnonzero(met[b].cpu().numpy())
            if len(extra):
                near = np.zeros(len(mesh.points), bool)
                near[mesh.faces[extra]] = True
                faces = np.union1d(self.patches[b].faces, np.flatnonzero(near[mesh.faces].any(axis=1)))
                self.patches[b] = self._patch(faces)
        self._upload()
        if self.rubs:
            for b, faces in enumerate(old):
                each = 6 * self._parts
                at = torch.as_tensor(each * np.searchsorted(self.patches[b].faces, faces)[:, None] + np.arange(each),
                                     device=self.device).flatten()
                for mine, theirs in zip((self._anchor, self._owner, self._limit, self._across), kept, strict=True):
                    mine[b, at] = theirs[b, :len(at)]
            self._x_before.copy_(self.positions(self.gather(self._u_before)).view_as(self._x_before))
        return True


def sheet_contact(bodies: RigidBodies, edge: float) -> tuple[int, float]:
    """How a sheet of linear faces with this mean ``edge`` [m] meets these bodies: parts along the edge of a face, and
    the factor on its contact stiffness.

    The six points of a part leave holes of radius 0.25 edge, and a dent stretches them by half; over one a ball of
    radius R is (0.4 edge)^2/(2 R) deep, under one per cent of an edge with these parts. The pressure under a body is
    the gas's and the sheet's tension over R, of the order E h/R, carried by few points where a faceted sheet rests on
    its edges. So the penetration stays well under one per cent of an edge if the stiffness goes with edge / R: 10 times
    that suffices for a ball of 3 mm, and a plate needs a hundredth of it. Stiffer than needed costs iterations: a sheet
    itself gives way easily. Bodies with edges get the most.
    """
    def least_radius(k: int) -> float:
        shape = bodies.shapes[k]
        return float("inf") if isinstance(shape,
                                          Plane) else shape.radius if isinstance(shape, (Sphere, Capsule)) else 0.0

    ratio = max(edge / max(least_radius(k), 1e-9) for k in range(len(bodies)))
    return int(np.clip(np.ceil(3.0 * np.sqrt(ratio) - 1e-9), 1, _MOST_CUTS)), float(np.clip(10.0 * ratio, *_FACTOR))


def _assemble(points: torch.Tensor, stiff: torch.Tensor) -> torch.Tensor:
    """Sum over points q of N_q^T stiff_q N_q: shape values (k, q, s) and (k, q, 3, 3) give (k, 3 s, 3 s)."""
    k, q, s = points.shape
    right = (stiff[:, :, :, :, None] * points[:, :, None, None, :]).reshape(k, q, 9 * s)
    out = points.mT @ right
    return out.view(k, s, 3, 3, s).permute(0, 1, 2, 4, 3).reshape(k, 3 * s, 3 * s)
