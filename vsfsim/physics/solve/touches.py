"""Quasi-static touches: every frame is an equilibrium of the object against rigid bodies on prescribed paths.

All touches of one object advance together, one column each, on the device. A step begins from the last two equilibria,
extrapolated, and is brought into equilibrium by `Equilibrium`. What it finds is checked by geometry (no body lies
inside the object) and by energy (the bodies' work has not become motion, `WorkCheck`). A touch that fails is approached
again in halved steps. A frame in which all of this fails is marked and never counts as data. With friction every step
remembers where points stuck.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch

from vsfsim.core.shape import ProbeShape
from vsfsim.physics import clock
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.intrusion import LOST
from vsfsim.physics.contact.law import PENALTY, ContactLaw
from vsfsim.physics.contact.mount import Mount
from vsfsim.physics.contact.points import Contact
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import torch_threads
from vsfsim.physics.solve import audit, increments
from vsfsim.physics.solve.audit import Rows
from vsfsim.physics.solve.elasticity import Elasticity, LinearElasticity
from vsfsim.physics.solve.frames import Frames, Reason, SolverOptions
from vsfsim.physics.solve.newton import Equilibrium, State
from vsfsim.physics.solve.work_check import WorkCheck

_EQUILIBRIA_BYTES = {"cpu": 1e9, "cuda": 16e9}  # of equilibria that a later frame may begin from
_LEAST_LOAD = 1 / 256  # the smallest part of the weight that is added
_AWAY = 1e3  # how far the bodies are meanwhile [m], on the side of a plane that is solid
_GROWTHS = 10  # solves of a step while the patch grows, cuts of its faces included


class Known(NamedTuple):
    """An equilibrium that later frames may begin from."""

    pose: np.ndarray
    """Poses (B, K, 4, 4)."""
    u: torch.Tensor
    """Displacements (3 n, B) [m]."""


class Solver:
    """Touches of one object by rigid bodies.

    Args:
        model: the object.
        shapes: the rigid bodies (K).
        friction: Coulomb's coefficient with the object, one for all or one for each body [-].
        device: Warp device, "cpu" or "cuda:0".
        options: limits.
        linear: use the linear elasticity of the rest state (the `linear` tier) instead of the elements.
        law: of the contact, and its terms, see `vsfsim.physics.contact.law`.
    """

    def __init__(self, model: Model, shapes: ProbeShape | Sequence[ProbeShape], *,
                 friction: float | Sequence[float] = 0.0, device: str = "cpu",
                 options: SolverOptions | None = None, linear: bool = False,
                 law: tuple[ContactLaw, np.ndarray] = (PENALTY, np.zeros(1))):
        bodies = RigidBodies(shapes)
        self.bodies, self._law = bodies, law
        self._setup(model, bodies.reaches, np.broadcast_to(np.asarray(friction, float), (len(bodies),)).copy(), device,
                    options, linear)

    def _setup(self, model: Model, reaches: np.ndarray, friction: np.ndarray, device: str,
               options: SolverOptions | None, linear: bool) -> None:
        self.model, self._reaches, self.friction = model, reaches, friction
        self.device, self.linear, self.options = device, linear, options or SolverOptions()
        self._mount: Mount | None = None
        self.elasticity = (LinearElasticity if linear else Elasticity)(model, device=device)
        self._floor = model.least_force()
        self._near: list[Known] = []  # equilibria that frames may begin from

    @torch_threads(1)  # one, so that the bits do not depend on the machine's load
    @torch.no_grad()
    def run(self, poses: np.ndarray, *, start: np.ndarray | None = None, mount: Mount | None = None,
            keep: bool = False, progress: Callable[[int], None] | None = None) -> Frames:
        """Follow the bodies through all frames.

        Args:
            poses: bodies to world, (T, B, K, 4, 4) or for one body (T, B, 4, 4), one column a touch.
            start: where the path begins, likewise (B, ...); None for the first pose. A touch that
                begins inside the object is marked in every frame.
            mount: springs that carry the bodies; ``poses`` are then those of the mounts.
            keep: also keep, for every frame, the displacements in ``self.history`` (T entries of (3 n, B)) [m] and the
                contact force on every surface node in ``self.surface_force`` (T entries of (s, 3, B)) [N], s as
                `QuadraticMesh.surface_nodes`; NaN on the patch in frames that did not converge.
            progress: called with the number of finished frames.

        Returns:
            The frames; those that failed are marked.
        """
        poses = poses[:, :, None] if poses.ndim == 4 else poses
        (frames, batch), self._mount, clocks = poses.shape[:2], mount, [time.perf_counter()]
        self.elasticity.begin(batch)
        self.contact, previous = self._make_contact(poses, start)
        self._balance = Equilibrium(self.model, self.elasticity, self.contact, self.options, floor=self._floor)
        hang(self._balance, previous)
        self.contact.begin_step(previous, self._balance.u, self._balance.every)
        self.contact.move(previous, self._balance.every)
        self._work_check = WorkCheck(self._balance)
        rows: list[Rows] = []
        self.history: list[np.ndarray] = []
        self.surface_force: list[np.ndarray] = []
        self._equilibria = list(self._near)
        self._at = previous  # where the bodies are, each touch in equilibrium
        for t in range(frames):
            out = self._frame(poses[t], clock.now() + self.options.seconds * batch)
            if keep:
                self._record(out["converged"])
            rows.append(out)
            clocks.append(time.perf_counter())
            if progress is not None:
                progress(t + 1)
        return Frames(**{name: np.stack([row[name] for row in rows]) for name in rows[0]}, seconds=np.diff(clocks))

    def _frame(self, pose: np.ndarray, deadline: float) -> Rows:
        """Bring all touches into equilibrium with the bodies at ``pose`` (B, K, 4, 4), and look at what was found."""
        balance, contact, late = self._balance, self.contact, False
        way = list(increments.pieces(self._at, pose, self._stride, self._reaches))
        self._unknown = self._inside | increments.too_far(self._at, pose, self._stride, self._reaches)
        balance.reset_counts()
        for part in way:
            balance.begun = balance.newton.copy(), balance.cg.copy()
            begin, friction = balance.u.clone(), contact.friction_state()
            self._reach(balance.every, self._at, part, begin, deadline, self.options.halvings, friction)
            if part is way[-1]:
                break
            self._end_step(balance.every)
            self._at = self._resume(self._at, part, begin, friction)
            late = clock.now() > deadline
            if late:  # the next frame goes on from here
                contact.move(pose, balance.every)
                balance.reason[:] = Reason.TIME
                break
        # the anchors move after the report: the forces balance with the old ones
        state = balance.evaluate(balance.every)
        out = self._report(state)
        if not late:
            contact.end_step(balance.every)
            balance.reason[:] = out["reason"]
            self._at = self._resume(self._at, pose, begin, friction)
        return out

    def _make_contact(self, poses: np.ndarray, start: np.ndarray | None = None) -> tuple[Contact, np.ndarray]:
        """The contact of this run and the poses (B, K, 4, 4) that it comes in from."""
        bodies, model, thickness = self.bodies, self.model, increments.mean_thickness(self.model)
        start = poses[0] if start is None else start.reshape(poses.shape[1:])
        first = increments.clear(start, poses[0], bodies, model)
        if not np.array_equal(first, poses[0]):  # on their way in
            way = increments.pieces(first, poses[0], increments.stride(bodies, thickness), bodies.reaches)
            poses = np.stack([*way, *poses])
        contact = RigidContact(model, bodies, self.friction, poses, device=self.device, mount=self._mount,
                               linear=self.linear, law=self._law, local=self.options.local_indentation,
                               by_place=self.options.indentation_by_place)
        thinnest = increments.thinnest(model, [patch.faces for patch in contact.patches])
        self._stride = increments.stride(bodies, min(thickness, thinnest), friction=contact.has_friction)
        self._inside = increments.inside(bodies, model, start, self.device)
        return contact, first

    def _resume(self, before: np.ndarray, pose: np.ndarray, begin: torch.Tensor, friction: Any) -> np.ndarray:
        """The poses (B, K, 4, 4) from which the next step begins, each with its equilibrium: ``pose`` where one was
        found. The other touches return to ``before``, with the displacements ``begin`` (3 n, B) [m] and the state of
        ``friction`` there: what follows a step that failed must not rest on it."""
        balance, contact = self._balance, self.contact
        lost = np.flatnonzero(balance.reason != Reason.NONE)
        if len(lost):
            at = torch.as_tensor(lost, device=self.device)
            pose = pose.copy()
            pose[lost] = before[lost]
            balance.u[:, at] = begin[:, at]
            contact.restore_friction(at, friction)
            contact.move(pose, at)
            balance.evaluate(balance.every)
        self._work_check.begin(balance.every)
        # for later frames to begin from: all of them without friction, the last two with it
        self._equilibria.append(Known(pose, balance.u.clone()))
        most = _EQUILIBRIA_BYTES["cpu" if self.device == "cpu" else "cuda"]
        if contact.has_friction or balance.u.nbytes * len(self._equilibria) > most:
            del self._equilibria[:-2]
        return pose

    def _record(self, converged: np.ndarray) -> None:
        """Keep the displacements and forces of this frame for the caller; forces are NaN where it did not converge."""
        self.history.append(self._balance.u.clone().cpu().numpy())
        force = self._balance.contact_force().cpu().numpy().reshape(-1, 3, len(converged))
        for b in np.flatnonzero(~converged):
            force[self.contact.patches[b].nodes, :, b] = np.nan
        self.surface_force.append(force[self.model.mesh.surface_nodes()])

    # ------------------------------------------------------------------------------------------ one frame

    def _start(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray, begin: torch.Tensor) -> None:
        """Begin ``columns`` at the equilibrium of this very ``pose`` (B, K, 4, 4) if it is known (without friction
        unloading retraces loading), else at the last two equilibria, ``begin`` (3 n, B) at ``before`` and an older one,
        extrapolated, where that has less potential and lets no body through."""
        balance, contact, known = self._balance, self.contact, self._equilibria
        contact.begin_step(before, begin, columns)
        contact.move(pose, columns)
        balance.u[:, columns] = begin[:, columns]
        there = [k.u for k in known if np.array_equal(k.pose, pose)]
        if there and not contact.has_friction:
            balance.u[:, columns] = there[-1][:, columns]
            return
        state = {key: value.clone() for key, value in balance.evaluate(columns).items() if value.dim() == 1}
        older = [k for k in known[-2:] if not np.array_equal(k.pose, before)]
        if not older:
            return
        ratio = torch.as_tensor(increments.ratio(older[-1].pose, before, pose), device=self.device)
        balance.u[:, columns] += (ratio * (begin - older[-1].u))[:, columns]
        new = balance.evaluate(columns)
        worse = columns[(new["wrong_side"] > state["wrong_side"]) | ~(new["potential"] < state["potential"])]
        balance.u[:, worse] = begin[:, worse]

    def _reach(self, columns: torch.Tensor, before: np.ndarray, pose: np.ndarray, begin: torch.Tensor,
               deadline: float, halvings: int, friction: Any) -> None:
        """Bring ``columns`` from their equilibria ``begin`` (3 n, B) at ``before``, with the state of ``friction``
        there, into equilibrium at ``pose`` (B, K, 4, 4). Touches that fail are approached again in half steps."""
        balance, contact = self._balance, self.contact
        self._start(columns, before, pose, begin)
        self._equilibrium(columns, pose, begin, deadline)
        asked = columns.cpu().numpy()
        snapped = self._work_check.snapped(columns, before, pose).cpu().numpy()
        balance.reason[asked[snapped & (balance.reason[asked] == Reason.NONE)]] = Reason.SNAPPED
        again = (balance.reason[asked] != Reason.NONE) & ~balance.exhausted(asked)
        failed = columns[torch.as_tensor(again, device=self.device)]
        if not len(failed) or halvings == 0 or clock.now() > deadline:
            return
        host, middle = failed.cpu().numpy(), pose.copy()
        middle[host] = increments.between(before[host], pose[host], 0.5)
        contact.restore_friction(failed, friction)
        self._reach(failed, before, middle, begin, deadline, halvings - 1, friction)
        if clock.now() > deadline:
            contact.move(pose, failed)
            balance.reason[host] = Reason.TIME
            return
        # friction remembers a step that failed, a body that snapped does not come back: what follows is not the path
        reason = balance.reason[host]
        ends = (reason != Reason.NONE) & contact.has_friction | (reason == Reason.SNAPPED)
        if ends.all():
            contact.move(pose, failed)
            return
        failed = failed[torch.as_tensor(~ends, device=self.device)]
        self._end_step(failed)
        self._work_check.begin(failed)
        self._reach(failed, middle, pose, balance.u.clone(), deadline, halvings - 1, contact.friction_state())

    def _end_step(self, columns: torch.Tensor) -> None:
        """End the step of ``columns`` (k,). They are evaluated first: contact points may have been laid out anew for
        another touch since they were solved."""
        self.contact.evaluate(columns, self.contact.gather(self._balance.u[:, columns], columns))
        self.contact.end_step(columns)

    def _equilibrium(self, columns: torch.Tensor, pose: np.ndarray, begin: torch.Tensor, deadline: float) -> None:
        balance, contact = self._balance, self.contact
        state = balance.evaluate(columns)
        for _ in range(_GROWTHS):
            balance.solve(columns, state, balance.options.tolerance, deadline)
            lost = columns[~torch.isfinite(state["measure"])]
            if len(lost):
                balance.u[:, lost] = begin[:, lost]
                balance.evaluate(lost)
            if clock.now() > deadline:  # no time to look where the bodies are
                balance.reason[columns.cpu().numpy()] = Reason.TIME
                return
            grown = contact.extend_patch(columns, pose, balance.u)
            at = columns[~grown & contact.intruded(columns)].cpu().numpy()
            balance.reason[lost.cpu().numpy()] = Reason.NOT_FINITE
            balance.reason[at[balance.reason[at] == Reason.NONE]] = Reason.INTRUSION
            columns = columns[grown]
            if not len(columns):
                return
            # the new points feel a body that lies a little inside; not one that the object has closed around
            closed = columns[contact.intruded(columns, LOST if contact.solid else 1.0)]
            balance.u[:, closed] = begin[:, closed]
            state = balance.evaluate(columns)
        balance.reason[columns.cpu().numpy()] = Reason.PATCH

    # ------------------------------------------------------------------------------------------ audit

    def _report(self, state: State) -> Rows:
        """The values of one frame from the state of all touches."""
        self._balance.reason[self._unknown & (self._balance.reason == Reason.NONE)] = Reason.PATH
        return audit.report(self._balance, state)


def hang(balance: Equilibrium, pose: np.ndarray) -> None:
    """Find the equilibrium of an object under its weight alone, from which all touches begin, in parts of the load that
    are as large as they converge.

    Args:
        balance: the batch; all its displacements are set.
        pose: poses of the bodies (B, K, 4, 4), free of the object.
    """
    model, contact, options = balance.model, balance.contact, balance.options
    if not model.load.any():
        return
    deadline = clock.now() + options.seconds * len(balance.every)
    first, whole = balance.every[:1], balance.load.clone()
    away = pose.copy()
    away[..., :3, 3] -= _AWAY * pose[..., :3, 2]
    contact.begin_step(away, balance.u, balance.every)
    contact.move(away, balance.every)
    linear = model.preconditioner.solve((model.load * model.free)[:, None])
    slope = torch.as_tensor(linear, dtype=torch.float64, device=balance.device)
    done, part, u = 0.0, 1.0, torch.zeros_like(slope)
    while done < 1.0 and part >= _LEAST_LOAD and clock.now() < deadline:
        share = min(part, 1.0 - done)
        balance.load.copy_((done + share) * whole)
        balance.u[:, :1] = u + share * slope
        balance.reset_counts()
        state = balance.evaluate(first)
        balance.solve(first, state, options.tolerance, deadline)
        # out of time the first frame goes on, unless the body at rest (1) is nearer to the balance
        late = balance.reason[0] == Reason.TIME and done + share == 1.0 and float(state["measure"][0]) < 1.0
        if balance.reason[0] == Reason.NONE or late:
            slope, u = (balance.u[:, :1] - u) / share, balance.u[:, :1].clone()
            done, part = done + share, 2.0 * part
        else:
            part = 0.5 * share
    balance.load.copy_(whole)
    balance.u[:] = u
    balance.factors.forget()
