"""Quasi-static touches: every frame is an equilibrium of the body against the probe, found by Newton's method.

    Pi(u) = sum of element energies - load . u + contact energy    ->    minimum

Projected Newton with a line search on Pi. Each linear system goes to `pcg`, preconditioned by the rest-state factor with
the contact block inverted exactly. All touches of one object advance together, one column each. A frame that does not
converge is approached again in halved steps, then marked; it is never passed off as data.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from vsfsim.core.shape import ProbeShape
from vsfsim.physics import contact, pcg, sdf
from vsfsim.physics.elements import tet10
from vsfsim.physics.model import Model


@dataclass(frozen=True)
class SolverOptions:
    """Limits and tolerances.

    tolerance: largest sum of unbalanced nodal forces over the sum of contact (or weight) forces [-]; bounds the error of
    the force balance. newton: iterations a step. cg: iterations a linear system. cg_tolerance: its relative residual.
    halvings: how often a failed step is halved. seconds: wall-clock limit of one frame [s].
    """

    tolerance: float = 1e-4
    newton: int = 40
    cg: int = 150
    cg_tolerance: float = 1e-2
    halvings: int = 5
    seconds: float = 120.0


@dataclass(frozen=True)
class Frames:
    """What B touches of T frames gave; arrays (T, B) unless said.

    force: on the probe (T, B, 3) [N]. reaction: of the supports on the body (T, B, 3) [N].
    converged: bool. residual: unbalanced over contact force [-]. iterations: Newton. cg_iterations: conjugate gradients.
    force_balance: |force - reaction - weight| over the larger [-]. min_det_f: least det F [-]. energy: elastic [J].
    penetration: deepest point of the surface inside the probe [m]. seconds: of the frame, shared by the batch (T,) [s].
    """

    force: np.ndarray
    reaction: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    cg_iterations: np.ndarray
    force_balance: np.ndarray
    min_det_f: np.ndarray
    energy: np.ndarray
    penetration: np.ndarray
    seconds: np.ndarray


class _Arrays:
    """Device copies of a model, shared by all batches."""

    def __init__(self, model: Model, device: str, precision: str):
        self.real = wp.float64 if precision == "float64" else wp.float32
        self.tet = tet10.kernels(self.real)
        self.contact = contact.kernels(self.real)
        self.pcg = pcg.kernels(self.real)
        self.device = device
        mesh = model.mesh

        def put(values: np.ndarray, dtype: Any) -> wp.array:
            return wp.array(values, dtype=dtype, device=device)

        self.nodes = put(mesh.tets, wp.int32)
        self.gradients = put(mesh.gradients, self.tet.mat43)
        self.volume = put(mesh.volume, self.real)
        self.mu, self.lam = put(model.mu, self.real), put(model.lam, self.real)
        self.rest = put(mesh.points, self.contact.vec3)
        order = np.argsort(mesh.tets.ravel(), kind="stable").astype(np.int32)
        count = np.bincount(mesh.tets.ravel(), minlength=len(mesh.points))
        self.start = put(np.concatenate([[0], np.cumsum(count)]), wp.int32)
        self.slot = put(order, wp.int32)
        self.free = put(model.free, self.real)
        self.every = put(np.ones_like(model.free), self.real)


class Solver:
    """Touches of one body by one probe.

    Args:
        model: the body. probe: its shape.
        device: Warp device, "cpu" or "cuda:0". precision: "float32" or "float64" of elements and vectors (the factor
        and the contact block are always double). options: limits.
    """

    def __init__(self, model: Model, probe: ProbeShape, *, device: str = "cpu", precision: str = "float64",
                 options: SolverOptions | None = None):
        self.model, self.probe = model, probe
        self.options = options or SolverOptions()
        self.device, self.precision = device, precision
        self.a = _Arrays(model, device, precision)
        self._kind, self._size = sdf.encode(probe)
        weight = np.abs(model.load).sum()
        # forces under this are zero: a billionth of the softest modulus on one element face
        self._floor = max(1e-9 * float(model.young_modulus.min()) * model.element_size**2, 1e-6 * weight)

    # ------------------------------------------------------------------------------------------ public

    def run(self, poses: np.ndarray, *, keep: bool = False, progress: Any = None) -> Frames:
        """Follow the probe through all frames.

        Args:
            poses: probe to world (T, B, 4, 4), one column a touch.
            keep: also keep the displacements of every frame in ``self.history`` (T entries of (3 n, B)) [m].
            progress: called with the number of finished frames.
        """
        frames, batch = poses.shape[:2]
        self._begin(poses)
        rows: list[dict[str, np.ndarray]] = []
        self.history: list[np.ndarray] = []
        # the lead-in: from far away to the first pose there is no contact, only gravity
        known: list[tuple[np.ndarray, np.ndarray]] = []
        columns = np.arange(batch)
        previous = poses[0].copy()
        for t in range(frames):
            began = time.perf_counter()
            deadline = began + self.options.seconds
            self._guess(poses[t], known)
            out = self._advance(columns, previous, poses[t], deadline, self.options.halvings)
            previous = poses[t].copy()
            known.append((poses[t], self.u.numpy().copy()))
            if keep:
                self.history.append(known[-1][1])
            out["seconds"] = np.full(batch, time.perf_counter() - began)
            rows.append(out)
            if progress is not None:
                progress(t + 1)
        data = {f.name: np.stack([row[f.name] for row in rows]) for f in fields(Frames)}
        data["seconds"] = data["seconds"][:, 0]
        return Frames(**data)

    # ------------------------------------------------------------------------------------------ set-up

    def _begin(self, poses: np.ndarray) -> None:
        batch = poses.shape[1]
        model, a = self.model, self.a
        tets, size = len(model.mesh.tets), 3 * len(model.mesh.points)
        new = {"device": self.device}
        self.u = wp.zeros((size, batch), dtype=a.real, **new)
        self.element_force = wp.zeros((tets, 10, batch), dtype=a.tet.vec3, **new)
        self.hessian = wp.zeros((tets, 4, batch), dtype=a.tet.mat99, **new)
        self.tet_energy = wp.zeros((tets, batch), dtype=a.real, **new)
        self.tet_det = wp.zeros((tets, batch), dtype=a.real, **new)
        self.internal = wp.zeros((size, batch), dtype=a.real, **new)
        self.energy = wp.zeros(batch, dtype=a.real, **new)
        self.det = wp.zeros(batch, dtype=a.real, **new)
        reachable = [self._reachable(poses[:, b]) for b in range(batch)]
        self.patches = [contact.make_patch(model.mesh, faces, model.surface_modulus) for faces in reachable]
        self._upload_patches()
        self._good = np.zeros((size, batch))
        self._pushed = [np.zeros(3 * len(p.nodes)) for p in self.patches]

    def _reachable(self, path: np.ndarray) -> np.ndarray:
        """Boundary triangles that the probe may meet on its way, by rest position and a margin for what bulges up."""
        mesh = self.model.mesh
        nodes = mesh.surface_nodes()
        nearest = np.full(len(mesh.points), np.inf)
        for pose in path:
            local = (mesh.points[nodes] - pose[:3, 3]) @ pose[:3, :3]
            nearest[nodes] = np.minimum(nearest[nodes], sdf.distance(self.probe, local))
        deepest = max(0.0, -float(nearest.min()))
        margin = 0.25 * deepest + 0.25 * self.model.element_size
        return np.flatnonzero(nearest[mesh.faces].min(axis=1) < margin)

    def _upload_patches(self) -> None:
        batch = len(self.patches)
        faces = max(1, max(len(p.faces) for p in self.patches))
        nodes = max(1, max(len(p.nodes) for p in self.patches))
        table = np.full((batch, faces, 6), -1, np.int32)
        stiffness = np.zeros((batch, faces, 6))
        listed = np.full((batch, nodes), -1, np.int32)
        for b, p in enumerate(self.patches):
            table[b, : len(p.faces)] = self.model.mesh.faces[p.faces]
            stiffness[b, : len(p.faces)] = p.stiffness
            listed[b, : len(p.nodes)] = p.nodes
        a, new = self.a, {"device": self.device}
        self.face_nodes = wp.array(table, dtype=wp.int32, **new)
        self.stiffness = wp.array(stiffness, dtype=a.real, **new)
        self.patch_nodes = wp.array(listed, dtype=wp.int32, **new)
        self.gap = wp.zeros((batch, faces, 6), dtype=a.real, **new)
        self.normal = wp.zeros((batch, faces, 6), dtype=a.contact.vec3, **new)
        self.curvature = wp.zeros((batch, faces, 6), dtype=a.contact.mat33, **new)
        self.contact_energy = wp.zeros((batch, faces), dtype=a.real, **new)
        self.face_force = wp.zeros((batch, faces, 6), dtype=a.contact.vec3, **new)
        self.compliance: list[np.ndarray | None] = [None] * batch

    # ------------------------------------------------------------------------------------------ frames

    def _guess(self, pose: np.ndarray, known: list[tuple[np.ndarray, np.ndarray]]) -> None:
        """Start from the equilibrium at this very pose if it is known (frictionless: the way back is the way in), else predict."""
        for seen, u in reversed(known):
            if np.array_equal(seen, pose):
                self._set(u)
                return
        self._predict(np.arange(self.u.shape[1]), pose)

    def _predict(self, columns: np.ndarray, pose: np.ndarray) -> None:
        """Move to ``pose`` with the elasticity of the rest state condensed on the patch, contact exact.

        Solves u_S = u0_S + A (f(u_S) - f0) for the patch's displacements by a semi-smooth Newton method; the rest of the body
        follows with one back-substitution. Only a start for Newton's method: kept if it lowers the potential.
        """
        before = self._evaluate(columns, pose, self.u, hessian=False)
        gap = self.gap.numpy()
        touching = columns[[bool((gap[b, : len(self.patches[b].faces)] < 0.0).any()) or bool(self._pushed[b].any()) for b in columns]]
        if not len(touching):
            return
        base = self.u.numpy().astype(np.float64).copy()
        trial = base.copy()
        for b in touching:
            if self.compliance[b] is None:
                self.compliance[b] = self._patch_compliance(b)
        dof = {b: (3 * self.patches[b].nodes[:, None] + np.arange(3)).ravel() for b in touching}
        running, delta = list(touching), {}
        for _ in range(20):
            self._touch(np.array(running), pose, wp.array(trial, dtype=self.a.real, device=self.device))
            gap, normal, curvature = self.gap.numpy(), self.normal.numpy(), self.curvature.numpy()
            face_force = self.face_force.numpy()
            for b in list(running):
                p, a = self.patches[b], self.compliance[b]
                f = len(p.faces)
                delta[b] = self._nodal(b, face_force[b]) - self._pushed[b]
                miss = trial[dof[b], b] - base[dof[b], b] - a @ delta[b]
                rows, d, _ = contact.contact_matrices(p, gap[b, :f], normal[b, :f], curvature[b, :f], bend=False)
                small = rows @ a @ rows.T
                small[np.diag_indices_from(small)] += 1.0 / d
                step = -miss + a @ (rows.T @ np.linalg.solve(small, rows @ miss))
                if np.abs(step).max() < 1e-4 * max(np.abs(trial[dof[b], b]).max(), 1e-9):
                    running.remove(b)
                trial[dof[b], b] += step
            if not running:
                break
        change = np.zeros((len(self.model.free), len(touching)))
        for k, b in enumerate(touching):
            change[dof[b], k] = delta[b]
        moved = self.model.factor.solve(change * self.model.free[:, None])
        self._set(base[:, touching] + moved, touching)
        after = self._evaluate(touching, pose, self.u, hessian=False)
        worse = ~(after["potential"] < before["potential"][np.isin(columns, touching)])
        if worse.any():
            self._set(base[:, touching[worse]], touching[worse])

    def _patch_compliance(self, b: int) -> np.ndarray:
        nodes = self.patches[b].nodes
        free = self.model.free.reshape(-1, 3)[nodes].ravel()
        return self.model.factor.compliance(nodes) * free * free[:, None]

    def _set(self, u: np.ndarray, columns: np.ndarray | None = None) -> None:
        if columns is not None:
            whole = self.u.numpy().copy()
            whole[:, columns] = u
            u = whole
        self.u = wp.array(u, dtype=self.a.real, device=self.device)

    def _advance(self, columns: np.ndarray, before: np.ndarray, pose: np.ndarray, deadline: float,
                 halvings: int) -> dict[str, np.ndarray]:
        """Equilibria of ``columns`` at ``pose`` (B, 4, 4); columns that fail are retried from the last good state in half steps."""
        start = self._good if halvings == self.options.halvings else self.u.numpy().copy()
        out = self._equilibrium(columns, pose, deadline)
        failed = columns[~out["converged"][columns]]
        if len(failed) and halvings > 0 and time.perf_counter() < deadline:
            self._set(start[:, failed], failed)
            middle = pose.copy()
            middle[failed] = _between(before[failed], pose[failed])
            first = self._advance(failed, before, middle, deadline, halvings - 1)
            second = self._advance(failed, middle, pose, deadline, halvings - 1)
            for key, values in out.items():
                values[failed] = second[key][failed]
                if key in ("iterations", "cg_iterations"):
                    values[failed] += first[key][failed]
        if halvings == self.options.halvings:
            self._good = self.u.numpy().copy()
            self._pushed = [self._nodal(b, f) for b, f in enumerate(self.face_force.numpy())]
        return out

    # ------------------------------------------------------------------------------------------ Newton

    def _evaluate(self, columns: np.ndarray, pose: np.ndarray, u: wp.array, *, hessian: bool) -> dict[str, np.ndarray]:
        a, n = self.a, len(self.model.mesh.points)
        index = wp.array(columns, dtype=wp.int32, device=self.device)
        count = len(columns)
        wp.launch(a.tet.evaluate, dim=(len(self.model.mesh.tets), count), device=self.device, inputs=[
            a.nodes, a.gradients, a.volume, a.mu, a.lam, int(hessian), index, u,
            self.element_force, self.tet_energy, self.tet_det, self.hessian])
        if hessian:
            return {}
        wp.launch(a.tet.gather, dim=(n, count), device=self.device,
                  inputs=[a.start, a.slot, a.every, index, 0, self.element_force, self.internal])
        wp.launch(a.tet.summarise, dim=count, device=self.device,
                  inputs=[index, self.tet_energy, self.tet_det, self.energy, self.det])
        self._touch(columns, pose, u)
        internal = self.internal.numpy()[:, columns].astype(np.float64)
        face_force = self.face_force.numpy()
        pushed = np.zeros((3 * n, count))
        for k, b in enumerate(columns):
            pushed[(3 * self.patches[b].nodes[:, None] + np.arange(3)).ravel(), k] = self._nodal(b, face_force[b])
        where = u.numpy()[:, columns].astype(np.float64)
        load = self.model.load[:, None]
        total = (self.energy.numpy()[columns].astype(np.float64) + self.contact_energy.numpy()[columns].sum(axis=1)
                 - (load * where).sum(axis=0))
        return {"internal": internal, "contact": pushed, "potential": total,
                "residual": (load + pushed - internal) * self.model.free[:, None]}

    def _touch(self, columns: np.ndarray, pose: np.ndarray, u: wp.array) -> None:
        """Gaps, normals and contact forces of ``columns`` at ``pose`` for displacements u (3 n, B)."""
        a = self.a
        wp.launch(a.contact.evaluate, dim=(self.face_nodes.shape[1], len(columns)), device=self.device, inputs=[
            a.rest, a.contact.mat66(contact.SHAPE), self._kind, a.contact.vec4(self._size),
            wp.array(columns, dtype=wp.int32, device=self.device), self.face_nodes, self.stiffness,
            wp.array(pose[:, :3, 3], dtype=a.contact.vec3, device=self.device),
            wp.array(pose[:, :3, :3], dtype=a.contact.mat33, device=self.device), u,
            self.gap, self.normal, self.curvature, self.contact_energy, self.face_force])

    def _nodal(self, b: int, face_force: np.ndarray) -> np.ndarray:
        """Contact forces on the patch's degrees of freedom (3 s,) [N] from those on its faces (f, 6, 3)."""
        p = self.patches[b]
        nodal = np.zeros((len(p.nodes), 3))
        np.add.at(nodal, p.local, face_force[: len(p.faces)].astype(np.float64))
        return nodal.ravel()

    def _measure(self, state: dict[str, np.ndarray]) -> np.ndarray:
        """Unbalanced force over acting force, per column: sums of the lengths of nodal vectors."""
        def size(v: np.ndarray) -> np.ndarray:
            return np.linalg.norm(v.reshape(-1, 3, v.shape[1]), axis=1).sum(axis=0)

        acting = np.maximum(size(state["contact"]), size(self.model.load[:, None]))
        return size(state["residual"]) / np.maximum(acting, self._floor)

    def _equilibrium(self, columns: np.ndarray, pose: np.ndarray, deadline: float) -> dict[str, np.ndarray]:
        opt, batch = self.options, self.u.shape[1]
        newton, cg = np.zeros(batch, int), np.zeros(batch, int)
        state = self._evaluate(columns, pose, self.u, hessian=False)
        measure = self._measure(state)
        for _ in range(4):  # the patch may have to grow
            open_ = np.flatnonzero(measure > opt.tolerance)
            for _ in range(opt.newton):
                if not len(open_) or time.perf_counter() > deadline:
                    break
                active = columns[open_]
                direction, steps = self._direction(active, pose, state["residual"][:, open_])
                taken = self._line_search(active, pose, direction, {k: v[..., open_] for k, v in state.items()})
                newton[active] += 1
                cg[active] += steps
                for key, value in taken.items():
                    state[key][..., open_] = value
                measure[open_] = self._measure({k: v[..., open_] for k, v in state.items()})
                stuck = np.isnan(measure)
                open_ = np.flatnonzero((measure > opt.tolerance) & ~stuck)
            if not self._grow(columns, pose):
                break
            state = self._evaluate(columns, pose, self.u, hessian=False)
            measure = self._measure(state)
        return self._report(columns, state, measure, newton, cg)

    def _direction(self, columns: np.ndarray, pose: np.ndarray, residual: np.ndarray) -> tuple[wp.array, int]:
        a, count = self.a, len(columns)
        self._evaluate(columns, pose, self.u, hessian=True)
        index = wp.array(columns, dtype=wp.int32, device=self.device)
        gap, normal, curvature = self.gap.numpy(), self.normal.numpy(), self.curvature.numpy()
        width = 3 * self.patch_nodes.shape[1]
        stiff = np.zeros((len(self.patches), width, width))
        inverse = np.zeros((len(self.patches), width, width))
        for b in columns:
            p = self.patches[b]
            f = len(p.faces)
            rows, d, bend = contact.contact_matrices(p, gap[b, :f], normal[b, :f], curvature[b, :f])
            if not len(rows):
                continue
            if self.compliance[b] is None:
                self.compliance[b] = self._patch_compliance(b)
            rows = rows * self.model.free.reshape(-1, 3)[p.nodes].ravel()
            s = rows.shape[1]
            stiff[b, :s, :s] = rows.T @ (d[:, None] * rows) + bend
            small = rows @ self.compliance[b] @ rows.T
            small[np.diag_indices_from(small)] += 1.0 / d
            inverse[b, :s, :s] = rows.T @ np.linalg.solve(small, rows)
        stiff_array = wp.array(stiff, dtype=a.real, device=self.device)
        inverse_array = wp.array(inverse, dtype=a.real, device=self.device)
        nodes = len(self.model.mesh.points)
        has_contact = bool(np.any(inverse))

        def patch(block: wp.array, sign: float, x: wp.array, y: wp.array) -> None:
            if has_contact:
                wp.launch(a.pcg.patch, dim=(width, count), device=self.device,
                          inputs=[block, self.patch_nodes, index, sign, x, y])

        def multiply(x: wp.array) -> wp.array:
            out = wp.empty_like(x)
            wp.launch(a.tet.multiply, dim=(len(self.model.mesh.tets), count), device=self.device,
                      inputs=[a.nodes, a.gradients, index, self.hessian, x, self.element_force])
            wp.launch(a.tet.gather, dim=(nodes, count), device=self.device,
                      inputs=[a.start, a.slot, a.free, index, 1, self.element_force, out])
            patch(stiff_array, 1.0, x, out)
            return out

        def back(x: wp.array) -> wp.array:
            return wp.array(self.model.factor.solve(x.numpy()), dtype=a.real, device=self.device)

        def precondition(r: wp.array) -> wp.array:
            if not has_contact:
                return back(r)
            y = back(r)
            r = wp.clone(r)
            patch(inverse_array, -1.0, y, r)
            return back(r)

        right = wp.array(residual, dtype=a.real, device=self.device)
        tolerance = np.full(count, self.options.cg_tolerance)
        direction, steps, _ = pcg.solve(a.pcg, multiply, precondition, right, tolerance=tolerance, iterations=self.options.cg)
        return direction, steps

    def _line_search(self, columns: np.ndarray, pose: np.ndarray, direction: wp.array,
                     state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Halve the step until the potential falls by Armijo's rule (or the residual shrinks, where rounding hides the fall)."""
        d = direction.numpy().astype(np.float64)
        base = self.u.numpy()[:, columns].astype(np.float64)
        slope = (state["residual"] * d).sum(axis=0)
        before, measure0 = state["potential"], self._measure(state)
        step = np.ones(len(columns))
        result = {k: v.copy() for k, v in state.items()}
        chosen = base.copy()
        pending = np.arange(len(columns))
        for _ in range(12):
            trial = base[:, pending] + step[pending] * d[:, pending]
            self._set(trial, columns[pending])
            new = self._evaluate(columns[pending], pose, self.u, hessian=False)
            falls = new["potential"] <= before[pending] - 1e-4 * step[pending] * slope[pending]
            shrinks = (self._measure(new) < 0.5 * measure0[pending]) & (measure0[pending] < 0.05)
            good = falls | shrinks
            for key in result:
                result[key][..., pending[good]] = new[key][..., good]
            chosen[:, pending[good]] = trial[:, good]
            pending = pending[~good]
            if not len(pending):
                break
            step[pending] *= 0.5
        self._set(chosen, columns)
        return result

    def _grow(self, columns: np.ndarray, pose: np.ndarray) -> bool:
        """Extend the patch of any touch whose probe has met surface outside it; True if one grew."""
        mesh = self.model.mesh
        u = self.u.numpy().astype(np.float64).reshape(-1, 3, self.u.shape[1])
        surface = mesh.surface_nodes()
        grown = False
        for b in columns:
            inside = np.zeros(len(mesh.points), bool)
            x = mesh.points[surface] + u[surface, :, b]
            local = (x - pose[b, :3, 3]) @ pose[b, :3, :3]
            inside[surface] = sdf.distance(self.probe, local) < 0.0
            met = np.flatnonzero(inside[mesh.faces].any(axis=1))
            extra = np.setdiff1d(met, self.patches[b].faces)
            if len(extra):
                near = np.zeros(len(mesh.points), bool)
                near[mesh.faces[extra]] = True
                faces = np.union1d(self.patches[b].faces, np.flatnonzero(near[mesh.faces].any(axis=1)))
                self.patches[b] = contact.make_patch(mesh, faces, self.model.surface_modulus)
                grown = True
        if grown:
            self._upload_patches()
        return grown

    def _report(self, columns: np.ndarray, state: dict[str, np.ndarray], measure: np.ndarray, newton: np.ndarray,
                cg: np.ndarray) -> dict[str, np.ndarray]:
        batch = self.u.shape[1]
        shape3 = (-1, 3, len(columns))
        on_body = state["contact"].reshape(shape3).sum(axis=0).T
        held = ((state["internal"] - self.model.load[:, None]) * (1.0 - self.model.free[:, None])).reshape(shape3).sum(axis=0).T
        weight = self.model.load.reshape(-1, 3).sum(axis=0)
        unbalanced = np.linalg.norm(held + on_body + weight, axis=1)
        largest = np.maximum(np.maximum(np.linalg.norm(held, axis=1), np.linalg.norm(on_body, axis=1)), self._floor)
        depth = -np.minimum(self.gap.numpy()[columns].reshape(len(columns), -1), 0.0).min(axis=1)
        values = {
            "force": -on_body, "reaction": held, "converged": measure <= self.options.tolerance, "residual": measure,
            "iterations": newton[columns], "cg_iterations": cg[columns], "force_balance": unbalanced / largest,
            "min_det_f": self.det.numpy()[columns].astype(np.float64),
            "energy": self.energy.numpy()[columns].astype(np.float64), "penetration": depth,
        }
        out = {}
        for key, value in values.items():
            value = np.asarray(value)
            full = np.zeros((batch, *value.shape[1:]), value.dtype)
            full[columns] = value
            out[key] = full
        return out


def _between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pose half-way (k, 4, 4); the rotation is the second one's (a press moves straight)."""
    out = b.copy()
    out[:, :3, 3] = 0.5 * (a[:, :3, 3] + b[:, :3, 3])
    return out
