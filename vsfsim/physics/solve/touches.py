"""Quasi-static touches: every frame is an equilibrium of the object against rigid bodies on prescribed paths.

All touches of one object advance together, one column each, on the device. A frame begins from a prediction (the last
two frames drawn on, their contact put right by the condensed problem), is brought into balance by `Equilibrium`, and
what does not converge is approached again:
through softer contact, then in halved steps. A frame that fails all of it is marked with the reason, never passed off
as data.
With friction the way matters: every step remembers where each point of the surface stuck.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.core.shape import ProbeShape
from vsfsim.physics import clock
from vsfsim.physics.contact import condensed
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.rigid import Touching
from vsfsim.physics.linear.rest_factor import spread
from vsfsim.physics.model import Model
from vsfsim.physics.solve import path
from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.frames import Frames, Reason, SolverOptions
from vsfsim.physics.solve.newton import Equilibrium, State

Rows = dict[str, np.ndarray]
Memory = Any  # what `Touching.memory` gives and `Touching.restore` takes

# tolerance aimed at, and the one that counts as converged, in single precision
FLOAT32_AIM, FLOAT32_ACCEPT = 1e-3, 3e-3
HARD = 100.0  # unbalanced over acting force at the start of a frame; 1 is contact that nothing has answered yet
_SOFTENINGS = (0.003, 0.05)  # of the contact stiffness, one stage after the other
_WEIGHT_NEWTON, _WEIGHT_LEAST = 12, 1 / 256  # iterations that a part of the load may take; the smallest part
# of friction's limit in a linear frame: how often, and the change that ends it (the `fem` tier's tolerance)
_RENEWALS, _RENEWED = 60, 5e-4
_KEPT_BYTES = {"cpu": 1e9, "cuda": 16e9}  # of equilibria that the way back may begin from
_SOFT_TOLERANCE = 0.05  # of these stages; they only lead the way


class Solver:
    """Touches of one object by rigid bodies.

    Args:
        model: the object. shapes: the rigid bodies (K).
        friction: Coulomb's coefficient with the object, one for all or one for each body [-].
        device: Warp device, "cpu" or "cuda:0". precision: "float32" or "float64" of elements and vectors (the
        rest-state inverse and the contact are always double). options: limits.
        linear: answer with the rest state's linear elasticity (the `linear` tier) instead of Newton's method.
    """

    def __init__(self, model: Model, shapes: ProbeShape | Sequence[ProbeShape], *,
                 friction: float | Sequence[float] = 0.0, device: str = "cpu",
                 precision: str = "float64", options: SolverOptions | None = None, linear: bool = False):
        bodies = RigidBodies(shapes)
        self._setup(model, bodies, np.broadcast_to(np.asarray(friction, float), (len(bodies),)).copy(), device,
                    precision, options, linear)

    def _setup(self, model: Model, bodies: RigidBodies, friction: np.ndarray, device: str, precision: str,
               options: SolverOptions | None,
               linear: bool) -> None:
        self.model, self.bodies, self.friction = model, bodies, friction
        options = options or SolverOptions()
        if precision == "float32":
            # rounding of the nodal forces leaves about 1e-3 unbalanced; asking for less would only burn iterations
            options = dataclasses.replace(options, tolerance=max(options.tolerance, FLOAT32_AIM),
                                          newton=min(options.newton, 15))
        self.options = options
        self._accept = options.tolerance if precision == "float64" else max(options.tolerance, FLOAT32_ACCEPT)
        self._linear_accept = max(self._accept, _RENEWED) if self.friction.any() else self._accept
        self.device, self.precision, self.linear = device, precision, linear
        self.elasticity = Elasticity(model, device=device, real=wp.float64 if precision == "float64" else wp.float32)
        self._grounding = torch.as_tensor(model.grounding(), device=device)[:, None]
        self._floor = model.least_force()

    def run(self, poses: np.ndarray, *, keep: bool = False, progress: Callable[[int], None] | None = None) -> Frames:
        """Follow the bodies through all frames.

        Args:
            poses: bodies to world, (T, B, K, 4, 4) or for one body (T, B, 4, 4), one column a touch. The first may be
            deep in the object:
                the bodies then come in from outside.
            keep: also keep, for every frame, the displacements in ``self.history`` (T entries of (3 n, B)) [m] and the
            contact force on every
                surface node in ``self.surface_force`` (T entries of (s, 3, B)) [N], s as `QuadraticMesh.surface_nodes`.
            progress: called with the number of finished frames.
        """
        if poses.ndim == 4:
            poses = poses[:, :, None]
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # so that the bits do not depend on the machine's load
        try:
            with torch.no_grad():
                return self._run(poses, keep, progress)
        finally:
            torch.set_num_threads(threads)

    def _run(self, poses: np.ndarray, keep: bool, progress: Callable[[int], None] | None) -> Frames:
        frames, batch = poses.shape[:2]
        self.elasticity.begin(batch)
        self.touching, previous = self._meet(poses)
        self._balance = Equilibrium(self.model, self.elasticity, self.touching, self.options, floor=self._floor)
        every = self._balance.every
        self._pushed = self.touching.nothing()
        if self.linear:
            sag = self.model.factor.solve((self.model.load * self.model.free)[:, None])
            self._sag = torch.as_tensor(np.repeat(sag, batch, axis=1), device=self.device)
        else:
            self._take_up_weight(previous)
        rows: list[Rows] = []
        self.history: list[np.ndarray] = []
        self.surface_force: list[np.ndarray] = []
        self._known: list[tuple[np.ndarray, torch.Tensor, torch.Tensor]] = []
        for t in range(frames):
            began = time.perf_counter()
            deadline = began + self.options.seconds
            if self.linear:
                out = self._linear_frame(previous, poses[t])
            else:
                self._balance.count()
                way = list(path.pieces(previous, poses[t], self._stride, self.bodies))
                for pose in way:
                    begin, memory = self._balance.u.clone(), self.touching.memory()
                    self._start(every, previous, pose)
                    self._advance(every, previous, pose, begin, deadline, self.options.halvings, memory)
                    self._remember(pose, self.touching.remember(every))
                    if pose is not way[-1]:
                        self.touching.settle(every)
                    previous = pose
                # only then do the anchors move on: as they were, the forces balance
                out = self._report(self._balance.evaluate(every))
                self.touching.settle(every)
            previous = poses[t]
            if keep:
                self._keep()
            out["seconds"] = np.full(batch, time.perf_counter() - began)
            rows.append(out)
            if progress is not None:
                progress(t + 1)
        data = {f.name: np.stack([row[f.name] for row in rows]) for f in fields(Frames)}
        data["seconds"] = data["seconds"][:, 0]
        return Frames(**data)

    def _meet(self, poses: np.ndarray) -> tuple[Touching, np.ndarray]:
        """The contact of this run and the poses (B, K, 4, 4) that it comes in from."""
        touching = Touching(self.model, self.bodies, self.friction, poses, device=self.device, exact=self.linear)
        self._stride = path.stride(self.bodies, path.mean_thickness(self.model))
        return touching, path.outside(self.bodies, self.model, poses[0], touching.first_gap)

    def _remember(self, pose: np.ndarray, pushed: torch.Tensor) -> None:
        """Equilibria that later frames may begin from: all of them without friction, the last two with it."""
        self._pushed = pushed
        self._known.append((pose, self._balance.u.clone(), self._pushed))
        most = _KEPT_BYTES["cpu" if self.device == "cpu" else "cuda"]
        if self.touching.rubs or self._known[0][1].nbytes * len(self._known) > most:
            del self._known[:-2]

    def _keep(self) -> None:
        u = self._balance.u
        self.history.append(u.to(torch.float64, copy=True).cpu().numpy())
        force = np.zeros((len(self.model.mesh.points), 3, u.shape[1]))
        for b, (patch, pushed) in enumerate(zip(self.touching.patches, self._pushed.cpu().numpy(), strict=True)):
            force[patch.nodes, :, b] = pushed.reshape(-1, 3)[:len(patch.nodes)]
        self.surface_force.append(force[self.model.mesh.surface_nodes()])

    # ------------------------------------------------------------------------------------------ one frame

    def _take_up_weight(self, pose: np.ndarray) -> None:
        """The equilibrium under the load alone, which all touches begin from: in parts, as large as they converge in
        few iterations."""
        balance, touching = self._balance, self.touching
        if not self.model.load.any():
            return
        deadline = time.perf_counter() + self.options.seconds
        first, whole = balance.every[:1], balance.load
        touching.begin(pose, balance.u)
        touching.move(pose, balance.every)
        touching.softening[:] = 0.0  # nothing touches yet
        balance.options = dataclasses.replace(self.options, newton=_WEIGHT_NEWTON)
        linear = self.model.factor.solve((self.model.load * self.model.free)[:, None])
        slope = torch.as_tensor(linear, dtype=balance.real, device=self.device)
        done, part, u = 0.0, 1.0, torch.zeros_like(slope)
        while done < 1.0 and part >= _WEIGHT_LEAST and time.perf_counter() < deadline:
            share = min(part, 1.0 - done)
            balance.load = (done + share) * whole
            balance.u[:, :1] = u + share * slope
            balance.count()
            balance.solve(first, balance.evaluate(first), self.options.tolerance, deadline)
            if balance.reason[0] == Reason.NONE:
                slope, u = (balance.u[:, :1] - u) / share, balance.u[:, :1].clone()
                done, part = done + share, 2.0 * part
            else:
                part = 0.5 * share
        balance.load, balance.options = whole, self.options
        balance.u[:] = u
        touching.softening[:] = 1.0

    def _start(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray) -> None:
        """Begin at the equilibrium of this very pose if it is known (frictionless: the way back is the way in), else
        predict."""
        balance, touching = self._balance, self.touching
        touching.begin(before, balance.u)
        touching.move(pose, columns)
        if not touching.rubs:
            for seen, u, _ in reversed(self._known):
                if np.array_equal(seen, pose):
                    balance.u.copy_(u)
                    return
        balance.evaluate(columns)
        last = touching.recall(self._pushed)
        meets = columns[touching.touches(columns) | (last[columns] != 0.0).any(dim=1)]
        if not len(meets):
            return
        now = balance.u.clone()
        guesses = self._guesses(now, last, pose)
        best = torch.full((len(meets),), float("inf"), dtype=torch.float64, device=self.device)
        astray = torch.full_like(best, torch.iinfo(torch.int64).max, dtype=torch.int64)
        chosen = now.clone()
        for base, pushed in guesses:
            with clock.measure("prediction"):
                change, _ = touching.condensed(meets, touching.gather(base)[meets], pushed[meets],
                                               iterations=20, tolerance=1e-4)
            balance.u[:, meets] = base[:, meets] + touching.response.patch(meets, change).to(balance.real)
            state = balance.evaluate(meets)
            better = (state["astray"] < astray) | ((state["astray"] == astray) & (state["potential"] < best))
            best, astray = torch.where(better, state["potential"], best), torch.where(better, state["astray"], astray)
            chosen[:, meets[better]] = balance.u[:, meets[better]]
        balance.u.copy_(now)
        state = balance.evaluate(meets)
        stay = (state["astray"] < astray) | ((state["astray"] == astray) & (state["potential"] <= best))
        chosen[:, meets[stay]] = now[:, meets[stay]]
        balance.u.copy_(chosen)

    def _guesses(self, now: torch.Tensor, last: torch.Tensor,
                 pose: np.ndarray) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """What a step may begin from: the last equilibrium, and the last two drawn on. Displacements (3 n, B) [m] and
        forces on the patches (B, 3 s) [N]."""
        out = [(now, last)]
        if len(self._known) > 1 and self._known[-2][2].shape == self._pushed.shape:
            (p1, u1, f1), (p0, u0, f0) = ((p, u, self.touching.recall(f)) for p, u,
                                          f in (self._known[-1], self._known[-2]))
            ratio = torch.as_tensor(path.ratio(p0, p1, pose), device=self.device)
            out.append((u1 + (ratio * (u1 - u0)).to(u1.dtype), f1 + ratio[:, None] * (f1 - f0)))
        return out

    def _advance(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray, begin: torch.Tensor,
                 deadline: float,
                 halvings: int, memory: Memory) -> None:
        """Bring ``columns`` from their equilibria ``begin`` (3 n, B) at ``before``, with friction's ``memory`` from
        there, into balance at ``pose`` (B, K, 4, 4).

        The present displacements are the first guess. Touches that fail are approached again in half steps.
        """
        balance, touching = self._balance, self.touching
        touching.begin(before, begin)
        touching.move(pose, columns)
        self._equilibrium(columns, pose, begin, deadline)
        asked = columns.cpu().numpy()
        again = (balance.reason[asked] != Reason.NONE) & ~balance.spent(asked)
        failed = columns[torch.as_tensor(again, device=self.device)]
        if not len(failed) or halvings == 0 or time.perf_counter() > deadline:
            return
        host = failed.cpu().numpy()
        middle = pose.copy()
        middle[host] = path.between(before[host], pose[host], 0.5)
        balance.u[:, failed] = begin[:, failed]
        touching.restore(failed, memory)
        self._advance(failed, before, middle, begin, deadline, halvings - 1, memory)
        lost = host[balance.reason[host] != Reason.NONE]
        reasons = balance.reason[lost].copy()
        touching.settle(failed)
        self._advance(failed, middle, pose, balance.u.clone(), deadline, halvings - 1, touching.memory())
        if touching.rubs and len(lost):
            # friction remembers the step that failed: what follows is no equilibrium of the true history
            balance.reason[lost] = reasons

    def _equilibrium(self, columns: torch.Tensor, pose: np.ndarray, begin: torch.Tensor, deadline: float) -> None:
        balance, touching = self._balance, self.touching
        state = balance.evaluate(columns)
        # a body that went deep into a soft wall in one frame: come to it through softer contact
        hard = columns[self._hard(state["measure"])]
        if len(hard):
            balance.u[:, hard] = begin[:, hard]
            for softening in _SOFTENINGS:
                touching.softening[hard] = softening
                balance.solve(hard, balance.evaluate(hard), _SOFT_TOLERANCE, deadline)
            touching.softening[hard] = 1.0
            state = balance.evaluate(columns)
        for _ in range(4):
            balance.solve(columns, state, self.options.tolerance, deadline)
            lost = columns[~torch.isfinite(state["measure"])]
            if len(lost):
                balance.u[:, lost] = begin[:, lost]
                balance.evaluate(lost)
            grown = touching.grow(columns, pose, balance.u)
            if grown:
                self._pushed = touching.nothing()
                state = balance.evaluate(columns)
            if len(lost):
                balance.reason[lost.cpu().numpy()] = Reason.NOT_FINITE
            if not grown:
                return
        balance.reason[columns.cpu().numpy()] = Reason.PATCH

    def _hard(self, measure: torch.Tensor) -> torch.Tensor:
        """Who is so far from balance at the start of a step, by its ``measure`` (k,), that softer contact should lead
        the way (k,) bool."""
        return ((measure - 1.0).abs() < 0.03) | (measure > HARD)

    # ------------------------------------------------------------------------------------------ the linear tier

    def _linear_frame(self, before: np.ndarray, pose: np.ndarray) -> Rows:
        """One frame of linear elasticity: the condensed contact problem, solved to its tolerance."""
        balance, touching = self._balance, self.touching
        every = balance.every
        touching.begin(before, balance.u)
        touching.move(pose, every)
        start = self._guess(pose)
        for _ in range(4):
            with clock.measure("contact"):
                pushed, error = self._condensed(start)
            # body by body while the contact is where it gave those forces: the stiff contact at the displacements that
            # they cause tells forces far worse than displacements
            by_body = {"body_force": touching.on_bodies(every), "body_moment": touching.moment_on_bodies(every)}
            balance.u.copy_(self._sag + touching.response.patch(every, pushed))
            if not touching.grow(every, pose, balance.u):
                break
            start = torch.zeros_like(touching.rest)
        state = balance.evaluate(every)
        u = balance.u.to(torch.float64)
        internal = self._times_stiffness(u)
        contact = spread(touching.dof, pushed, len(u))
        state.update(internal=internal, contact=contact, residual=(balance.load + contact - internal) * balance.free,
                     energy=0.5 * (u * internal).sum(dim=0), **by_body)
        state["measure"] = torch.maximum(balance.measure(state["residual"], contact), error)
        touching.settle(every)
        self._remember(pose, pushed)
        balance.count()
        balance.newton += 1
        balance.reason[(state["measure"] > self._linear_accept).cpu().numpy()] = Reason.ITERATIONS
        return self._report(state)

    def _condensed(self, start: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Contact forces (B, 3 s) [N] of linear elasticity and their relative errors (B,); friction's limit is renewed
        until it is the present one."""
        touching, every = self.touching, self._balance.every
        sag = touching.gather(self._sag)
        for _ in range(_RENEWALS if touching.rubs else 1):
            pushed, error = condensed.solve(touching, every, sag, torch.zeros_like(sag), iterations=100,
                                            tolerance=self.options.tolerance, start=start)
            if touching.rubs:
                moved = sag + (touching.compliance @ pushed[:, :, None])[:, :, 0]
                touching.evaluate(every, moved)
                touching.lag(every)
                touching.evaluate(every, moved)
                off = ((touching.nodal(every) - pushed).norm(dim=1)
                       + touching.unlawful(every)) / pushed.norm(dim=1).clamp(min=self._floor)
                error, start = torch.maximum(error, off), pushed
                if bool((error <= _RENEWED).all()):
                    break
        return pushed, error

    def _guess(self, pose: np.ndarray) -> torch.Tensor:
        """Contact forces (B, 3 s) [N] to begin with: those of this very pose if it is known, else the last two drawn
        on."""
        known = [(seen, pushed) for seen, _, pushed in self._known if pushed.shape == self._pushed.shape]
        if not self.touching.rubs:
            for seen, pushed in reversed(known):
                if np.array_equal(seen, pose):
                    return pushed
        if len(known) < 2:
            return self._pushed
        (p0, f0), (p1, f1) = known[-2:]
        return f1 + torch.as_tensor(path.ratio(p0, p1, pose), device=self.device)[:, None] * (f1 - f0)

    def _times_stiffness(self, u: torch.Tensor) -> torch.Tensor:
        """Rest stiffness times u (3 n, B)."""
        if self.device == "cpu":
            return torch.as_tensor(self.model.factor.stiffness @ u.numpy())
        return self.model.factor.stiffness_on(self.device) @ u

    # ------------------------------------------------------------------------------------------ audit

    def _report(self, state: State) -> Rows:
        """The rows of one frame from the state of all touches."""
        balance, touching = self._balance, self.touching
        every = balance.every
        batch = len(every)
        contact, internal = state["contact"], state["internal"]
        on_object = contact.view(-1, 3, batch).sum(dim=0).T
        held = (internal - balance.load - contact) * (1.0 - balance.free)
        # anchors tie the object to the ground: what they pull is a reaction of the supports
        held = (held - self._grounding * balance.u.to(torch.float64)).view(-1, 3, batch).sum(dim=0).T
        weight = balance.load.view(-1, 3).sum(dim=0)
        unbalanced = (held + on_object + weight).norm(dim=1)
        largest = torch.maximum(held.norm(dim=1), on_object.norm(dim=1)).clamp(min=self._floor)
        values = {
            "force": -on_object, "reaction": held, "residual": state["measure"],
            "body_force": state["body_force"] if "body_force" in state else touching.on_bodies(every),
            "body_moment": state["body_moment"] if "body_moment" in state else touching.moment_on_bodies(every),
            "force_balance": unbalanced / largest, "min_det_f": state["det"], "energy": state["energy"],
            "penetration": touching.penetration(every), "slipping": touching.slipping(every),
        }
        out = {key: value.cpu().numpy() for key, value in values.items()}
        reason = balance.reason.copy()
        if self.linear:
            # small strain has no det F of its own; the displacements are what a viewer would draw
            reason[(state["astray"] > 0).cpu().numpy() & (reason == Reason.NONE)] = Reason.ASTRAY
        # with friction the limit that was renewed last counts; without, this is the state that Newton's method left
        accept = self._linear_accept if self.linear else self._accept
        reason[(reason == Reason.NONE) & ~(out["residual"] <= accept)] = Reason.STALLED
        if not touching.rubs:
            # a step that stalled at rounding's floor may still be good enough; nothing of its way is remembered
            reason[(out["residual"] <= accept) & ~np.isin(reason,
                                                          (Reason.PATCH, Reason.ASTRAY, Reason.INVERTED))] = Reason.NONE
        out["reason"], out["converged"] = reason, reason == Reason.NONE
        out["iterations"], out["cg_iterations"] = balance.newton.copy(), balance.cg.copy()
        return out
