"""The `linear` tier: linear elasticity of the rest state against the exact contact, as one condensed problem a
frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from vsfsim.physics import clock
from vsfsim.physics.contact import condensed
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.solve import increments
from vsfsim.physics.solve.newton import Equilibrium, State

# renewals of the friction limit in a frame, and the relative change that ends them (the `fem` tier's tolerance)
_RENEWALS, RENEWED = 60, 5e-4
# of the tolerance, with friction: contact is so stiff that displacements known to 1e-4 leave forces open by 3 %, and
# friction limits renewed from such forces jump about (130 renewals in 8 frames of a dragged plate, 30 with this)
_CLOSER = 1e-2
_FOLLOWED = 8  # times that the local indentation may follow bodies that springs carry
_GROWTHS = 12  # times that the patch may grow in a frame
# times that a way may be halved, with friction but the last: of a thin wall the inner face lies in a body that has come
# a long way
_HALVINGS = 4


class LinearTier:
    """Frames of linear elasticity for a batch of touches.

    Args:
        balance: the batch; its displacements are set, its Newton iterations are not used.
    """

    checked: bool
    """Whether the last frame ended with a look where the bodies are: in time, and before the patch grew too often."""

    def __init__(self, balance: Equilibrium):
        self._balance, self._contact = balance, balance.contact
        model = balance.model
        load = (model.load * model.free)[:, None]
        sag = model.factor.solve(load) if load.any() else np.zeros_like(load)  # a back-solve is as long as a frame
        self._sag = torch.as_tensor(np.repeat(sag, len(balance.every), axis=1), device=balance.device)
        self._last = torch.zeros_like(self._sag)  # contact forces (3 n, B) [N] of the last frame that arrived

    @property
    def accept(self) -> float:
        """Measure under which a frame counts as balanced [-]."""
        accept = self._balance.options.tolerance
        return max(accept, RENEWED) if self._contact.has_friction else accept

    def frame(self, before: np.ndarray, way: Sequence[np.ndarray], start: torch.Tensor,
              deadline: float) -> tuple[torch.Tensor, State]:
        """Solve one frame.

        Args:
            before: poses of the frame before (B, K, 4, 4).
            way: poses on the way to those of this frame (B, K, 4, 4), which end it: of a thin wall both faces lie in a
                body that has come further than the wall is thick, and forces are found that push them apart. Friction
                remembers nothing of them.
            start: first guess of the contact forces (B, 3 s) [N].
            deadline: `clock.now` after which no iteration begins [s].

        Returns:
            The contact forces (3 n, B) [N] and the state of all touches.
        """
        balance, contact = self._balance, self._contact
        every, contact.deadline = balance.every, deadline
        contact.begin_step(before, balance.u)
        friction, lost = contact.friction_state(), torch.zeros(len(every), dtype=torch.float64, device=balance.device)
        for pose in way[:-1]:
            if clock.now() > deadline:
                lost += float("inf")
                break
            start, error, _ = self._arrive(before, pose, start, deadline, _HALVINGS)
            before, lost = pose, torch.maximum(lost, error)
        contact.restore_friction(every, friction)
        force, error, on_bodies = self._arrive(before, way[-1], start, deadline,
                                                0 if contact.has_friction else _HALVINGS)
        error = _followed(force, error, lost)
        det = balance.least_det(every)
        balance.evaluate_contact(every, balance.u)
        u = balance.u
        internal = self._times_stiffness(u)
        acting = spread(contact.dof, force, len(u))
        residual = (balance.load + acting - internal) * balance.free
        state = {"internal": internal, "contact": acting, "residual": residual,
                 "measure": torch.maximum(balance.measure(residual, acting), error), "det": det,
                 "energy": 0.5 * (u * internal).sum(dim=0), "wrong_side": contact.wrong_side(every), **on_bodies}
        contact.end_step(every)
        return acting, state

    def _arrive(self, before: np.ndarray, pose: np.ndarray, start: torch.Tensor, deadline: float,
                halvings: int) -> tuple[torch.Tensor, torch.Tensor, State]:
        """Contact forces (B, 3 s) [N] at ``pose`` (B, K, 4, 4), their relative errors (B,) and what acts on the bodies;
        from the first guess ``start``, and by halves of the way from ``before`` where a touch finds none at once."""
        balance, contact = self._balance, self._contact
        every = balance.every
        contact.move(pose, every)
        for growths in range(_GROWTHS, -1, -1):
            with clock.measure("contact"):
                force, error = self._solve(start, deadline)
                for _ in range(_FOLLOWED):
                    if not contact.follow() or clock.now() > deadline:
                        break
                    force, error = self._solve(force, deadline)
            error = torch.where(self._through(before, pose, force), float("inf"), error)
            arrived = bool((error <= self.accept).all())
            if not arrived and halvings and clock.now() <= deadline:
                middle = increments.between(before, pose, 0.5)
                force, lost, _ = self._arrive(before, middle, contact.gather(self._last), deadline, halvings - 1)
                force, error, on_bodies = self._arrive(middle, pose, force, deadline, halvings - 1)
                return force, _followed(force, error, lost), on_bodies
            # forces on the bodies are read where the contact gave ``force``: at the displacements that it causes, the
            # stiff contact reports forces with a far larger error than that of the displacements
            on_bodies = {"body_force": contact.on_bodies(every), "body_moment": contact.moment_on_bodies(every)}
            balance.u.copy_(self._sag + contact.response.patch(every, force))
            whole = spread(contact.dof, force, len(balance.u))
            self.checked = growths > 0 and clock.now() <= deadline
            if not self.checked or not contact.extend_patch(every, pose, balance.u):
                break
            start = contact.gather(whole)  # from no force under a deep body the next may lie on its other side
        if arrived:
            self._last = whole
        return force, error, on_bodies

    def _through(self, before: np.ndarray, pose: np.ndarray, force: torch.Tensor) -> torch.Tensor:
        """Touches (B,) whose bodies went from ``before`` to ``pose`` (B, K, 4, 4) along the force that they had on the
        object, and have none (B, 3 s) [N] there: they went through it, or slipped off."""
        moved = torch.as_tensor((pose - before)[:, :, :3, 3].sum(axis=1), device=force.device)
        pushed = self._last.view(-1, 3, len(force)).sum(dim=0).T
        return (force == 0.0).all(dim=1) & ((pushed * moved).sum(dim=1) > 0.0)

    def _solve(self, start: torch.Tensor, deadline: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Contact forces (B, 3 s) [N] and their relative errors (B,); the friction limit is renewed until it no longer
        changes."""
        contact, balance = self._contact, self._balance
        every = balance.every
        sag = contact.gather(self._sag)
        tolerance = balance.options.tolerance * (_CLOSER if contact.has_friction else 1.0)
        for _ in range(_RENEWALS if contact.has_friction else 1):
            force, error = condensed.solve(contact, every, sag, torch.zeros_like(sag), iterations=100,
                                           tolerance=tolerance, start=start, deadline=deadline)
            if contact.has_friction:
                moved = sag + (contact.compliance @ force[:, :, None])[:, :, 0]
                contact.evaluate(every, moved, force)
                contact.update_friction(every)
                contact.evaluate(every, moved, force)
                off = ((contact.nodal(every) - force).norm(dim=1)
                       + contact.friction_residual(every)) / force.norm(dim=1).clamp(min=balance.floor)
                error, start = torch.maximum(error, off), force
                if bool((error <= RENEWED).all()) or clock.now() > deadline:
                    break
        return force, error

    def _times_stiffness(self, u: torch.Tensor) -> torch.Tensor:
        """Rest stiffness times u (3 n, B)."""
        factor, device = self._balance.model.factor, self._balance.device
        if device == "cpu":
            return torch.as_tensor(factor.stiffness @ u.numpy())
        return factor.stiffness_on(device) @ u


def _followed(force: torch.Tensor, error: torch.Tensor, lost: torch.Tensor) -> torch.Tensor:
    """Relative errors (B,) at the end of a way: those ``lost`` on it count where no ``force`` (B, 3 s) [N] is left, for
    the body may have come through the object there."""
    return torch.where((force == 0.0).all(dim=1), torch.maximum(error, lost), error)
