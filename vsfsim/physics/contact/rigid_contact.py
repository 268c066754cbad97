"""Contact of a batch of touches with rigid bodies: what they can reach, gaps, forces, and the stiffness that they add.

Each touch (column) has a patch: the boundary triangles that its bodies can reach. Tensors are over all touches, padded.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.core.shape import Plane
from vsfsim.physics.contact import rigid_kernels
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_points import BodyPoints, remember, stacked
from vsfsim.physics.contact.body_samples import inner_radius
from vsfsim.physics.contact.intrusion import Intrusion
from vsfsim.physics.contact.kernels import bound
from vsfsim.physics.contact.law import PENALTY, ContactLaw
from vsfsim.physics.contact.local_indentation import SATURATED_BY_PLACE, LocalIndentation, lacks_something
from vsfsim.physics.contact.mount import Mount, Springs
from vsfsim.physics.contact.patch import CUTS, NO_PART, Patch, at_points, make_patch, neighbours, sheet_contact
from vsfsim.physics.contact.points import Contact
from vsfsim.physics.contact.reach import plan
from vsfsim.physics.linear.rest_factor import Response, response
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import real, vec3

CORE = 0.2
"""Depth over a body's inner radius at which its inner body begins [-]."""


class RigidContact(Contact):
    """The contact of an object with K rigid bodies; f are the faces of a patch, or the parts that they are cut into.

    The *patch* of a touch is the surface nodes that it can reach; all patches are padded to s nodes. ``columns`` (k,)
    are the touches that a call is about; its results have their order.

    Args:
        model: the object.
        bodies: the rigid bodies (K).
        friction: Coulomb's coefficient of each body with the object (K,) [-].
        poses: all poses to come, bodies to world (T, B, K, 4, 4): they tell what is in reach.
        device: Warp device.
        local: whether round bodies sink in locally, see `local_indentation`; ``by_place``: where they touch.
        mount: springs that carry the bodies; poses are then those of the mounts.
        linear: whether the object's stiffness stays that at rest.
        law: of the contact, and its terms, see `law`.
    """

    # measure under which a step is accepted for its residual alone, because rounding hides the potential, and the
    # factor by which the residual has to fall in it [-]
    potential_trusted_above, decrease = 0.05, 0.5

    _begun: np.ndarray | None = None

    patches: list[Patch]
    """The patch of each touch (B)."""
    gap: torch.Tensor
    """Gap of each Gauss point (B, 6 f) [m]."""
    body: torch.Tensor
    """Nearest body of each Gauss point (B, 6 f)."""
    normal: torch.Tensor
    """Outward normal of that body where it touches (B, 6 f, 3) [-]."""
    force: torch.Tensor
    """Contact force at each Gauss point (B, 6 f, 3) [N]."""

    def __init__(self, model: Model, bodies: RigidBodies, friction: np.ndarray, poses: np.ndarray, *, device: str,
                 linear: bool = True, local: bool = False, by_place: bool = False, mount: Mount | None = None,
                 law: tuple[ContactLaw, np.ndarray] = (PENALTY, np.zeros(1))):
        self.model, self.bodies, self.device, self._linear, self._sinks = model, bodies, device, linear, local
        self._by_place = local and by_place and lacks_something(model, bodies)
        self.kernels, self._terms, self.batch = rigid_kernels.kernels(law[0]), law[1], poses.shape[1]
        self.has_friction = bool((friction > 0.0).any())
        self._coefficient = torch.as_tensor(friction, dtype=torch.float64, device=device)
        self.springs = None if mount is None else Springs(mount, len(bodies), device)
        self.solid = model.mesh.faces.shape[1] == 6
        cuts, self._factor, self._onset = (1, 1.0, 0.0) if self.solid else sheet_contact(bodies, model.element_size)
        self._finest = CUTS[-1] if self.solid else 0  # cuts of a linear face do not change
        self._passage = Intrusion(model.mesh, bodies, model.element_size, device=device,
                                  sinks=SATURATED_BY_PLACE * self._by_place,
                                  **({} if self.solid else {"steps": 3 * cuts}))
        self._body_points = BodyPoints(model, bodies, poses.shape[1], device=device)
        self._overlap = torch.zeros(poses.shape[1], dtype=torch.float64, device=device)
        reachable, self._cuts = plan(bodies, model, poses, cuts, local=local, device=device,
                                     by_place=self._by_place, sprung=mount is not None)
        self._area = model.mesh.face_area()
        self._core = wp.array([min(CORE * inner_radius(s), 1.0) for s in bodies.shapes], dtype=real, device=device)
        self.patches = [self._patch(b, np.flatnonzero(within)) for b, within in enumerate(reachable)]
        # whether friction limits follow the normal forces once they were renewed, see `coulomb`
        self.follows = not self.solid
        # measure at which the friction limits are renewed for the first time in a step
        self.friction_updated_below = 0.03 if self.solid else 0.3
        self.flat = all(isinstance(s, Plane) for s in bodies.shapes)
        # 1 for touches whose friction limits are those of the normal forces at every evaluation, not of the last
        # `update_friction` (B,)
        self.coulomb = torch.zeros_like(self._overlap)
        # origins and rotations of the bodies, now and when the step began
        self._now, self._before = ([torch.zeros(size, dtype=torch.float64, device=device) for size in (
            (*poses.shape[1:3], 3), (*poses.shape[1:3], 3, 3))] for _ in range(2))
        self._upload()

    def _patch(self, b: int, faces: np.ndarray) -> Patch:
        return make_patch(self.model.mesh, faces, self._area[faces], self.model.surface_modulus[faces],
                          self._cuts[b, faces], (self._factor, self._body_points.least))

    def _upload(self) -> None:
        batch, k = len(self.patches), self.kernels
        parts = self._parts = stacked([np.concatenate([patch.parts, self._body_points.parts(b, patch)])
                                       for b, patch in enumerate(self.patches)], NO_PART)
        listed = stacked([patch.nodes for patch in self.patches], np.array([-1]))
        faces, nodes = parts.shape[1], listed.shape[1]
        tensor = functools.partial(torch.as_tensor, device=self.device)
        zeros = functools.partial(torch.zeros, dtype=torch.float64, device=self.device)
        known = getattr(self, "dof", None)
        self._take(listed, self.model.free, self.model.mesh.points)
        self._of_body = tensor(parts["host"] >= 0)
        self._x, self._x_before = zeros(batch, nodes, 3), self.rest.view(batch, nodes, 3).clone()
        self._points, found = bound(k.Points, {
            **{name: parts[name] for name in ("shape", "local", "stiffness", "host", "spot", "leave", "soft")},
            "share": np.tile(parts["share"][:, :, None], 6),
            "bodies": self.bodies.on(self.device), "count": len(self.bodies),
            "coulomb": self.coulomb, "coefficient": self._coefficient, "onset": self._onset, "terms": self._terms,
            "x": self._x, "x_before": self._x_before, "origin": self._now[0], "turn": self._now[1],
            "origin_before": self._before[0], "turn_before": self._before[1]}, (batch, faces, 6), self.device)
        # of every contact point; a padded part has all its nodes at 0 and no stiffness
        self._local, self._values, self._stiffness = (found[name] for name in ("local", "shape", "stiffness"))
        self._sets = [found]
        found["gap"].fill_(1e30)
        found["owner"].fill_(-1)
        self.gap, self.body, self.normal, self.force, self._stiff, self._geometric = (
            found[name].flatten(1, 2) for name in ("gap", "body", "normal", "force", "stiff", "geometric"))
        if known is None or not torch.equal(known, self.dof):  # the same nodes may have more points
            self.response: Response = response(self.model.factor if self._linear else self.model.preconditioner,
                                               self.dof, device=self.device)
        at_rest = at_points(self._local, self._values, self.rest.view(batch, nodes, 3))
        self.local_indentation = LocalIndentation(self.model, parts, self.bodies, at_rest, (
            found["share"], found["soft"]), on=self._sinks, response=self.response if self._by_place else None)

    @property
    def symmetric(self) -> bool:
        """Whether the contact stiffness is symmetric."""
        return not (self.has_friction and bool(self.coulomb.any()))

    def faces(self, columns: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self._local[columns], self._values[columns]

    def own_stiffness(self, columns: torch.Tensor, geometric: torch.Tensor | None = None) -> torch.Tensor:
        own = self._stiff[columns]
        return own if geometric is None else own + geometric[:, None, None, None] * self._geometric[columns]

    def _place(self, bodies: list[torch.Tensor], pose: np.ndarray) -> None:
        for own, values in zip(bodies, (pose[..., :3, 3], pose[..., :3, :3]), strict=True):
            own.copy_(torch.as_tensor(values))

    def begin_step(self, before: np.ndarray, u: torch.Tensor, columns: torch.Tensor) -> None:
        """Begin a step of ``columns`` (k,) at the poses ``before`` (B, K, 4, 4) and the displacements u (3 n, B) [m]:
        slip counts from here. The others are done with theirs."""
        self._u_before, self._begun = u.clone(), before
        self._place(self._before, before)
        if self.springs is not None:  # where they let the bodies begin
            self._plan_for(before)
            self._place(self._now, before)
            self.evaluate(columns, self.gather(u[:, columns], columns))
            self._before[0].copy_(self._now[0])
            self._begun = self.springs.poses(before)
        self._begin_friction(columns)
        self._body_points.begin_step()
        self._stand(u)

    def move(self, pose: np.ndarray, columns: torch.Tensor | None = None) -> None:
        """Move the bodies to ``pose`` (B, K, 4, 4); ``columns`` are about to be solved there."""
        kept = self.friction_state()
        grown = (self._begun is not None and columns is not None  # the first move of a step
                 and self._body_points.add(columns, (self._begun, self._held_at(pose)), self._u_before, self.patches))
        self._place(self._now, self._held_at(pose))
        self._begun = None
        self._plan_for(pose)
        self._renew(kept) if grown else self._sink()
        self._overlap[columns] = 0.0

    def _plan_for(self, pose: np.ndarray) -> None:
        """The mounts, or the bodies without any, are at ``pose`` (B, K, 4, 4)."""
        self._plan = pose
        if self.springs is not None:
            self.springs.origin.copy_(torch.as_tensor(pose[..., :3, 3]))

    def _held_at(self, pose: np.ndarray) -> np.ndarray:
        """Poses (B, K, 4, 4) of the bodies whose mounts are at ``pose`` (B, K, 4, 4)."""
        return pose if self.springs is None else self.springs.poses(pose)

    def _sink(self) -> None:
        self.local_indentation.move(self._held_at(self._plan))
        if self.springs is not None:
            self.springs.seen()

    def follow(self) -> bool:
        if self.springs is None or not self._sinks or not self.springs.moved_on():
            return False
        self._sink()
        return True

    def _renew(self, kept: Any) -> None:
        """Go on with other contact points than those of the friction state ``kept``."""
        self._upload()
        self._sink()
        if self.has_friction:
            self.restore_friction(torch.arange(self.batch, device=self.device), kept)
            self._stand(self._u_before)

    def _stand(self, u: torch.Tensor) -> None:
        self._x_before.copy_((self.rest + self.gather(u)).view_as(self._x_before))

    def _launch(self, kernel: Any, columns: torch.Tensor) -> None:
        """Run a kernel over the parts of faces of ``columns`` (k,)."""
        wp.launch(kernel, dim=(self._local.shape[1], len(columns)), device=self.device, inputs=[
            self._points, wp.from_torch(columns.to(torch.int32))])

    def evaluate(self, columns: torch.Tensor, displacement: torch.Tensor) -> None:
        """Find gaps, forces and stiffness at displacements (k, 3 s) [m] of the patches; springs give way until they are
        in balance. The methods below report what the last evaluation found."""
        if not len(columns):
            return
        self._x[columns] = (self.rest[columns] + displacement).view(len(columns), -1, 3)
        if self.springs is None:
            self._launch(self.kernels.evaluate, columns)
            return
        wp.launch_tiled(self.kernels.settle, dim=[len(columns)], block_dim=256, device=self.device, inputs=[
            self._points, wp.from_torch(columns.to(torch.int32)), self.springs.arrays])

    def friction_state(self) -> Any:
        """See `Contact`, with the points."""
        return self._parts, super().friction_state()

    def restore_friction(self, columns: torch.Tensor, state: Any) -> None:
        """See `Contact`; points of a patch that has grown since take what they remembered."""
        parts, kept = state
        if parts is self._parts:
            super().restore_friction(columns, kept)
        elif self.has_friction:
            mine, theirs = ([found[name] for name in self._memory] for (found,) in (self._sets, kept))
            remember(mine, theirs, (parts, self._parts), columns.tolist())

    def local_energy(self, columns: torch.Tensor) -> torch.Tensor:
        """Elastic energy of the object that its elements do not show (k,) [J], see `local_indentation`."""
        own = (self._sets[0]["energy"][columns] * self._of_body[columns]).sum(dim=1)
        return own + self.local_indentation.energy(self.gap[columns], self._stiffness[columns], columns)

    def nodal(self, columns: torch.Tensor) -> torch.Tensor:
        """Contact forces on the nodes of the patches (k, 3 s) [N]."""
        return self.nodal_of(columns, self.force[columns])

    def _held(self, columns: torch.Tensor) -> torch.Tensor:
        each = torch.arange(len(self.bodies), device=self.device)  # `one_hot` waits for a GPU
        return (self.body[columns][:, :, None] == each).to(torch.float64)

    def on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Force on every touching body (k, K, 3) [N], world."""
        return -(self._held(columns).mT @ self.force[columns])

    def moment_on_bodies(self, columns: torch.Tensor) -> torch.Tensor:
        """Moment on every touching body about its origin (k, K, 3) [N m], world."""
        places, origin = self.places(columns, self._x[columns]), self._now[0][columns]  # origin (k, K, 3)
        about_world = self._held(columns).mT @ torch.linalg.cross(places, -self.force[columns])
        return about_world - torch.linalg.cross(origin, self.on_bodies(columns))

    def resolution(self, columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Number of points in contact (k,), the radius of a circle of their area over the element size there (k,) [-],
        the same of the contact with each body (k, K) [-], and the share of local indentation in each body's way (k, K)
        [-], see `LocalIndentation.resolution`."""
        gone = self.places(columns, (self._x - self.rest.view_as(self._x))[columns])
        gone = (gone * self.normal[columns]).sum(dim=2)
        return self.local_indentation.resolution(
            self.gap[columns], gone, self._held(columns), self.on_bodies(columns), columns)

    def reach(self, columns: torch.Tensor, move: torch.Tensor) -> torch.Tensor:
        own = wp.from_torch((move * self.mask[columns]).view(len(columns), -1, 3).contiguous(), dtype=vec3)
        part = torch.ones((len(columns), self._local.shape[1]), dtype=torch.float64, device=self.device)
        wp.launch(self.kernels.reach, dim=(self._local.shape[1], len(columns)), device=self.device, inputs=[
            self._points, wp.from_torch(columns.to(torch.int32)), self._core, own, wp.from_torch(part)])
        return part.amin(dim=1) if part.shape[1] else part.new_ones(len(columns))

    def extend_patch(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> torch.Tensor:
        """Extend the patches by surface that came into contact outside them at u (3 n, B), and by contact points where
        bodies were found between those; which touches have other contact points now (k,) bool: all, if one has, since
        they are laid out anew together."""
        pose, kept = self._held_at(pose), self.friction_state()
        faces, near = self._passage.check(columns, pose, u)
        self._overlap[columns] = torch.maximum(faces, near).amax(dim=1)
        moved, beside = self._body_points.renew(columns, pose, u, self.patches)
        inside = near > self._passage.tolerance
        met, cut = (((faces > depth) | inside).cpu().numpy() for depth in (0.0, self._passage.fine))
        grown = bool(moved)
        for b, touched, coarse in zip(columns.tolist(), met, cut, strict=True):
            patch = self.patches[b]
            extra = np.setdiff1d(np.flatnonzero(touched | beside[b]), patch.faces)
            coarse = coarse & (self._cuts[b] < self._finest)
            if len(extra) or coarse.any():
                self._cuts[b, coarse] = np.array([*CUTS[1:], CUTS[-1]])[np.searchsorted(CUTS, self._cuts[b, coarse])]
                self.patches[b] = self._patch(b, np.union1d(patch.faces, neighbours(self.model.mesh, extra)))
                grown = True
        if grown:
            self._renew(kept)
        return torch.full_like(columns, grown, dtype=torch.bool)
