"""Newton's method for one pose of the rigid bodies: the equilibrium of every touch of the batch.

    Pi(u) = sum of element energies - load . u + energy of the contact    ->    minimum

Each linear system is solved by `krylov`, preconditioned by the rest-state
inverse with the contact block inverted exactly, or by a factor of a deformed state (`tangent_factor`).
Far from the solution, after a step that failed, and where the true tangent meets negative curvature, the tangent is
projected to positive semi-definite; else the true one serves.

The *measure* of a touch is the sum of the lengths of its unbalanced nodal forces over that of the acting ones [-].
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
import warp as wp

from vsfsim.physics import clock
from vsfsim.physics.contact.points import Contact
from vsfsim.physics.laws.neo_hooke import CRUSHED
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.model import Model
from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.frames import Reason, SolverOptions
from vsfsim.physics.solve.krylov import Room, conjugate_gradients, gmres
from vsfsim.physics.solve.tangent_factor import TangentFactors

# part of the way to the first inner body of a rigid body that a step may take, and the least part of a step
_SHORT_OF, _LEAST = 0.8, 1e-3
# conjugate gradients of a linear system, and the factor on their tolerance far from the solution, where Newton's linear
# model is no more accurate
_CG, _FAR = 150, 10.0
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
    """

    u: torch.Tensor
    """Displacements (3 n, B) [m]."""
    newton: np.ndarray
    """Newton iterations of every touch since `reset_counts` (B,)."""
    cg: np.ndarray
    """Conjugate-gradient iterations of every touch since `reset_counts` (B,)."""
    reason: np.ndarray
    """Why a touch is not in equilibrium, `Reason` (B,)."""

    def __init__(self, model: Model, elasticity: Elasticity, contact: Contact, options: SolverOptions, *,
                 floor: float):
        self.model, self.elasticity, self.contact = model, elasticity, contact
        self.options, self.floor = options, floor
        self.device = contact.device
        batch = contact.batch
        self.u = torch.zeros((3 * len(model.mesh.points), batch), dtype=torch.float64, device=self.device)
        self.load = torch.as_tensor(model.load, device=self.device)[:, None]
        self._loaded = _size(self.load).clamp(min=floor)
        self.free = torch.as_tensor(model.free, device=self.device)[:, None]
        self.every = torch.arange(batch, device=self.device)
        # least measure of every touch since its friction was renewed (B,) [-]
        self._least = torch.zeros(batch, dtype=torch.float64, device=self.device)
        self.factors = TangentFactors(model, elasticity, contact)
        self._rooms: dict[str, Room] = {}
        self._rooms_of: torch.Tensor | None = None
        self.reset_counts()

    def reset_counts(self) -> None:
        """Count iterations from zero."""
        self.newton, self.cg, self.reason = (np.zeros(len(self.every), int) for _ in range(3))
        self.begun = self.newton.copy(), self.cg.copy()  # where a step of the frame's way begins

    def exhausted(self, host: np.ndarray) -> np.ndarray:
        """Which of the touches ``host`` (k,) have used all iterations of a frame's step (k,) bool."""
        newton, cg = self.newton - self.begun[0], self.cg - self.begun[1]
        return (cg[host] >= self.options.cg_frame) | (newton[host] >= self.options.newton_frame)

    # ------------------------------------------------------------------------------------------ state

    def evaluate(self, columns: torch.Tensor) -> State:
        """Forces, potential and residual of ``columns`` (k,) at the present displacements. On a GPU those of all
        touches are in one place, until the next evaluation."""
        room = self._room("step", columns)
        return dict(room.run("evaluate", lambda: room.keep(self._find(columns))))

    def _find(self, columns: torch.Tensor) -> State:
        self.elasticity.forces(wp.from_torch(columns.to(torch.int32)), wp.from_torch(self.u))
        return self._again(columns)

    def contact_force(self) -> torch.Tensor:
        """Contact forces (3 n, B) [N] that the last evaluation found, of all touches."""
        return spread(self.contact.dof, self.contact.nodal(self.every), len(self.u))

    def renew_friction(self, columns: torch.Tensor) -> State:
        """The state after renewing friction limits and tangent planes; the measure counts Coulomb's residual, too."""
        self.contact.update_friction(columns)
        out = self._again(columns)
        out["measure"] = out["measure"] + self.contact.friction_residual(columns) / self._acting(out["contact"])
        return out

    def _again(self, columns: torch.Tensor) -> State:
        """As `evaluate`, where the elements are evaluated already."""
        moved = self.u[:, columns]
        self.contact.evaluate(columns, self.contact.gather(moved, columns))
        internal = wp.to_torch(self.elasticity.internal)[:, columns]
        contact = spread(self.contact.dof[columns], self.contact.nodal(columns), len(internal))
        energy = wp.to_torch(self.elasticity.energy)[columns]
        bodies = self.contact.energy(columns) + self.contact.carried(columns)
        potential = energy + bodies - (self.load * moved).sum(dim=0)
        residual = (self.load + contact - internal) * self.free
        return {"internal": internal, "contact": contact, "potential": potential, "residual": residual,
                "energy": energy, "wrong_side": self.contact.wrong_side(columns),
                "det": wp.to_torch(self.elasticity.least_det)[columns],
                "measure": _size(residual) / self._acting(contact)}

    def _acting(self, contact: torch.Tensor) -> torch.Tensor:
        return torch.maximum(_size(contact), self._loaded)

    # ------------------------------------------------------------------------------------------ Newton

    def solve(self, columns: torch.Tensor, state: State, tolerance: float, deadline: float) -> None:
        """Newton's method on ``columns`` until the measure of each is under ``tolerance``; updates state, counts and
        reasons. The host decides by one look at all touches after a step. On a GPU all of them take part in every step,
        so that it can be repeated as graphs; those that are done do not move."""
        has_friction, host = self.contact.has_friction, columns.cpu().numpy()
        room = self._room("step", columns)
        state.update(room.keep(state))
        stuck, safe = np.zeros((2, len(host)), bool)  # safe: whose last step failed, they get the projected tangent
        # whose friction limit is not yet Coulomb's, and the measure at which it is renewed
        held, within = np.full(len(host), has_friction), np.full(len(host), self.contact.friction_updated_below)
        renew = ~stuck  # whose tangent must be recomputed
        self.contact.coulomb[columns] = 0.0
        self._least[columns] = float("inf")
        self.reason[host] = Reason.ITERATIONS
        self._deadline = deadline

        def look() -> np.ndarray:
            return state["measure"].cpu().numpy().copy()

        measure = look()
        for _ in range(self.options.newton * (1 + has_friction)):
            if self.contact.follow():
                state.update(room.run("follow", lambda: room.keep(self._again(columns))))
                measure = look()
            ready = np.flatnonzero(held & ((measure <= np.maximum(within, tolerance)) | stuck))
            if len(ready):
                at = self._on(ready)
                if self.contact.follows:
                    self.contact.coulomb[columns[at]] = 1.0
                self._least[columns[at]] = float("inf")
                for key, value in self.renew_friction(columns[at]).items():
                    state[key][..., at] = value
                measure = look()
                present = measure[ready]
                # in equilibrium under the renewed limit: done. If not, the measure must fall to a tenth before the
                # limit is renewed again
                held[ready] = present > tolerance
                within[ready] = np.minimum(0.1 * present, within[ready])
                stuck[ready] &= ~(present > tolerance) | (present > 0.5)
                renew[ready] = True
            open_ = np.flatnonzero((held | (measure > tolerance)) & ~stuck)
            if not len(open_):
                break
            if clock.now() > deadline:
                self.reason[host[open_]] = Reason.TIME
                break
            exhausted = open_[self.exhausted(host[open_])]
            if len(exhausted):
                stuck[exhausted], held[exhausted] = True, False
                continue
            before = measure[open_]
            # far from the solution the projected tangent is safe; near it the true one converges quadratically, and
            # that of the step before is as good. Under planes contact has no geometric term, which spoils the true one.
            far = (before > 0.3) | safe[open_]
            convex = safe[open_] if self.contact.solid and not has_friction and self.contact.flat else far
            fresh = renew[open_] | (before > 0.05) | self.factors.renew(host[open_], self.u, deadline)
            for projected, which in ((True, fresh & convex), (False, fresh & ~convex)):
                if which.any():
                    self._tangent(columns[self._on(open_[which])], projected=projected)
            # a touch that is not open has no residual here, and moves by nothing
            part = np.arange(len(host)) if room.stays and self.contact.symmetric else open_
            moves, near = np.isin(part, open_), np.zeros(len(host), bool)
            near[open_] = ~far
            at, going = self._on(part), self._on(moves)
            residual = state["residual"][:, at]
            if not moves.all():
                residual = torch.where(going, residual, 0.0)
            direction, steps, curved = self._descend(columns[at], residual, self._on(near[part]))
            self.newton[host[open_]] += 1
            self.cg[host[open_]] += steps[moves]
            moved = self._step(columns[at], at, direction, state, tolerance, going)[moves]
            measure = look()
            renew[open_] = (measure[open_] > 0.5 * before) | curved[moves]
            stuck[open_] = ~moved & safe[open_]  # not even a projected step helps: there is no equilibrium
            self.reason[host[open_[stuck[open_]]]] = Reason.STALLED
            safe[open_] = ~moved
        self.contact.coulomb[columns] = 0.0
        balanced = (measure <= tolerance) & ~held
        wrong_side, det = (state[key].cpu().numpy() for key in ("wrong_side", "det"))
        for reason, which in ((Reason.NONE, balanced), (Reason.WRONG_SIDE, balanced & (wrong_side > 0)),
                              (Reason.CRUSHED, balanced & (det < CRUSHED)), (Reason.INVERTED, balanced & (det <= 0.0))):
            self.reason[host[which]] = reason

    def _on(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, device=self.device)

    def _room(self, name: str, columns: torch.Tensor) -> Room:
        """Where all touches take part on a GPU, with its contact as it is, a room that stays; for some of them one that
        does not."""
        if len(columns) < len(self.every) or not (self.contact.symmetric and self.contact.response.resident):
            return Room()
        if self._rooms_of is not self.contact.dof:
            self._rooms, self._rooms_of = {}, self.contact.dof
        return self._rooms.setdefault(name, Room(stays=True))

    def _tangent(self, columns: torch.Tensor, *, projected: bool) -> None:
        self.elasticity.tangent(wp.from_torch(columns.to(torch.int32)), wp.from_torch(self.u), projected=projected)

    def _descend(self, columns: torch.Tensor, residual: torch.Tensor,
                 near: torch.Tensor) -> tuple[torch.Tensor, np.ndarray, np.ndarray]:
        """Directions of descent (3 n, k) [m], the iterations that they took (k,), and which met negative curvature (k,)
        bool: these are found with the projected tangent, without the geometric term of the contact."""
        opt = self.options
        solve = functools.partial(newton_direction, self.elasticity, self.contact, iterations=_CG,
                                  deadline=self._deadline, factors=self.factors)
        # far from the solution, where Newton's linear model is no more accurate, a looser solution serves
        loose = torch.full_like(residual[0], opt.cg_tolerance * _FAR)
        direction, *found = solve(columns, residual, near=near, room=self._room,
                                  tolerance=torch.where(near, opt.cg_tolerance, loose))
        steps, curved = torch.stack([found[0], found[1].long()]).cpu().numpy()
        bent = np.flatnonzero(curved)
        if len(bent) and clock.now() <= self._deadline:
            at = self._on(bent)
            self._tangent(columns[at], projected=True)
            direction[:, at], more, _ = solve(columns[at], residual[:, at], tolerance=loose[at],
                                              near=torch.zeros_like(near[at]))
            steps[bent] += more.cpu().numpy()
        return direction, steps, curved > 0

    def _step(self, columns: torch.Tensor, at: torch.Tensor, direction: torch.Tensor, state: State,
              tolerance: float, going: torch.Tensor) -> np.ndarray:
        """Go along ``direction`` (3 n, k) [m], short of the inner bodies of the rigid bodies, and halve the step until
        the potential falls, or the residual where rounding hides that, below all before: else a point between stick
        and slip lets both fall in turn for ever.

        ``at``: entries of ``columns`` in ``state``, which is updated; ``going``: which go at all (k,) bool. Returns
        which of these moved (k,) bool.
        """
        room = self._room("step", columns)
        moved, direction = room.take("moved", ~going), room.take("direction", direction)

        def aim() -> State:
            slope = (state["residual"][:, at] * direction).sum(dim=0)
            reach = self.contact.reach(columns, self.contact.gather(direction, columns))
            step = torch.where(reach < 1.0, (_SHORT_OF * reach).clamp(min=_LEAST), 1.0)
            before = {f"{key} before": state[key][at] for key in ("potential", "measure", "wrong_side")}
            least = self._least[columns] = torch.minimum(self._least[columns], state["measure"][at])
            return room.keep({"base": self.u[:, columns], "slope": slope, "step": step, "least": least, **before})

        base, slope, step, least, potential, measure, wrong_side = room.run("aim", aim).values()

        def go(which: torch.Tensor) -> None:
            some = columns[which]
            self.u[:, some] = base[:, which] + step[which] * direction[:, which]
            new = self._find(some)
            way = step[which] * slope[which]
            falls = (new["potential"] <= potential[which] - 1e-4 * way) & (way > 0.0)  # nowhere is no step
            decreases = ((new["measure"] < self.contact.decrease * least[which])
                         & (measure[which] < self.contact.potential_trusted_above))
            if self.contact.has_friction:
                decreases |= new["measure"] <= tolerance  # friction depends on the path: no potential that must fall
            follows = self.contact.coulomb[some] > 0.0  # there is no potential
            decreases |= follows & (new["measure"] < (1.0 - 0.05 * step[which]) * measure[which])
            good = ((falls & ~follows) | decreases) & (new["wrong_side"] <= wrong_side[which])
            good |= moved[which]  # one that has moved comes to the same place again
            moved[which] = good
            step[which] *= torch.where(good, 1.0, 0.5)
            for key, value in state.items():
                if room.stays:
                    value.copy_(torch.where(good, new[key], value))
                else:
                    value[..., at[which[good]]] = new[key][..., good]

        pending = torch.arange(len(columns), device=self.device)
        for halvings in range(12):
            if halvings and clock.now() > self._deadline:
                break
            room.run("go", functools.partial(go, pending))
            left = self._on(np.flatnonzero(~moved.cpu().numpy()))
            if not len(left):
                break
            pending = pending if room.stays else left
        if len(left):
            self.u[:, columns[left]] = base[:, left]
            self.evaluate(columns[left])
        return (moved & going).cpu().numpy()


def newton_direction(elasticity: Elasticity, contact: Contact, columns: torch.Tensor, residual: torch.Tensor, *,
                     near: torch.Tensor, tolerance: torch.Tensor, iterations: int,
                     factors: TangentFactors, deadline: float = float("inf"),
                     room: Callable[[str, torch.Tensor], Room] = lambda *_: Room(),
                     ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solve (tangent + contact) d = residual by conjugate gradients, or by `gmres` where the contact is not symmetric.

    Args:
        elasticity: elements, with the tangent of ``columns`` computed.
        contact: contact, evaluated at the present state.
        columns: touches (k,).
        residual: unbalanced forces (3 n, k) [N].
        near: whose contact stiffness has its geometric term (k,) bool, see `Contact.stiffness`.
        tolerance: relative residual of each column (k,).
        iterations: limit.
        factors: of deformed states, which precondition the touches that have one; they note the iterations.
        deadline: see `krylov`.
        room: where the iterations of such a name are made for some columns.

    Returns:
        Directions (3 n, k) [m]; iterations of each (k,); and which met negative curvature (k,) bool, none with
        `gmres`.
    """
    response = contact.response
    own_factor = factors.of(columns)
    touched = response.resident or bool(contact.touches(columns).any())
    # a factor of a deformed state has the contact in it; the one at rest is corrected for it
    stiffness, block = contact.stiffness(columns, near, block=touched and None in own_factor)
    here = room(f"direction {stiffness.dof.shape[1]}", columns)
    stiffness = replace(stiffness, dof=here.take("dof", stiffness.dof), matrix=here.take("own", stiffness.matrix))
    if block is not None:
        block = replace(block, dof=stiffness.dof, matrix=here.take("block", block.matrix))

    class Part:
        """What the products need of the columns ``which``."""

        def __init__(self, which: torch.Tensor | None):
            own = columns if which is None else columns[which]
            picked = range(len(own)) if which is None else which.tolist()
            self.columns, self.index = own, wp.from_torch(own.to(torch.int32))
            self.at = contact.dof[own].clamp(min=0).T
            self.factors = [(j, own_factor[k]) for j, k in enumerate(picked) if own_factor[k] is not None]
            self.resting = contact.mask.new_tensor([[1.0 * (own_factor[k] is None)] for k in picked])
            if touched:
                self.stiffness = stiffness if which is None else stiffness[which]
            if block is not None:
                self.block = block if which is None else block[which]

    part = functools.cache(Part)  # for the columns that are left, which only get fewer

    def multiply(x: torch.Tensor, which: torch.Tensor | None) -> torch.Tensor:
        own = part(which)
        out = torch.empty_like(x)
        elasticity.multiply(own.index, wp.from_torch(x), wp.from_torch(out))
        if touched:
            out.scatter_add_(0, own.at, (own.stiffness @ contact.gather(x, own.columns)[:, :, None])[:, :, 0].T)
        return out

    def precondition(r: torch.Tensor, which: torch.Tensor | None) -> torch.Tensor:
        own = part(which)
        y = torch.empty_like(r) if len(own.factors) == r.shape[1] else response.solve(r)
        if block is not None:
            force = (own.block @ contact.gather(y, own.columns)[:, :, None])[:, :, 0]
            y = y - response.patch(own.columns, own.resting * force)
        for j, factor in own.factors:
            y[:, j:j + 1] = torch.as_tensor(factor.solve(r[:, j:j + 1].numpy()))
        return y

    if not contact.symmetric:
        direction, steps = gmres(multiply, precondition, residual, tolerance=tolerance, iterations=iterations,
                                       deadline=deadline)
        return direction, steps, torch.zeros_like(tolerance, dtype=torch.bool)
    direction, steps, curved = conjugate_gradients(
        multiply, precondition, residual, tolerance=tolerance, iterations=iterations, deadline=deadline, room=here)
    if factors.serves:
        factors.count(columns, steps)
    return direction, steps, curved


def _size(v: torch.Tensor) -> torch.Tensor:
    x, y, z = v.view(-1, 3, v.shape[1]).unbind(dim=1)
    return (x * x + y * y + z * z).sqrt().sum(dim=0)  # a twentieth of the time of torch's norm along a short axis
