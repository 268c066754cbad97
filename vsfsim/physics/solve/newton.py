"""Newton's method for one pose of the rigid bodies: the equilibrium of every touch of the batch.

    Pi(u) = sum of element energies - load . u + energy of the contact    ->    minimum

Each linear system is solved by `pcg`, or by `gmres` where contact is not symmetric, preconditioned by the rest-state
inverse with the contact block inverted exactly, or by a factor of a deformed state (`tangent_factor`).
Far from the solution, and after a step that failed, the tangent is projected to positive semi-definite; near it, and
under planes, the true one serves, and one that has negative curvature is shifted until it has none (`_descend`).

The *measure* of a touch is the sum of the lengths of its unbalanced nodal forces over that of the acting ones [-].
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact
from vsfsim.physics.elements.neo_hooke import CRUSHED
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.model import Model
from vsfsim.physics.solve.direction import linear_tolerance, newton_direction
from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.frames import Reason, SolverOptions
from vsfsim.physics.solve.step import LARGE, correct, farther
from vsfsim.physics.solve.tangent_factor import TangentFactors

_SHIFT, _MOST_SHIFT, _SHIFTS = 0.05, 1.0, 3  # of negative curvature: least, from which on it creeps; times
_SECOND = 10  # conjugate-gradient iterations of a step's second-order correction, which takes 2 to 4
# steps in a row, shorter than this, that points on the wrong side of a body may cost before a touch counts as lost
_BARRED, _SHORT = 2, 0.1
State = dict[str, torch.Tensor]
"""Forces (internal, contact, residual), energies (energy, potential), least det F (det), points on the wrong side of a
body (wrong_side) and measure of some touches, one column or entry each."""


class Equilibrium:
    """The displacements of a batch of touches, and Newton's method on them.

    Args:
        model: the body.
        elasticity: its elements, begun for the batch.
        contact: the contact.
        options: limits.
        floor: forces under this count as zero [N].
        accept: measure at which a touch counts as balanced that rounding keeps from coming closer; None for the
            tolerance.
    """

    u: torch.Tensor
    """Displacements (3 n, B) [m]."""
    newton: np.ndarray
    """Newton iterations of every touch since `reset_counts` (B,)."""
    cg: np.ndarray
    """Conjugate-gradient iterations of every touch since `reset_counts` (B,)."""
    reason: np.ndarray
    """Why a touch is not in equilibrium, `Reason` (B,)."""
    least: torch.Tensor
    """Potential under which a state of a touch lies on another branch than the one that it comes from (B,) [J]."""

    def __init__(self, model: Model, elasticity: Elasticity, contact: Contact, options: SolverOptions, *,
                 floor: float, accept: float | None = None):
        self.accept = options.tolerance if accept is None else accept
        self.model, self.elasticity, self.contact = model, elasticity, contact
        self.options, self.floor = options, floor
        self.device = contact.device
        batch = contact.batch
        self.real = torch.float64 if elasticity.real is wp.float64 else torch.float32
        self.u = torch.zeros((3 * len(model.mesh.points), batch), dtype=self.real, device=self.device)
        self.load = torch.as_tensor(model.load, device=self.device)[:, None]
        self.free = torch.as_tensor(model.free, device=self.device)[:, None]
        self.every = torch.arange(batch, device=self.device)
        self.least = torch.full((batch,), -float("inf"), dtype=torch.float64, device=self.device)
        self._acts = torch.ones_like(self.least)  # sum of the lengths of the acting forces at the last state [N]
        self.factors = TangentFactors(model, elasticity, contact)
        self.reset_counts()

    def reset_counts(self) -> None:
        """Count iterations from zero."""
        self.factors.begin_frame()
        self.newton, self.cg, self.reason = (np.zeros(len(self.every), int) for _ in range(3))

    def exhausted(self, host: np.ndarray) -> np.ndarray:
        """Which of the touches ``host`` (k,) have used all iterations of a frame (k,) bool."""
        return (self.cg[host] >= self.options.cg_frame) | (self.newton[host] >= self.options.newton_frame)

    # ------------------------------------------------------------------------------------------ state

    def evaluate(self, columns: torch.Tensor) -> State:
        """Forces, potential and residual of ``columns`` (k,) at the present displacements."""
        self._strain(columns)
        return self._again(columns)

    def _again(self, columns: torch.Tensor) -> State:
        moved = self.u[:, columns]
        self.evaluate_contact(columns, moved)
        return self._state(columns, moved)

    def least_det(self, columns: torch.Tensor) -> torch.Tensor:
        """The least det F of ``columns`` (k,) at the present displacements (k,) [-]."""
        self._strain(columns)
        return wp.to_torch(self.elasticity.least_det)[columns].to(torch.float64)

    def _strain(self, columns: torch.Tensor) -> None:
        with clock.measure("forces"):
            self.elasticity.forces(wp.from_torch(columns.to(torch.int32)), wp.from_torch(self.u))

    def evaluate_contact(self, columns: torch.Tensor, moved: torch.Tensor) -> None:
        """Evaluate the contact alone, at the displacements ``moved`` (3 n, k) [m] of ``columns`` (k,)."""
        dof = self.contact.dof[columns]
        self.contact.evaluate(columns,
                              moved.gather(0, dof.clamp(min=0).T).T.to(torch.float64) * self.contact.mask[columns])

    def renew_friction(self, columns: torch.Tensor) -> State:
        """The state after renewing friction limits and tangent planes; the measure counts Coulomb's residual, too."""
        self.contact.update_friction(columns)
        out = self._again(columns)
        out["measure"] = out["measure"] + self.contact.friction_residual(columns) / self._acting(out["contact"])
        return out

    def _state(self, columns: torch.Tensor, moved: torch.Tensor) -> State:
        internal = wp.to_torch(self.elasticity.internal)[:, columns].to(torch.float64)
        contact = spread(self.contact.dof[columns], self.contact.nodal(columns), len(internal))
        energy = wp.to_torch(self.elasticity.energy)[columns]
        bodies = self.contact.energy(columns) + self.contact.carried(columns)
        potential = energy + bodies - (self.load * moved).sum(dim=0)
        residual = (self.load + contact - internal) * self.free
        self._acts[columns] = self._acting(contact)
        return {"internal": internal, "contact": contact, "potential": potential, "residual": residual,
                "energy": energy, "wrong_side": self.contact.wrong_side(columns),
                "det": wp.to_torch(self.elasticity.least_det)[columns].to(torch.float64),
                "measure": self.measure(residual, contact)}

    def measure(self, residual: torch.Tensor, contact: torch.Tensor) -> torch.Tensor:
        """Unbalanced over acting force (k,) [-]: sums of the lengths of nodal vectors (3 n, k) [N]."""
        return _size(residual) / self._acting(contact)

    def _acting(self, contact: torch.Tensor) -> torch.Tensor:
        return torch.maximum(_size(contact), _size(self.load)).clamp(min=self.floor)

    # ------------------------------------------------------------------------------------------ Newton

    def solve(self, columns: torch.Tensor, state: State, tolerance: float, deadline: float) -> None:
        """Newton's method on ``columns`` until the measure of each is under ``tolerance``; updates state, counts and
        reasons."""
        has_friction = self.contact.has_friction
        stuck = torch.zeros(len(columns), dtype=torch.bool, device=self.device)
        # whose friction limit is not yet Coulomb's, and the measure at which it is renewed
        held = torch.full((len(columns),), has_friction, dtype=torch.bool, device=self.device)
        within = torch.full_like(state["measure"], self.contact.friction_updated_below)
        renewed = torch.full_like(within, float("inf"))  # measure when the limit was renewed last
        renew = torch.ones_like(stuck)  # whose tangent must be recomputed
        safe = torch.zeros_like(stuck)  # whose last step failed: they get the projected tangent
        # least measure since friction was renewed, and iterations in which it did not fall by a tenth
        least = torch.full_like(within, float("inf"))
        idle = torch.zeros_like(least, dtype=torch.int64)
        rounded = torch.zeros_like(stuck)  # at the floor of rounding
        apart = torch.zeros_like(stuck)  # whose friction limits do not follow the normal forces: that led nowhere
        self._foreign = torch.zeros_like(self.every, dtype=torch.bool)  # whose tangent belongs to another state
        self._barred = torch.zeros_like(self.every)  # steps in a row that points on the wrong side of a body kept short
        self._shift = torch.zeros(len(self.every), dtype=torch.float64, device=self.device)
        self.contact.coulomb[columns] = 0.0
        self.reason[columns.cpu().numpy()] = Reason.ITERATIONS
        self._deadline = self.contact.deadline = deadline
        self._aim = tolerance
        for _ in range(self.options.newton * (1 + has_friction)):
            if self.contact.follow():
                state.update(self._again(columns))
            ready = held & ((state["measure"] <= torch.maximum(within, torch.full_like(within, tolerance))) | stuck)
            if has_friction and bool(ready.any()):
                at = ready.nonzero()[:, 0]
                follow = at[~apart[at] & (renewed[at] <= self.contact.follows_below)]
                self.contact.coulomb[columns[follow]] = 1.0
                for key, value in self.renew_friction(columns[at]).items():
                    state[key][..., at] = value
                present = state["measure"][at]
                # in equilibrium under the renewed limit: done. If not, the measure must fall to a tenth before the
                # limit is renewed again
                held[at] = present > tolerance
                within[at], renewed[at] = torch.minimum(0.1 * present, within[at]), present
                stuck[at] &= ~(present > tolerance) | (present > 0.5)
                renew[at] = True
                least[at] = float("inf")
            open_ = ((held | (state["measure"] > tolerance)) & ~stuck).nonzero()[:, 0]
            if not len(open_):
                break
            active = columns[open_]
            host = active.cpu().numpy()
            # an iteration needs a back-solve at least: where one would not end in time it is not begun
            if clock.now() + self.contact.response.took > deadline:
                self.reason[host] = Reason.TIME
                break
            exhausted = torch.as_tensor(self.exhausted(host), device=self.device)
            if bool(exhausted.any()):
                stuck[open_[exhausted]] = True
                held[open_[exhausted]] = False
                continue
            before = state["measure"][open_]
            # far from the solution the projected tangent is safe; near it the true one converges quadratically, and
            # that of the step before is as good. Under planes contact has no geometric term, which spoils the true one.
            far = (before > 0.3) | safe[open_]
            convex = safe[open_] if self.contact.shifts and not has_friction and self.contact.flat else far
            fresh = renew[open_] | (before > 0.05) | self._foreign[active]
            fresh |= self.factors.renew(active, self.u, deadline)
            self._foreign[active] = False
            for projected, which in ((True, fresh & convex), (False, fresh & ~convex)):
                if bool(which.any()):
                    self._tangent(active[which], projected=projected)
            direction, steps, curved, stiffness, mode = self._descend(active, state["residual"][:, open_], ~far,
                                                                      idle[open_] > 0)
            self.newton[host] += 1
            self.cg[host] += steps.cpu().numpy()
            follows = self.contact.coulomb[active] > 0.0
            plain = direction
            if self.contact.shifts or not bool(follows.all()):
                plain = correct(self, active, direction, stiffness, state["residual"][:, open_])
            plain = plain if self.contact.shifts else torch.where(follows, direction, plain)
            slow = ((idle[open_] > 0) & ~far).nonzero()[:, 0]
            if self._follows_modes and len(slow):
                plain[:, slow] = farther(self, active[slow], plain[:, slow], (direction[:, slow], mode[:, slow]),
                                         stiffness[slow], state["residual"][:, open_[slow]],
                                         state["wrong_side"][open_[slow]])
            moved = self._step(active, open_, (plain, direction), state, tolerance)
            lost = (follows & ~moved).nonzero()[:, 0]
            if len(lost):
                apart[open_[lost]] = moved[lost] = True
                self.contact.coulomb[active[lost]] = 0.0
                for key, value in self.evaluate(active[lost]).items():
                    state[key][..., open_[lost]] = value
            renew[open_] = (state["measure"][open_] > 0.5 * before) | curved
            # not even a projected step helps: the floor of rounding, or no equilibrium
            present = state["measure"][open_]
            rounded[open_] = (present <= self.accept) & (present > 0.5 * before) & ~held[open_]
            stuck[open_] = ~moved & safe[open_] | rounded[open_]
            idle[open_] = torch.where(state["measure"][open_] < 0.9 * least[open_], 0, idle[open_] + 1)
            least[open_] = torch.minimum(least[open_], state["measure"][open_])
            lost = open_[(idle[open_] >= self.contact.patience) | (self._barred[active] >= _BARRED)]
            stuck[lost], held[lost] = True, False
            self.reason[active[stuck[open_]].cpu().numpy()] = Reason.STALLED
            safe[open_] = ~moved
        self.contact.coulomb[columns] = 0.0
        balanced = ((state["measure"] <= tolerance) | rounded) & ~held
        self.reason[columns[balanced].cpu().numpy()] = Reason.NONE
        self.reason[columns[balanced & (state["wrong_side"] > 0)].cpu().numpy()] = Reason.WRONG_SIDE
        self.reason[columns[balanced & (state["det"] < CRUSHED)].cpu().numpy()] = Reason.CRUSHED
        self.reason[columns[balanced & (state["det"] <= 0.0)].cpu().numpy()] = Reason.INVERTED

    @property
    def _follows_modes(self) -> bool:
        """Whether a line search follows modes of negative curvature: without friction the potential tells which of two
        states of a solid is the better one, and on a patch that is not large what is tried costs little."""
        return self.contact.shifts and not self.contact.has_friction and self.contact.dof.shape[1] <= LARGE

    def _tangent(self, columns: torch.Tensor, *, projected: bool) -> None:
        with clock.measure("tangents"):
            self.elasticity.tangent(wp.from_torch(columns.to(torch.int32)), wp.from_torch(self.u), projected=projected)

    def _descend(self, columns: torch.Tensor, residual: torch.Tensor, near: torch.Tensor,
                 creeps: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, Any, torch.Tensor]:
        """Directions of descent (3 n, k) [m], the iterations that they took (k,), which met negative curvature (k,)
        bool, the contact stiffness that they were found with, and modes of negative curvature to follow (3 n, k) [m], 0
        for none.

        A tangent with negative curvature is shifted until it has none, in units of the preconditioner (Nocedal and
        Wright 2006, algorithm 3.3); later iterations begin with a part of that shift. Along a mode that is just
        unstable a step then multiplies what has begun, where the projected tangent, which has lost all negative terms
        of its elements, creeps. That one is taken where shifts do not suffice, or are so large that they creep, too.

        Before that the geometric term of the contact is left out, without which the tangent is convex under a ball that
        is deep in a body: its surface may slide around the ball, and the equilibrium that is nearest is a saddle. Where
        the residual ``creeps`` (k,) bool, the shift leads on from there, or without friction the mode itself, along
        which the potential tells how far (Steihaug 1983, with a line search in place of a trust region).
        """
        shift = self._shift[columns]
        mode = torch.zeros((len(self.u), len(columns)), dtype=self.real, device=self.device)
        direction, steps, negative, stiffness = self._direction(columns, residual, near, shift=shift, mode=mode)
        curved = negative > 0.0
        if self._follows_modes:
            negative[creeps & near] = 0.0
        mode[:, ~(creeps & near)] = 0.0
        shift *= torch.where((shift > _SHIFT) | curved, 0.25, 0.0)
        at = (curved & ~creeps).nonzero()[:, 0]
        if self.contact.shifts and len(at):
            near = near.clone()
            near[at] = False
            direction[:, at], more, negative[at], stiffness[at] = self._direction(columns[at], residual[:, at],
                                                                                  near[at])
            steps[at] += more
        for _ in range(_SHIFTS if self.contact.shifts else 0):
            at = ((negative > 0.0) & (shift < _MOST_SHIFT)).nonzero()[:, 0]
            if not len(at) or clock.now() > self._deadline:
                break
            shift[at] = torch.maximum(4.0 * shift[at] + 2.0 * negative[at], torch.full_like(shift[at], _SHIFT))
            direction[:, at], more, negative[at], _ = self._direction(columns[at], residual[:, at], near[at],
                                                                      shift=shift[at])
            steps[at] += more
        left = negative > 0.0
        if bool(left.any()) and clock.now() <= self._deadline:
            shift[left] = 0.0
            self._tangent(columns[left], projected=True)
            direction[:, left], more, _, stiffness[left] = self._direction(
                columns[left], residual[:, left], torch.zeros_like(near[left]))
            steps[left] += more
        self._shift[columns] = shift
        return direction, steps, curved, stiffness, mode

    def _direction(self, columns: torch.Tensor, residual: torch.Tensor, near: torch.Tensor,
                   iterations: int | None = None, shift: torch.Tensor | None = None, mode: torch.Tensor | None = None,
                   ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        opt = self.options
        left = self._aim * self._acts[columns] / _size(residual) if self.model.keeps_volume else None
        return newton_direction(self.elasticity, self.contact, columns, residual.to(self.real), near=near,
                                iterations=iterations or opt.cg, plain=opt.cg_plain, deadline=self._deadline,
                                tolerance=linear_tolerance(opt, near, left), shift=shift, factors=self.factors,
                                mode=mode)

    def _step(self, columns: torch.Tensor, at: torch.Tensor, directions: tuple[torch.Tensor, torch.Tensor],
              state: State, tolerance: float) -> torch.Tensor:
        """Halve the step until the potential falls by Armijo's rule, or the residual decreases where rounding hides the
        fall.

        ``directions`` (3 n, k) [m]: at every length the first is tried, and where it fails the second.
        ``at``: entries of ``columns`` in ``state``, which is updated. Returns which touches moved (k,) bool.
        """
        base = self.u[:, columns]
        potential, measure, wrong_side = state["potential"][at], state["measure"][at], state["wrong_side"][at]
        slopes = [(state["residual"][:, at] * direction).sum(dim=0) for direction in directions]
        step = torch.ones_like(slopes[0])
        differ = (directions[0] != directions[1]).any(dim=0)
        barred = torch.zeros_like(differ)

        def accepted(new: State, pending: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
            way = step[pending] * slope[pending]
            falls = (new["potential"] <= potential[pending] - 1e-4 * way) & (way > 0.0)  # nowhere is no step
            decreases = ((new["measure"] < self.contact.decrease * measure[pending])
                         & (measure[pending] < self.contact.potential_trusted_above))
            if self.contact.has_friction:
                decreases |= new["measure"] <= tolerance  # friction depends on the path: no potential that must fall
            follows = self.contact.coulomb[columns[pending]] > 0.0  # there is no potential
            decreases |= follows & (new["measure"] < (1.0 - 0.05 * step[pending]) * measure[pending])
            good = (falls & ~follows) | decreases
            beyond = (new["wrong_side"] > wrong_side[pending]) | (new["potential"] < self.least[columns[pending]])
            barred[pending] |= good & beyond
            return good & ~beyond

        moved, pending = torch.zeros_like(differ), torch.arange(len(columns), device=self.device)
        for halvings in range(12):
            if halvings and clock.now() > self._deadline:
                break
            for direction, slope, tried in zip(directions, slopes, (torch.ones_like(differ), differ), strict=True):
                trying = pending[tried[pending]]
                if not len(trying):
                    continue
                self.u[:, columns[trying]] = base[:, trying] + step[trying].to(self.real) * direction[:, trying]
                new = self.evaluate(columns[trying])
                good = accepted(new, trying, slope)
                bent = (~good).nonzero()[:, 0]
                if len(bent) and self.model.keeps_volume:
                    later = self._second_order(columns[trying[bent]], new["residual"][:, bent])
                    for key in new:
                        new[key][..., bent] = later[key]
                    good[bent] = accepted(later, trying[bent], slope)
                done = trying[good]
                for key in state:
                    state[key][..., at[done]] = new[key][..., good]
                moved[done] = True
                pending = pending[~moved[pending]]
                if not len(pending):
                    break
            if not len(pending):
                break
            step[pending] *= 0.5
        self._barred[columns] = torch.where(barred & (step < _SHORT), self._barred[columns] + 1, 0)
        if len(pending):
            self.u[:, columns[pending]] = base[:, pending]
            self.evaluate(columns[pending])
        return moved

    def _second_order(self, columns: torch.Tensor, residual: torch.Tensor) -> State:
        """Correct a step at its end, where ``residual`` (3 n, k) [N] is unbalanced; returns the state there.

        Points move along straight lines, which at second order of the step changes a volume that hardly can change
        (Maratos effect; Nocedal and Wright 2006, section 15.5). A few iterations take most of that back, where halving
        the step would leave a sixteenth of it.
        """
        self._tangent(columns, projected=True)
        self._foreign[columns] = True
        more, steps, _, _ = self._direction(columns, residual, torch.zeros_like(columns, dtype=torch.bool), _SECOND)
        self.cg[columns.cpu().numpy()] += steps.cpu().numpy()
        self.u[:, columns] += more
        return self.evaluate(columns)


def _size(v: torch.Tensor) -> torch.Tensor:
    x, y, z = v.view(-1, 3, v.shape[1]).unbind(dim=1)
    return (x * x + y * y + z * z).sqrt().sum(dim=0)  # a twentieth of the time of torch's norm along a short axis
