"""Newton's method for one pose of the rigid bodies: the equilibrium of every touch of the batch.

    Pi(u) = sum of element energies - load . u + energy of the contact    ->    minimum

Each linear system goes to `pcg`, preconditioned by the rest-state inverse with the contact block inverted exactly. Far
from the solution the tangent is projected to positive semi-definite; near it the true one converges quadratically.
"""

from __future__ import annotations

import time

import numpy as np
import torch
import warp as wp

from vsfsim.physics import clock
from vsfsim.physics.contact.rigid import Touching
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.model import Model
from vsfsim.physics.solve.direction import newton_direction
from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.frames import Reason, SolverOptions

State = dict[str, torch.Tensor]


class Equilibrium:
    """Displacements u (3 n, B) [m] of a batch and the means to bring them into balance.

    newton, cg: iterations of every touch since `count` (B,). reason: why a touch is not in balance, `Reason` (B,).

    Args:
        model: the body. elasticity: its elements, begun for the batch. touching: the contact.
        options: limits. floor: forces under this are zero [N].
    """

    def __init__(self, model: Model, elasticity: Elasticity, touching: Touching, options: SolverOptions, *,
                 floor: float):
        self.model, self.elasticity, self.touching, self.options, self.floor = (model, elasticity, touching, options,
                                                                                floor)
        self.device = touching.device
        batch = touching.batch
        self.real = torch.float64 if elasticity.real is wp.float64 else torch.float32
        self.u = torch.zeros((3 * len(model.mesh.points), batch), dtype=self.real, device=self.device)
        self.load = torch.as_tensor(model.load, device=self.device)[:, None]
        self.free = torch.as_tensor(model.free, device=self.device)[:, None]
        self.every = torch.arange(batch, device=self.device)
        self.count()

    def count(self) -> None:
        """Begin to count iterations anew."""
        self.newton, self.cg = np.zeros(len(self.every), int), np.zeros(len(self.every), int)
        self.reason = np.zeros(len(self.every), int)

    def spent(self, host: np.ndarray) -> np.ndarray:
        """Which of the touches ``host`` (k,) have taken all the iterations that a frame may take (k,) bool."""
        return (self.cg[host] >= self.options.cg_frame) | (self.newton[host] >= self.options.newton_frame)

    # ------------------------------------------------------------------------------------------ state

    def evaluate(self, columns: torch.Tensor) -> State:
        """Forces, potential and residual of ``columns`` (k,) at the present displacements."""
        index = wp.from_torch(columns.to(torch.int32))
        with clock.measure("forces"):
            self.elasticity.forces(index, wp.from_torch(self.u))
        dof = self.touching.dof[columns]
        moved = self.u[:, columns]
        self.touching.evaluate(columns,
                               moved.gather(0, dof.clamp(min=0).T).T.to(torch.float64) * self.touching.real[columns])
        return self._state(columns, moved)

    def renew_friction(self, columns: torch.Tensor, state: State) -> State:
        """The state with friction's limit and tangent plane made present."""
        if not self.touching.rubs:
            return state
        self.touching.lag(columns)
        dof = self.touching.dof[columns]
        moved = self.u[:, columns]
        self.touching.evaluate(columns,
                               moved.gather(0, dof.clamp(min=0).T).T.to(torch.float64) * self.touching.real[columns])
        out = self._state(columns, moved)
        out["measure"] = out["measure"] + self.touching.unlawful(columns) / self._acting(out["contact"])
        return out

    def _state(self, columns: torch.Tensor, moved: torch.Tensor) -> State:
        internal = wp.to_torch(self.elasticity.internal)[:, columns].to(torch.float64)
        pushed = self.touching.nodal(columns)
        contact = spread(self.touching.dof[columns], pushed, len(internal))
        energy = wp.to_torch(self.elasticity.energy)[columns]
        potential = energy + self.touching.energy(columns) - (self.load * moved).sum(dim=0)
        residual = (self.load + contact - internal) * self.free
        state = {"internal": internal, "contact": contact, "potential": potential, "residual": residual,
                 "energy": energy,
                 "det": wp.to_torch(self.elasticity.least_det)[columns].to(torch.float64)}
        state["astray"] = self.touching.astray(columns)
        state["measure"] = self.measure(residual, contact)
        return state

    def measure(self, residual: torch.Tensor, contact: torch.Tensor) -> torch.Tensor:
        """Unbalanced force over acting force (k,): sums of the lengths of nodal vectors."""
        return _size(residual) / self._acting(contact)

    def _acting(self, contact: torch.Tensor) -> torch.Tensor:
        return torch.maximum(_size(contact), _size(self.load)).clamp(min=self.floor)

    # ------------------------------------------------------------------------------------------ Newton

    def solve(self, columns: torch.Tensor, state: State, tolerance: float, deadline: float) -> None:
        """Newton's method on ``columns`` until each one's measure is under ``tolerance``; updates state, counts and
        reasons."""
        rubs = self.touching.rubs
        stuck = torch.zeros(len(columns), dtype=torch.bool, device=self.device)
        # whose friction limit is not the present one
        held = torch.full((len(columns),), rubs, dtype=torch.bool, device=self.device)
        within = torch.full_like(state["measure"], self.touching.within)  # measure at which the limit is renewed
        renew = torch.ones_like(stuck)  # whose tangent must be made anew
        safe = torch.zeros_like(stuck)  # whose last step failed: they get the projected tangent
        # measure since friction was renewed, and iterations in which it did not fall by a tenth
        least = torch.full_like(within, float("inf"))
        idle = torch.zeros_like(least, dtype=torch.int64)
        self.reason[columns.cpu().numpy()] = Reason.ITERATIONS
        for _ in range(self.options.newton * (1 + rubs)):
            ready = held & ((state["measure"] <= torch.maximum(within, torch.full_like(within, tolerance))) | stuck)
            if rubs and bool(ready.any()):
                at = ready.nonzero()[:, 0]
                for key, value in self.renew_friction(columns[at], state).items():
                    state[key][..., at] = value
                present = state["measure"][at]
                # balanced under the present limit: done. If not, a tenth of what is missing is asked for before it is
                # renewed again
                held[at] = present > tolerance
                within[at] = torch.minimum(0.1 * present, within[at])
                stuck[at] &= ~(present > tolerance) | (present > 0.5)
                renew[at] = True
                least[at] = float("inf")
            open_ = ((held | (state["measure"] > tolerance)) & ~stuck).nonzero()[:, 0]
            if not len(open_):
                break
            active = columns[open_]
            host = active.cpu().numpy()
            if time.perf_counter() > deadline:
                self.reason[host] = Reason.TIME
                break
            spent = torch.as_tensor(self.spent(host), device=self.device)
            if bool(spent.any()):
                stuck[open_[spent]] = True
                held[open_[spent]] = False
                continue
            before = state["measure"][open_]
            # far off, the projected tangent is the safe one; near by, the true one converges quadratically,
            # and that of the step before is as good
            far = (before > 0.3) | safe[open_]
            fresh = renew[open_] | (before > 0.05)
            for projected, which in ((True, fresh & far), (False, fresh & ~far)):
                if bool(which.any()):
                    self._tangent(active[which], projected=projected)
            direction, steps, negative, stiffness = self._direction(active, state["residual"][:, open_], ~far)
            if bool(negative.any()):
                # not a bowl along some direction: take the projected tangent, which always is
                self._tangent(active[negative], projected=True)
                bowl, more, _, stiffness[negative] = self._direction(
                    active[negative], state["residual"][:, open_[negative]], torch.zeros_like(negative[negative]))
                direction[:, negative] = bowl
                steps[negative] += more
            self.newton[host] += 1
            self.cg[host] += steps.cpu().numpy()
            moved = self._step(active, open_, self._correct(active, direction, stiffness), state, tolerance)
            still = (~moved).nonzero()[:, 0]
            if len(still):
                moved[still] = self._step(active[still], open_[still], direction[:, still], state, tolerance)
            renew[open_] = (state["measure"][open_] > 0.5 * before) | negative
            # no step helps, not even a projected one: rounding's floor, or nothing to be found
            stuck[open_] = ~moved & safe[open_]
            idle[open_] = torch.where(state["measure"][open_] < 0.9 * least[open_], 0, idle[open_] + 1)
            least[open_] = torch.minimum(least[open_], state["measure"][open_])
            lost = open_[idle[open_] >= self.touching.patience]
            stuck[lost], held[lost] = True, False
            self.reason[active[stuck[open_]].cpu().numpy()] = Reason.STALLED
            safe[open_] = ~moved
        balanced = (state["measure"] <= tolerance) & ~held
        self.reason[columns[balanced].cpu().numpy()] = Reason.NONE
        self.reason[columns[balanced & (state["astray"] > 0)].cpu().numpy()] = Reason.ASTRAY
        self.reason[columns[balanced & (state["det"] <= 0.0)].cpu().numpy()] = Reason.INVERTED

    def _tangent(self, columns: torch.Tensor, *, projected: bool) -> None:
        with clock.measure("tangents"):
            self.elasticity.tangent(wp.from_torch(columns.to(torch.int32)), wp.from_torch(self.u), projected=projected)

    def _direction(self, columns: torch.Tensor, residual: torch.Tensor,
                   near: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        opt = self.options
        return newton_direction(self.elasticity, self.touching, columns, residual.to(self.real), near=near,
                                iterations=opt.cg,
                                tolerance=torch.where(near, 1.0, opt.cg_far) * opt.cg_tolerance, plain=opt.cg_plain)

    def _correct(self, columns: torch.Tensor, direction: torch.Tensor, stiffness: torch.Tensor) -> torch.Tensor:
        """Give Newton's step the right contact: it was found for the points that touch now, not for those that will.

        The difference between the true contact forces at the end of the step and the linearised ones is worked off by
        the condensed problem. Where the contact stays as it is this changes nothing.
        """
        touching = self.touching
        at = touching.dof[columns].clamp(min=0).T
        real = touching.real[columns]
        change = direction.gather(0, at).T.to(torch.float64) * real
        base = self.u[:, columns].gather(0, at).T.to(torch.float64) * real + change
        pushed = touching.nodal(columns) - (stiffness @ change[:, :, None])[:, :, 0]
        with clock.measure("contact"):
            force, error = touching.condensed(columns, base, pushed, iterations=12, tolerance=1e-3)
        useful = (error < 0.1) & (force != 0.0).any(dim=1)
        if bool(useful.any()):
            more = touching.response.patch(columns[useful], force[useful])
            direction = direction.clone()
            direction[:, useful] += more.to(direction.dtype)
        return direction

    def _step(self, columns: torch.Tensor, at: torch.Tensor, direction: torch.Tensor, state: State,
              tolerance: float) -> torch.Tensor:
        """Halve the step until the potential falls by Armijo's rule (or the residual shrinks, where rounding hides the
        fall).

        ``at``: entries of ``columns`` in ``state``, which is updated. Returns who moved (k,) bool.
        """
        base = self.u[:, columns]
        potential, measure, astray = state["potential"][at], state["measure"][at], state["astray"][at]
        slope = (state["residual"][:, at] * direction).sum(dim=0)
        step = torch.ones_like(slope)
        moved = torch.zeros(len(columns), dtype=torch.bool, device=self.device)
        pending = torch.arange(len(columns), device=self.device)
        for _ in range(12):
            trial = base[:, pending] + step[pending].to(self.real) * direction[:, pending]
            self.u[:, columns[pending]] = trial
            new = self.evaluate(columns[pending])
            falls = new["potential"] <= potential[pending] - 1e-4 * step[pending] * slope[pending]
            shrinks = (new["measure"] < self.touching.shrinks
                       * measure[pending]) & (measure[pending] < self.touching.near_balance)
            if self.touching.rubs:
                shrinks |= new["measure"] <= tolerance  # forces that depend on the way have no potential that must fall
            good = (falls | shrinks) & (new["astray"] <= astray[pending])
            done = pending[good]
            for key in state:
                state[key][..., at[done]] = new[key][..., good]
            moved[done] = True
            pending = pending[~good]
            if not len(pending):
                return moved
            step[pending] *= 0.5
        self.u[:, columns[pending]] = base[:, pending]
        self.evaluate(columns[pending])
        return moved


def _size(v: torch.Tensor) -> torch.Tensor:
    return v.view(-1, 3, v.shape[1]).norm(dim=1).sum(dim=0)
