"""Contact of a batch of touches with rigid bodies: what they can reach, gaps, forces, and the stiffness that they add.

Each touch (column) has a patch: the boundary triangles that its bodies can reach. Tensors are over all touches, padded.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import body_points, condensed, rigid_kernels
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_points import BodyPoints
from vsfsim.physics.contact.face_sums import FaceSums
from vsfsim.physics.contact.friction import Relaxation
from vsfsim.physics.contact.growth import grow, restore
from vsfsim.physics.contact.intrusion import Intrusion
from vsfsim.physics.contact.local_indentation import SATURATED_BY_PLACE, LocalIndentation, MissingCompliance
from vsfsim.physics.contact.patch import CUTS, Patch, make_patch, shape_grid, shape_tables, sheet_contact
from vsfsim.physics.contact.reach import Reach
from vsfsim.physics.contact.rigid_stiffness import PointStiffness
from vsfsim.physics.contact.sheet_intrusion import SheetIntrusion
from vsfsim.physics.linear.rest_factor import Response, response
from vsfsim.physics.model import Model
from vsfsim.physics.solve.mount import Mount, Springs


class RigidContact(PointStiffness):
    """`Contact` of an object with K rigid bodies; f are the faces of a patch, or the parts that they are cut into.

    Args:
        model: the object.
        bodies: the rigid bodies (K).
        friction: Coulomb's coefficient of each body with the object (K,) [-].
        poses: all poses to come, bodies to world (T, B, K, 4, 4): they tell what is in reach.
        device: Warp device.
        local: whether round bodies sink in locally, see `local_indentation`; ``by_place``: where they touch.
        mount: springs that carry the bodies; poses are then those of the mounts.
        exact: whether the object's response to contact forces is float64, see `rest_factor.response`.
    """

    potential_trusted_above, decrease = 0.05, 0.5
    deadline, patience = float("inf"), 10**9  # the limit on iterations ends a touch
    _begun: np.ndarray | None = None

    patches: list[Patch]
    """The patch of each touch (B)."""
    first_gap: np.ndarray
    """Least gap of the object at rest at the first poses (B,) [m]."""
    gap: torch.Tensor
    """Gap of each Gauss point (B, 6 f) [m]."""
    body: torch.Tensor
    """Nearest body of each Gauss point (B, 6 f)."""
    normal: torch.Tensor
    """Outward normal of that body where it touches (B, 6 f, 3) [-]."""
    force: torch.Tensor
    """Contact force at each Gauss point (B, 6 f, 3) [N]."""
    slips: torch.Tensor
    """1 where a Gauss point slips (B, 6 f)."""
    limit: torch.Tensor
    """Limit of the friction force of each Gauss point (B, 6 f) [N]."""
    held: torch.Tensor
    """Friction force at each Gauss point (B, 6 f, 3) [N]; before an evaluation the one to linearise at (`relief`)."""
    relief: torch.Tensor
    """Share of the stick stiffness at which friction is linearised at the force `held` (B,) [-]; 1: at its own."""

    def __init__(self, model: Model, bodies: RigidBodies, friction: np.ndarray, poses: np.ndarray, *, device: str,
                 exact: bool = True, local: bool = False, by_place: bool = False, mount: Mount | None = None):
        self.model, self.bodies, self.device, self._exact, self._sinks = model, bodies, device, exact, local
        self._by_place = local and by_place and MissingCompliance.serves(model, bodies.shapes)
        self.kernels, self.batch = rigid_kernels.kernels(), poses.shape[1]
        self.has_friction = bool((friction > 0.0).any())
        self._coefficient = wp.array(friction, dtype=wp.float64, device=device)
        self.springs = None if mount is None else Springs(mount, device)
        self._set = bodies.upload(self.kernels.sdf, device)
        self.solid = (corners := model.mesh.faces.shape[1]) == 6
        cuts, self._factor, self._onset = (1, 1.0, 0.0) if self.solid else sheet_contact(bodies, model.element_size)
        self._parts = cuts**2  # of a linear face; those of a quadratic one differ
        self._table, self._rows_of = shape_tables(corners, CUTS if self.solid else (cuts,))
        # penetration is measured on a grid over every linear face; on a quadratic one, `intrusion` measures it
        self._fine = torch.as_tensor(np.zeros((0, 6)) if self.solid else shape_grid(3 * cuts), device=device)
        sinks = SATURATED_BY_PLACE * self._by_place
        check = functools.partial(Intrusion, coupled=model.coupled, sinks=sinks) if self.solid else SheetIntrusion
        self._passage = check(model.mesh, bodies, model.element_size, device=device)
        self._body_points = BodyPoints(model, bodies, poses.shape[1], device=device)
        self._overlap = torch.zeros((2, poses.shape[1]), dtype=torch.float64, device=device)
        self._reach = Reach(model, bodies, self._set, self.kernels, device, local=local, by_place=self._by_place,
                            sprung=mount is not None)
        self.first_gap, reachable, self._cuts = self._reach.plan(poses, cuts)
        self._area = model.mesh.face_area()
        self.patches = [self._patch(b, np.flatnonzero(within)) for b, within in enumerate(reachable)]
        self.follows_below = (0.2 if device == "cpu" else 0.0) if self.solid else np.inf
        self.friction_updated_below, self.flat = 0.03 if self.solid else 0.3, bodies.flat
        self.softening, self.coulomb, self.relief = (
            torch.full((poses.shape[1],), value, dtype=torch.float64, device=device) for value in (1.0, 0.0, 1.0))
        self._upload()

    def _patch(self, b: int, faces: np.ndarray) -> Patch:
        return make_patch(self.model.mesh, faces, self._area[faces], self.model.surface_modulus[faces],
                          self._cuts[b, faces], self._rows_of, (self._factor, self._body_points.least))

    def _upload(self) -> None:
        batch, k = len(self.patches), self.kernels
        padded = body_points.pad(self.patches, self.model.mesh.faces, self._parts, self._body_points, self._table)
        listed, local, part = padded.nodes, padded.local, padded.part
        faces, nodes = local.shape[1], listed.shape[1]
        tensor = functools.partial(torch.as_tensor, device=self.device)
        zeros = functools.partial(torch.zeros, dtype=torch.float64, device=self.device)
        dof = np.where(listed[:, :, None] >= 0, 3 * listed[:, :, None] + np.arange(3), -1).reshape(batch, 3 * nodes)
        same = hasattr(self, "dof") and np.array_equal(self.dof.cpu().numpy(), dof)
        self.dof, self._index = tensor(dof), tensor(dof).clamp(min=0)
        self.free = tensor(np.where(dof >= 0, self.model.free[np.maximum(dof, 0)], 0.0))
        self.mask = (self.dof >= 0).to(torch.float64)
        self.rest = tensor(np.where(dof >= 0, self.model.mesh.points.ravel()[np.maximum(dof, 0)], 0.0))
        self._sums: FaceSums | None = None
        if self.solid:
            # shape values of every Gauss point (B, 6 f, s); a padded face has all its nodes at 0 and no stiffness
            at = tensor(local.astype(np.int64))[:, :, None, :].expand(-1, -1, 6, -1).reshape(batch, 6 * faces, 6)
            self._values = tensor(padded.table)[tensor(part.astype(np.int64))]  # (B, f, 6 points, 6 nodes)
            self._points = zeros(batch, 6 * faces, nodes).scatter_add_(2, at, self._values.view(batch, 6 * faces, 6))
        else:
            self._sums = FaceSums(self._table, self.patches, faces // self._parts, nodes, device=self.device)
        self._shape = wp.array(padded.table, dtype=wp.float64, device=self.device)
        self._hosts = [wp.array(a, dtype=d, device=self.device) for a, d in padded.hosts(k.vec3)]
        self._part, self._local = (wp.array(a, dtype=wp.int32, device=self.device) for a in (part, local))
        self._member, self._of_body = tensor(padded.member), tensor(padded.host >= 0)
        self._stiffness = wp.array(padded.stiffness, dtype=wp.float64, device=self.device)
        size = (batch, 6 * faces)
        self.gap, self._energy = zeros(size) + 1e30, zeros(batch, faces)
        self.body, self.slips = zeros(size, dtype=torch.int32), zeros(size, dtype=torch.int32)
        self._wrong_side = zeros((batch, faces), dtype=torch.int32)
        self.normal, self.force, self.held = (zeros(*size, 3) for _ in range(3))
        self._rows, self._geometric, self._coupling = (zeros(*size, 3, 3) for _ in range(3))
        self._x, self._x_before = zeros(batch, nodes, 3), self.rest.view(batch, nodes, 3).clone()
        # friction state: anchors in the frame of their body, their owners, limits and normals of the tangent planes
        self._anchor, self._across, self.limit = zeros(*size, 3), zeros(*size, 3), zeros(size)
        self._owner = torch.full(size, -1, dtype=torch.int32, device=self.device)
        self._friction = self._anchor, self._owner, self.limit, self._across
        self._relaxation = Relaxation(cut := (batch, faces, 6), self.device)
        self._arrays = rigid_kernels.views(
            cut, {"gap": self.gap, "body": self.body, "slips": self.slips, "limit": self.limit, "owner": self._owner},
            {"normal": self.normal, "force": self.force, "anchor": self._anchor, "across": self._across, "held":
             self.held}, {"rows": self._rows, "geometric": self._geometric, "coupling": self._coupling})
        self._arrays |= {
            "energy": wp.from_torch(self._energy), "wrong_side": wp.from_torch(self._wrong_side),
            "x": wp.from_torch(self._x, dtype=k.vec3), "before": wp.from_torch(self._x_before, dtype=k.vec3),
            "softening": wp.from_torch(self.softening), "relief": wp.from_torch(self.relief)}
        if not same:  # the same nodes may have more points
            self.response: Response = response(self.model.factor if self._exact else self.model.predictor(self.device),
                                               self.dof, device=self.device, exact=self._exact)
            self.compliance = self.response.compliance()
        missing = self._by_place and MissingCompliance(self.model, self.response, self.compliance, self._points)
        self._local_indentation = LocalIndentation(self.model, self.patches, self._area, self._reach, self.places(
            self.rest.view(batch, nodes, 3)), on=self._sinks, missing=missing or None)
        self._local_indentation.set_parts(np.nonzero(padded.host >= 0), padded.share, padded.soft)

    def places(self, x: torch.Tensor) -> torch.Tensor:
        """Vectors at the nodes of the patches (B, s, 3) interpolated to the Gauss points (B, 6 f, 3)."""
        return self._points @ x if self._sums is None else self._sums.places(x)

    def _placed(self, pose: np.ndarray) -> tuple[wp.array, wp.array]:
        return (wp.array(pose[..., :3, 3], dtype=self.kernels.vec3, device=self.device),
                wp.array(pose[..., :3, :3], dtype=self.kernels.mat33, device=self.device))

    def begin_step(self, before: np.ndarray, u: torch.Tensor) -> None:
        """See `Contact`."""
        self._u_before, self._begun, self._before = u.clone(), before, self._placed(before)
        if self.springs is not None:  # where they let the bodies begin
            self._plan_for(before)
            self._pose = self._before
            self.evaluate(torch.arange(self.batch, device=self.device), self.gather(u))
            self._begun = self.springs.poses(before)
        self._relaxation.begin_step()
        self._body_points.begin_step()
        self._stand(u)

    def move(self, pose: np.ndarray, columns: torch.Tensor | None = None) -> None:
        """See `Contact`."""
        kept = self.friction_state()
        if (self._begun is not None and columns is not None  # the first move of a step
                and self._body_points.add(columns, (self._begun, self._held_at(pose)), self._u_before, self.patches)):
            self._renew(pose, kept)
        self._pose, self._begun = self._placed(self._held_at(pose)), None
        self._plan_for(pose)
        self._sink(pose)
        self._overlap[:, slice(None) if columns is None else columns] = 0.0

    def _plan_for(self, pose: np.ndarray) -> None:
        """The mounts, or the bodies without any, are at ``pose`` (B, K, 4, 4)."""
        self._plan, self._mounts = pose, torch.as_tensor(pose[..., :3, 3], device=self.device)

    def _held_at(self, pose: np.ndarray) -> np.ndarray:
        """Poses (B, K, 4, 4) of the bodies whose mounts are at ``pose`` (B, K, 4, 4)."""
        return pose if self.springs is None else self.springs.poses(pose)

    def _sink(self, pose: np.ndarray) -> None:
        self._local_indentation.move(self._held_at(pose))
        if self.springs is not None:
            self.springs.seen()

    def follow(self) -> bool:
        """See `Contact`: the local indentation."""
        if self.springs is None or not self._sinks or not self.springs.moved_on():
            return False
        self._sink(self._plan)
        return True

    def _renew(self, pose: np.ndarray, kept: tuple[Any, ...]) -> None:
        """Go on with other contact points than those of the friction state ``kept``."""
        self._upload()
        self._sink(pose)
        if self.has_friction:
            self.restore_friction(torch.arange(self.batch, device=self.device), kept)
            self._stand(self._u_before)

    def gather(self, u: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return u.gather(0, self._index.T).T * self.mask

    def _stand(self, u: torch.Tensor) -> None:
        self._x_before.copy_((self.rest + self.gather(u)).view_as(self._x_before))

    def _launch(self, kernel: object, columns: torch.Tensor, model: list[object], names: str,
                *more: wp.array) -> None:
        """Run a kernel over the faces of ``columns``; arrays are found by their ``names``, the poses before by "<"."""
        state = [a for name in names.split() for a in (self._before if name == "<" else (self._arrays[name],))]
        wp.launch(kernel, dim=(self._local.shape[1], len(columns)), device=self.device,
                  inputs=[self._shape, self._part, *model, *self._pose, *state, *more])

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor, pushed: torch.Tensor | None = None) -> None:
        """See `Contact`; springs give way to the forces ``pushed`` (k, 3 s) [N], or until they are in balance."""
        self._x[columns] = (self.rest[columns] + displacement).view(len(columns), -1, 3)
        if self.springs is not None and pushed is None:
            self.springs.settle(self, columns)
            return
        if self.springs is not None and pushed is not None:
            self.springs.pushed(columns, pushed)
        self.evaluate_at_mounts(columns)

    def evaluate_at_mounts(self, columns: torch.Tensor) -> None:
        """Evaluate the contact of ``columns`` (k,) with the bodies where springs let them."""
        if self.springs is not None:
            wp.to_torch(self._pose[0])[columns] = self.springs.placed(self._mounts)[columns]
        self._launch(self.kernels.evaluate, columns,
                     [self._set, len(self.bodies), wp.from_torch(columns.to(torch.int32)), self._local,
                      self._stiffness, *self._local_indentation.arrays, *self._hosts, self._arrays["softening"],
                      self._onset, self._coefficient, wp.from_torch(self.coulomb), rigid_kernels.STICK],
                     "x anchor owner limit across relief gap body normal force rows geometric coupling slips held "
                     "wrong_side energy")

    def update_friction(self, columns: torch.Tensor) -> None:
        """See `Contact`."""
        if self.has_friction:
            self._relaxation.renewals[columns] += 1
            self._launch(self.kernels.update_friction, columns,
                         [self._set, wp.from_torch(columns.to(torch.int32)), self._local, self._stiffness,
                          *self._local_indentation.arrays, *self._hosts[:2], self._arrays["softening"],
                          self._onset, self._coefficient, wp.from_torch(self.coulomb),
                          wp.from_torch(self._relaxation.renewals)],
                         "x < before gap body normal anchor owner limit across", *self._relaxation.arrays)

    def end_step(self, columns: torch.Tensor) -> None:
        """See `Contact`."""
        if self.has_friction and len(columns):
            self._launch(self.kernels.end_step, columns,
                         [wp.from_torch(columns.to(torch.int32)), self._local, self._stiffness, rigid_kernels.STICK],
                         "x gap body limit across anchor owner")

    def friction_state(self) -> tuple[Any, ...]:
        """See `Contact`; empty without friction."""
        return (list(self.patches), list(self._body_points.met),
                *(t.clone() for t in self._friction)) if self.has_friction else ()

    def restore_friction(self, columns: torch.Tensor, state: tuple[Any, ...]) -> None:
        """See `Contact`; a patch that has grown since takes what its old points remembered."""
        if state:
            restore(columns.tolist(), self._friction, state, (self.patches, self._body_points.met), self._table,
                    self._body_points.body, self.model.mesh, self._u_before, self._before[1].numpy())

    def friction_residual(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return self._relaxation.friction_residual(columns)

    def energy(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return self._energy[columns].sum(dim=1)

    def carried(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return self._energy.new_zeros(len(columns)) if self.springs is None else self.springs.energy(columns)

    def given(self, columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """How far forces (k, 3 s) [N] of the contact move the nodes against bodies that springs carry (k, 3 s) [m]."""
        if self.springs is None:
            return torch.zeros_like(force)
        series = self.springs.series(columns, force.shape[1] // 3)
        return series * (series * force).sum(dim=1, keepdim=True)

    def local_energy(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        own = (self._energy[columns] * self._of_body[columns]).sum(dim=1)
        return own + self._local_indentation.energy(self.gap[columns], wp.to_torch(self._stiffness)[columns], columns)

    def wrong_side(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return self._wrong_side[columns].sum(dim=1)

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return self.nodal_of(columns, self.force[columns])

    def _held(self, columns: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.one_hot(self.body[columns].long(), len(self.bodies)).to(torch.float64)

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return -(self._held(columns).mT @ self.force[columns])

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        places, origin = self.places(self._x)[columns], wp.to_torch(self._pose[0])[columns]  # origin (k, K, 3)
        about_world = self._held(columns).mT @ torch.linalg.cross(places, -self.force[columns])
        return about_world - torch.linalg.cross(origin, self.on_bodies(columns))

    def touches(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return (self.gap[columns] < 0.0).any(dim=1)

    def penetration(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`: over the Gauss points, a finer grid between them, and the bodies' own points."""
        deepest = torch.maximum(-self.gap[columns].amin(dim=1), self._overlap[:, columns].amax(dim=0))
        if len(self._fine):
            used = wp.to_torch(self._stiffness)[columns, ::self._parts, 0] > 0.0  # not padding
            local = wp.to_torch(self._local)[columns, ::self._parts].long()
            pose = tuple(wp.to_torch(a)[columns][None] for a in self._pose)
            deepest = torch.maximum(deepest, self._reach.depth(self._fine, self._x[columns], local, used, pose))
        return deepest

    def slipping(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        inside = self.gap[columns] < 0.0  # a point that has left may still have a limit in this step
        return (self.slips[columns] * inside).sum(dim=1) / inside.sum(dim=1).clamp(min=1)

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """See `Contact`."""
        return self._local_indentation.resolution(self.gap[columns] < 0.0, self._held(columns) > 0.0, columns)

    def local_share(self, columns: torch.Tensor) -> torch.Tensor:
        """See `LocalIndentation.share`."""
        gone = (self.places(self._x - self.rest.view_as(self._x)) * self.normal)[columns].sum(dim=2)
        return self._local_indentation.share(self.gap[columns], gone, self._held(columns), self.bodies.shapes, columns)

    def condensed(self, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
                  tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
        """See `Contact`."""
        return condensed.solve(self, columns, base, pushed, iterations=iterations, tolerance=tolerance,
                               staged=False, deadline=self.deadline)

    def remember(self, columns: torch.Tensor) -> torch.Tensor:
        """See `Contact`: the nodal forces (k, 3 s)."""
        return self.nodal(columns)

    def recall(self, remembered: torch.Tensor) -> torch.Tensor:
        """See `Contact`."""
        return remembered

    def no_force(self) -> torch.Tensor:
        """See `Contact`."""
        return torch.zeros_like(self.rest)

    def intruded(self, columns: torch.Tensor, times: float = 1.0) -> torch.Tensor:
        """See `Contact`."""
        return self._overlap[:, columns].amax(dim=0) > times * self._passage.tolerance

    def extend_patch(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor, *,
                     touched: torch.Tensor | None = None) -> bool:
        """See `Contact`."""
        pose, mounts = self._held_at(pose), pose
        cut, moved, kept = torch.zeros_like(self._member), [], self.friction_state()
        if isinstance(self._passage, Intrusion):
            self._overlap[:, columns], met, cut = self._passage.grow(
                columns, pose, u, torch.as_tensor(self._cuts < CUTS[-1], device=self.device), touched)
            moved, beside = self._body_points.renew(columns, pose, u, self.patches)
            met |= torch.as_tensor(beside, device=self.device)
        else:
            self._overlap[1, columns], met = self._passage.check(columns, pose, u), self._reach.met(pose, u)
        met &= ~self._member  # (B, faces)
        if not (moved or bool((met | cut)[columns].any())):
            return False
        grow(self.patches, self._cuts, columns.tolist(), met.cpu().numpy(), cut.cpu().numpy(), self.model.mesh,
             self._patch, functools.partial(self.response.ready, deadline=self.deadline))
        self._renew(mounts, kept)
        return True
