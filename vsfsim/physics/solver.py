"""Quasi-static touches: every frame is an equilibrium of the body against the probe, found by Newton's method.

    Pi(u) = sum of element energies - load . u + contact energy    ->    minimum

Projected Newton with a line search on Pi. Each linear system goes to `pcg`, preconditioned by the rest-state factor with
the contact block inverted exactly. All touches of one object advance together, one column each. A frame that does not
converge is approached again in halved steps, then marked; it is never passed off as data.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import fields

import numpy as np
import warp as wp

from vsfsim.core.shape import ProbeShape
from vsfsim.physics.direction import newton_direction
from vsfsim.physics.elasticity import Elasticity
from vsfsim.physics.frames import Frames, SolverOptions
from vsfsim.physics.model import Model
from vsfsim.physics.touching import Touching

State = dict[str, np.ndarray]

FLOAT32_AIM, FLOAT32_ACCEPT = 1e-3, 3e-3  # tolerance aimed at, and the one that counts as converged, in single precision
_HARD = 100.0  # unbalanced over acting force at the start of a frame; 1 is contact that nothing has answered yet
_SOFTENINGS = (0.003, 0.05)  # of the contact stiffness, one stage after the other
_SOFT_TOLERANCE = 0.05  # of these stages; they only lead the way


class Solver:
    """Touches of one body by one probe.

    Args:
        model: the body. probe: its shape.
        device: Warp device, "cpu" or "cuda:0". precision: "float32" or "float64" of elements and vectors (the factor
        and the contact block are always double). options: limits.
        linear: answer with the rest state's linear elasticity (the `linear` tier) instead of Newton's method.
    """

    def __init__(self, model: Model, probe: ProbeShape, *, device: str = "cpu", precision: str = "float64",
                 options: SolverOptions | None = None, linear: bool = False):
        self.model, self.probe = model, probe
        options = options or SolverOptions()
        if precision == "float32":
            # rounding of the nodal forces leaves about 1e-3 unbalanced; asking for less would only burn iterations
            options = dataclasses.replace(options, tolerance=max(options.tolerance, FLOAT32_AIM), newton=min(options.newton, 15))
        self.options = options
        self._accept = options.tolerance if precision == "float64" else max(options.tolerance, FLOAT32_ACCEPT)
        self.device, self.precision, self.linear = device, precision, linear
        self.real = wp.float64 if precision == "float64" else wp.float32
        self.elasticity = Elasticity(model, device=device, real=self.real)
        self._grounding = model.grounding()
        weight = np.abs(model.load).sum()
        # forces under this are zero: a billionth of the softest modulus on one element face
        self._floor = max(1e-9 * float(model.young_modulus.min()) * model.element_size**2, 1e-6 * weight)

    def run(self, poses: np.ndarray, *, keep: bool = False, progress: Callable[[int], None] | None = None) -> Frames:
        """Follow the probe through all frames.

        Args:
            poses: probe to world (T, B, 4, 4), one column a touch; the first clear of the body, or nearly so.
            keep: also keep the displacements of every frame in ``self.history`` (T entries of (3 n, B)) [m].
            progress: called with the number of finished frames.
        """
        frames, batch = poses.shape[:2]
        self.touching = Touching(self.model, self.probe, poses, device=self.device, real=self.real)
        self.elasticity.begin(batch)
        self._set(np.zeros((3 * len(self.model.mesh.points), batch)))
        self._settled: np.ndarray | None = None
        columns = np.arange(batch)
        self._pushed = [np.zeros(len(self.touching.dof(b))) for b in range(batch)]
        self._pushed_before = self._pushed
        if self.linear:
            self._sag = np.repeat(self.model.factor.solve((self.model.load * self.model.free)[:, None]), batch, axis=1)
        rows: list[State] = []
        self.history: list[np.ndarray] = []
        known: list[tuple[np.ndarray, np.ndarray]] = []
        previous = poses[0].copy()
        for t in range(frames):
            began = time.perf_counter()
            deadline = began + self.options.seconds
            if self.linear:
                out = self._linear_frame(columns, poses[t])
            else:
                self._start(columns, poses[t], known)
                out = self._advance(columns, previous, poses[t], deadline, self.options.halvings)
                self._pushed_before, self._pushed = self._pushed, self._forces(columns)
            previous = poses[t]
            known.append((poses[t], self._u()))
            if keep:
                self.history.append(known[-1][1])
            out["seconds"] = np.full(batch, time.perf_counter() - began)
            rows.append(out)
            if progress is not None:
                progress(t + 1)
        data = {f.name: np.stack([row[f.name] for row in rows]) for f in fields(Frames)}
        data["seconds"] = data["seconds"][:, 0]
        return Frames(**data)

    # ------------------------------------------------------------------------------------------ state

    def _u(self) -> np.ndarray:
        return self.u.numpy().astype(np.float64).copy()

    def _set(self, u: np.ndarray, columns: np.ndarray | None = None) -> None:
        if columns is not None:
            whole = self._u()
            whole[:, columns] = u
            u = whole
        self.u = wp.array(u, dtype=self.real, device=self.device)

    def _index(self, columns: np.ndarray) -> wp.array:
        return wp.array(columns, dtype=wp.int32, device=self.device)

    def _least_det(self, columns: np.ndarray) -> np.ndarray:
        return self.elasticity.least_det.numpy()[columns].astype(np.float64)

    def _forces(self, columns: np.ndarray) -> list[np.ndarray]:
        return [self.touching.nodal(b) for b in columns]

    def _evaluate(self, columns: np.ndarray, pose: np.ndarray) -> State:
        """Forces, potential and residual of ``columns`` at the present displacements."""
        self.elasticity.forces(self._index(columns), self.u)
        self.touching.evaluate(columns, pose, self.u)
        internal = self.elasticity.internal.numpy()[:, columns].astype(np.float64)
        pushed = np.zeros_like(internal)
        for k, b in enumerate(columns):
            pushed[self.touching.dof(b), k] = self.touching.nodal(b)
        load = self.model.load[:, None]
        energy, det = self.elasticity.energy.numpy()[columns], self._least_det(columns)
        potential = energy + self.touching.energy[columns] - (load * self._u()[:, columns]).sum(axis=0)
        residual = (load + pushed - internal) * self.model.free[:, None]
        state = {"internal": internal, "contact": pushed, "potential": potential, "residual": residual,
                 "energy": energy, "det": det}
        state["measure"] = self._measure(state)
        return state

    def _measure(self, state: State) -> np.ndarray:
        """Unbalanced force over acting force, per column: sums of the lengths of nodal vectors."""
        def size(v: np.ndarray) -> np.ndarray:
            return np.linalg.norm(v.reshape(-1, 3, v.shape[1]), axis=1).sum(axis=0)

        acting = np.maximum(size(state["contact"]), size(self.model.load[:, None]))
        return size(state["residual"]) / np.maximum(acting, self._floor)

    # ------------------------------------------------------------------------------------------ frames

    def _start(self, columns: np.ndarray, pose: np.ndarray, known: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Begin at the equilibrium of this very pose if it is known (frictionless: the way back is the way in), else predict."""
        for seen, u in reversed(known):
            if np.array_equal(seen, pose):
                self._set(u)
                return
        self._evaluate(columns, pose)
        touching = np.array([b for b in columns if self.touching.touches(b) or self._pushed[b].any()], dtype=int)
        if not len(touching):
            return
        now = self._u()
        guesses = [(now, self._pushed)]
        if len(known) > 1 and all(len(a) == len(b) for a, b in zip(self._pushed, self._pushed_before)):
            (p1, u1), (p0, u0) = known[-1], known[-2]
            step, last = pose[:, :3, 3] - p1[:, :3, 3], p1[:, :3, 3] - p0[:, :3, 3]
            size = np.linalg.norm(last, axis=1)
            ratio = np.where((step * last).sum(axis=1) > 0.0, np.linalg.norm(step, axis=1) / np.where(size > 0.0, size, 1.0), 0.0)
            ratio = np.minimum(ratio, 2.0)
            guesses.append((u1 + ratio * (u1 - u0), [a + r * (a - b) for a, b, r in zip(self._pushed, self._pushed_before, ratio)]))
        best = np.full(len(touching), np.inf)
        chosen = now.copy()
        for base, pushed in guesses:
            change, _ = self.touching.condensed(touching, pose, base, pushed, iterations=20, tolerance=1e-4)
            trial = base[:, touching] + self._answer(touching, change)
            self._set(trial, touching)
            potential = self._evaluate(touching, pose)["potential"]
            better = potential < best
            best = np.where(better, potential, best)
            chosen[:, touching[better]] = trial[:, better]
        self._set(now)
        stay = self._evaluate(touching, pose)["potential"] <= best
        chosen[:, touching[stay]] = now[:, touching[stay]]
        self._set(chosen)

    def _answer(self, columns: np.ndarray, change: list[np.ndarray]) -> np.ndarray:
        """Displacements (3 n, k) [m] of the body at rest under forces on the patches of ``columns``."""
        right = np.zeros((len(self.model.free), len(columns)))
        for k, b in enumerate(columns):
            right[self.touching.dof(b), k] = change[k]
        return self.model.factor.solve(right * self.model.free[:, None])

    def _advance(self, columns: np.ndarray, before: np.ndarray, pose: np.ndarray, deadline: float,
                 halvings: int) -> State:
        """Equilibria of ``columns`` at ``pose`` (B, 4, 4); those that fail are approached again in half steps."""
        begin = self._good if halvings < self.options.halvings else self._before()
        out = self._equilibrium(columns, pose, deadline)
        failed = columns[~out["converged"][columns]]
        if len(failed) and halvings > 0 and time.perf_counter() < deadline:
            self._set(begin[:, failed], failed)
            middle = pose.copy()
            middle[failed, :3, 3] = 0.5 * (before[failed, :3, 3] + pose[failed, :3, 3])
            self._good = begin
            first = self._advance(failed, before, middle, deadline, halvings - 1)
            self._good = self._u()
            second = self._advance(failed, middle, pose, deadline, halvings - 1)
            for key, values in out.items():
                values[failed] = second[key][failed]
                if key in ("iterations", "cg_iterations"):
                    values[failed] += first[key][failed]
        if halvings == self.options.halvings:
            self._settled = self._u()
        return out

    def _before(self) -> np.ndarray:
        """Displacements at the end of the frame before this one."""
        if self._settled is None:
            return np.zeros(self.u.shape)
        return self._settled

    def _equilibrium(self, columns: np.ndarray, pose: np.ndarray, deadline: float) -> State:
        opt, batch = self.options, self.u.shape[1]
        newton, cg = np.zeros(batch, int), np.zeros(batch, int)
        state = self._evaluate(columns, pose)
        # a probe that went deep into a soft wall in one frame: come to it through softer contact
        hard = columns[(np.abs(state["measure"] - 1.0) < 0.03) | (state["measure"] > _HARD)]
        if len(hard):
            self._set(self._before()[:, hard], hard)
            for softening in _SOFTENINGS:
                self.touching.softening[hard] = softening
                self._newton(hard, pose, deadline, self._evaluate(hard, pose), _SOFT_TOLERANCE, newton, cg)
            self.touching.softening[hard] = 1.0
            state = self._evaluate(columns, pose)
        for _ in range(4):  # a patch may have to grow
            self._newton(columns, pose, deadline, state, opt.tolerance, newton, cg)
            if not self.touching.grow(columns, pose, self._u()):
                break
            self._pushed = [np.zeros(len(self.touching.dof(b))) for b in range(batch)]
            state = self._evaluate(columns, pose)
        self.touching.evaluate(np.arange(batch), pose, self.u)
        return self._report(columns, state, newton, cg)

    def _newton(self, columns: np.ndarray, pose: np.ndarray, deadline: float, state: State, tolerance: float,
                newton: np.ndarray, cg: np.ndarray) -> None:
        """Newton's method on ``columns`` until each one's measure is under ``tolerance``; updates state and the counts (B,)."""
        stuck = np.zeros(len(columns), bool)
        renew = np.ones(len(columns), bool)  # whose tangent must be made anew
        safe = np.zeros(len(columns), bool)  # whose last step failed: they get the projected tangent
        for _ in range(self.options.newton):
            open_ = np.flatnonzero((state["measure"] > tolerance) & ~stuck)
            if not len(open_) or time.perf_counter() > deadline:
                break
            active = columns[open_]
            before = state["measure"][open_].copy()
            # far off, the projected tangent is the safe one; near by, the true one converges quadratically,
            # and that of the step before is as good
            far = (before > 0.3) | safe[open_]
            fresh = renew[open_] | (before > 0.05)
            for projected, which in ((True, fresh & far), (False, fresh & ~far)):
                if which.any():
                    self.elasticity.tangent(self._index(active[which]), self.u, projected=projected)
            direction, steps, negative = self._newton_direction(active, state["residual"][:, open_], near=~far)
            if negative.any():
                # not a bowl along some direction: take the projected tangent, which always is
                self.elasticity.tangent(self._index(active[negative]), self.u, projected=True)
                bowl, more, _ = self._newton_direction(active[negative], state["residual"][:, open_[negative]],
                                                near=np.zeros(int(negative.sum()), bool))
                direction[:, negative] = bowl
                steps += more
            newton[active] += 1
            cg[active] += steps
            moved = self._step(active, open_, pose, self._correct(active, pose, direction), state)
            still = np.flatnonzero(~moved)
            if len(still):
                self.touching.evaluate(active[still], pose, self.u)
                moved[still] = self._step(active[still], open_[still], pose, direction[:, still], state)
            renew[open_] = (state["measure"][open_] > 0.5 * before) | negative
            # no step helps, not even a projected one: rounding's floor, or nothing to be found
            stuck[open_] = ~moved & safe[open_]
            safe[open_] = ~moved
            self.touching.evaluate(columns, pose, self.u)

    def _newton_direction(self, columns: np.ndarray, residual: np.ndarray, *, near: np.ndarray) -> tuple[np.ndarray, int, np.ndarray]:
        opt = self.options
        direction, steps, negative, self._contact_stiffness = newton_direction(
            self.elasticity, self.touching, self.model.factor, columns, residual, near=near,
            tolerance=np.where(near, 1.0, opt.cg_far) * opt.cg_tolerance, iterations=opt.cg)
        return direction, steps, negative

    def _correct(self, columns: np.ndarray, pose: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Give Newton's step the right contact: it was found for the points that touch now, not for those that will.

        The difference between the true contact forces at the end of the step and the linearised ones is worked off by the condensed
        problem. Where the contact stays as it is this changes nothing.
        """
        whole = self._u()
        pushed = list(self._forces(range(whole.shape[1])))
        for k, b in enumerate(columns):
            dof = self.touching.dof(b)
            n = len(dof)
            pushed[b] = pushed[b] - self._contact_stiffness[b, :n, :n] @ direction[dof, k]
        whole[:, columns] += direction
        change, error = self.touching.condensed(columns, pose, whole, pushed, iterations=12, tolerance=1e-3)
        useful = np.flatnonzero((error < 0.1) & np.array([bool(c.any()) for c in change]))
        if len(useful):
            direction = direction.copy()
            direction[:, useful] += self._answer(columns[useful], [change[k] for k in useful])
        return direction

    def _step(self, columns: np.ndarray, at: np.ndarray, pose: np.ndarray, direction: np.ndarray, state: State) -> np.ndarray:
        """Line search of ``columns``, whose entries in ``state`` are ``at``; updates state, returns who moved (k,)."""
        taken, moved = self._line_search(columns, pose, direction, {k: v[..., at] for k, v in state.items()})
        for key, value in taken.items():
            state[key][..., at] = value
        return moved

    def _line_search(self, columns: np.ndarray, pose: np.ndarray, d: np.ndarray,
                     state: State) -> tuple[State, np.ndarray]:
        """Halve the step until the potential falls by Armijo's rule (or the residual shrinks, where rounding hides the fall).

        Returns the state after it, and which columns moved at all.
        """
        base = self._u()[:, columns]
        slope = (state["residual"] * d).sum(axis=0)
        step = np.ones(len(columns))
        result = {k: v.copy() for k, v in state.items()}
        chosen = base.copy()
        pending = np.arange(len(columns))
        for _ in range(12):
            trial = base[:, pending] + step[pending] * d[:, pending]
            self._set(trial, columns[pending])
            new = self._evaluate(columns[pending], pose)
            falls = new["potential"] <= state["potential"][pending] - 1e-4 * step[pending] * slope[pending]
            shrinks = (new["measure"] < 0.5 * state["measure"][pending]) & (state["measure"][pending] < 0.05)
            good = falls | shrinks
            for key in result:
                result[key][..., pending[good]] = new[key][..., good]
            chosen[:, pending[good]] = trial[:, good]
            pending = pending[~good]
            if not len(pending):
                break
            step[pending] *= 0.5
        self._set(chosen, columns)
        return result, ~np.isin(np.arange(len(columns)), pending)

    # ------------------------------------------------------------------------------------------ the linear tier

    def _linear_frame(self, columns: np.ndarray, pose: np.ndarray) -> State:
        """One frame of linear elasticity: the condensed contact problem, solved to its tolerance."""
        none = [np.zeros(len(self.touching.dof(b))) for b in columns]
        for _ in range(4):
            pushed, error = self.touching.condensed(columns, pose, self._sag, none, iterations=100,
                                                    tolerance=self.options.tolerance, start=self._pushed)
            self._pushed = pushed
            self._set(self._sag + self._answer(columns, pushed))
            if not self.touching.grow(columns, pose, self._u()):
                break
            none = [np.zeros(len(self.touching.dof(b))) for b in columns]
        u = self._u()
        self.touching.evaluate(columns, pose, self.u)
        self.elasticity.forces(self._index(columns), self.u)
        internal = self.model.factor.stiffness @ u
        contact = np.zeros_like(u)
        for k, b in enumerate(columns):
            contact[self.touching.dof(b), k] = pushed[k]
        load = self.model.load[:, None]
        state = {"internal": internal, "contact": contact, "residual": (load + contact - internal) * self.model.free[:, None],
                 "energy": 0.5 * (u * internal).sum(axis=0), "det": self._least_det(columns)}
        state["measure"] = np.maximum(self._measure(state), error)
        batch = np.zeros(len(columns), int)
        return self._report(columns, state, batch + 1, batch)

    # ------------------------------------------------------------------------------------------ audit

    def _report(self, columns: np.ndarray, state: State, newton: np.ndarray, cg: np.ndarray) -> State:
        batch = self.u.shape[1]
        shape3 = (-1, 3, len(columns))
        on_body = state["contact"].reshape(shape3).sum(axis=0).T
        held = ((state["internal"] - self.model.load[:, None] - state["contact"]) * (1.0 - self.model.free[:, None])).reshape(shape3).sum(axis=0).T
        # anchors tie the body to the ground: what they pull is a reaction of the supports
        held = held - (self._grounding[:, None] * self._u()[:, columns]).reshape(shape3).sum(axis=0).T
        weight = self.model.load.reshape(-1, 3).sum(axis=0)
        unbalanced = np.linalg.norm(held + on_body + weight, axis=1)
        largest = np.maximum(np.maximum(np.linalg.norm(held, axis=1), np.linalg.norm(on_body, axis=1)), self._floor)
        values = {
            "force": -on_body, "reaction": held, "converged": state["measure"] <= self._accept,
            "residual": state["measure"], "iterations": newton[columns], "cg_iterations": cg[columns],
            "force_balance": unbalanced / largest, "min_det_f": state["det"], "energy": state["energy"],
            "penetration": np.array([self.touching.penetration(b) for b in columns]),
        }
        out = {}
        for key, value in values.items():
            full = np.zeros((batch, *value.shape[1:]), value.dtype)
            full[columns] = value
            out[key] = full
        return out
