"""Contact of a batch of touches with one body: who can meet whom, gaps, forces, and the condensed problem.

Each touch (column) has a patch: the boundary triangles that its probe can reach. On the patch's degrees of freedom the
rest-state compliance A gives the elastic answer of the whole body, so the contact problem of linear elasticity,

    u_S = u0_S + A (f(u_S) - f0),

is small and dense; a semi-smooth Newton method with a line search on its energy solves it exactly. It is the `linear` tier, and the prediction of the others.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from vsfsim.core.shape import ProbeShape
from vsfsim.physics import contact, sdf
from vsfsim.physics.model import Model
from vsfsim.physics.rigid import RigidBodies


class Touching:
    """Contact state of B touches on the device.

    patches: one a touch. nodes: patch nodes on the device (B, s), -1 pads.
    softening: factor on the contact stiffness of each touch (B,), 1 but on the way to a hard frame.

    Args:
        model: the body. probe: its shape. poses: probe to world (T, B, 4, 4), to find what is in reach.
        device: Warp device. real: `wp.float32` or `wp.float64`.
    """

    def __init__(self, model: Model, probe: ProbeShape, poses: np.ndarray, *, device: str, real: type):
        self.model, self.probe, self.device, self.real = model, probe, device, real
        self.kernels = contact.kernels(real)
        self._bodies = RigidBodies(probe).upload(self.kernels.probe, device)
        self._shape = self.kernels.mat66(contact.SHAPE)
        self._rest = wp.array(model.mesh.points, dtype=self.kernels.vec3, device=device)
        self.patches = [contact.make_patch(model.mesh, self._reachable(poses[:, b]), model.surface_modulus)
                        for b in range(poses.shape[1])]
        self.softening = np.ones(poses.shape[1])
        self._upload()

    def _reachable(self, path: np.ndarray) -> np.ndarray:
        """Boundary triangles that the probe may meet on its way, by rest position and a margin for what bulges up."""
        mesh = self.model.mesh
        nodes = mesh.surface_nodes()
        nearest = np.full(len(mesh.points), np.inf)
        for pose in path:
            local = (mesh.points[nodes] - pose[:3, 3]) @ pose[:3, :3]
            nearest[nodes] = np.minimum(nearest[nodes], sdf.distance(self.probe, local))
        deepest = max(0.0, -float(nearest.min()))
        margin = 0.15 * deepest + 0.1 * self.model.element_size
        return np.flatnonzero(nearest[mesh.faces].min(axis=1) < margin)

    def _upload(self) -> None:
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
        k, new = self.kernels, {"device": self.device}
        self._faces = wp.array(table, dtype=wp.int32, **new)
        self._stiffness = wp.array(stiffness, dtype=wp.float64, **new)
        self.nodes = wp.array(listed, dtype=wp.int32, **new)
        self._gap = wp.zeros((batch, faces, 6), dtype=wp.float64, **new)
        self._normal = wp.zeros((batch, faces, 6), dtype=k.vec3, **new)
        self._curvature = wp.zeros((batch, faces, 6), dtype=k.mat33, **new)
        self._energy = wp.zeros((batch, faces), dtype=wp.float64, **new)
        self._force = wp.zeros((batch, faces, 6), dtype=k.vec3, **new)
        self._compliance: list[np.ndarray | None] = [None] * batch

    # ------------------------------------------------------------------------------------------ evaluation

    def evaluate(self, columns: np.ndarray, pose: np.ndarray, u: wp.array) -> None:
        """Gaps, normals and forces of ``columns`` at ``pose`` (B, 4, 4) for displacements u (3 n, B) [m]."""
        wp.launch(self.kernels.evaluate, dim=(self._faces.shape[1], len(columns)), device=self.device, inputs=[
            self._rest, self._shape, self._bodies, wp.array(columns, dtype=wp.int32, device=self.device),
            self._faces, self._stiffness, wp.array(self.softening, dtype=wp.float64, device=self.device), wp.array(pose[:, :3, 3], dtype=self.kernels.vec3, device=self.device),
            wp.array(pose[:, :3, :3], dtype=self.kernels.mat33, device=self.device), u,
            self._gap, self._normal, self._curvature, self._energy, self._force])
        # one look at the results serves the host: they are small (the patches only)
        self.gap, self.normal = self._gap.numpy(), self._normal.numpy()
        self.curvature, self.force = self._curvature.numpy(), self._force.numpy()
        self.energy = self._energy.numpy().sum(axis=1)

    def dof(self, b: int) -> np.ndarray:
        """Degrees of freedom of touch ``b``'s patch (3 s,)."""
        return (3 * self.patches[b].nodes[:, None] + np.arange(3)).ravel()

    def nodal(self, b: int) -> np.ndarray:
        """Contact forces of touch ``b`` on its patch's degrees of freedom (3 s,) [N]."""
        p = self.patches[b]
        out = np.zeros((len(p.nodes), 3))
        np.add.at(out, p.local, self.force[b, : len(p.faces)])
        return out.ravel()

    def rows(self, b: int, *, geometric: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Active rows (m, 3 s), their stiffness (m,) [N/m] and the geometric block (3 s, 3 s) [N/m] of touch ``b``."""
        p = self.patches[b]
        f = len(p.faces)
        rows, stiffness, bend = contact.contact_matrices(
            p, self.gap[b, :f], self.normal[b, :f], self.curvature[b, :f], bend=geometric)
        return rows * self.model.free[self.dof(b)], self.softening[b] * stiffness, self.softening[b] * bend

    def compliance(self, b: int) -> np.ndarray:
        """Rest-state compliance of touch ``b``'s patch (3 s, 3 s) [m/N], 0 where held."""
        if self._compliance[b] is None:
            free = self.model.free[self.dof(b)]
            self._compliance[b] = self.model.factor.compliance(self.patches[b].nodes) * free * free[:, None]
        return self._compliance[b]

    def touches(self, b: int) -> bool:
        """Is any Gauss point of touch ``b`` inside the probe?"""
        return bool((self.gap[b, : len(self.patches[b].faces)] < 0.0).any())

    def penetration(self, b: int) -> float:
        """Deepest Gauss point of touch ``b`` [m]."""
        return -float(min(0.0, self.gap[b, : len(self.patches[b].faces)].min(initial=0.0)))

    # ------------------------------------------------------------------------------------------ the condensed problem

    def condensed(self, columns: np.ndarray, pose: np.ndarray, base: np.ndarray, pushed: list[np.ndarray], *,
                  iterations: int, tolerance: float, start: list[np.ndarray] | None = None) -> tuple[list[np.ndarray], np.ndarray]:
        """Change of the contact forces when the probes go to ``pose``, the body answering as at rest.

        Args:
            columns: touches. pose: (B, 4, 4). base: displacements before (3 n, B) [m].
            pushed: contact forces before, on each patch's degrees of freedom [N]. iterations: limit.
            tolerance: relative error of the patch's displacements. start: changes to begin with, or None for none.

        Returns:
            Changes on each patch's degrees of freedom [N], in the order of ``columns``, and the relative errors left.
        """
        trial = np.array(base, dtype=np.float64)
        q = {b: np.zeros(3 * len(self.patches[b].nodes)) for b in columns}  # forces sought; u_S = base + A q throughout
        for b, known in zip(columns, start or [], strict=False):
            if len(known) == len(q[b]):
                q[b] = known
                trial[self.dof(b), b] += self.compliance(b) @ known
        dq, move, level, slope = dict(q), dict(q), dict.fromkeys(columns, np.inf), dict.fromkeys(columns, 0.0)
        step = dict.fromkeys(columns, 1.0)
        error = dict.fromkeys(columns, np.inf)
        best = {b: (np.inf, q[b]) for b in columns}
        running = list(columns)
        for _ in range(iterations):
            self.evaluate(np.array(running), pose, wp.array(trial, dtype=self.real, device=self.device))
            for b in list(running):
                a, dof = self.compliance(b), self.dof(b)
                energy = 0.5 * (trial[dof, b] - base[dof, b]) @ q[b] + pushed[b] @ (trial[dof, b] - base[dof, b]) + self.energy[b]
                if energy > level[b] - 1e-4 * step[b] * slope[b] + 1e-12 * abs(level[b]) and step[b] > 1e-4:
                    # too far: back half of what is left of this step
                    step[b] *= 0.5
                    q[b] = q[b] - step[b] * dq[b]
                    trial[dof, b] -= step[b] * move[b]
                    continue
                rho = self.nodal(b) - pushed[b] - q[b]
                miss = a @ rho
                error[b] = float(np.abs(miss).max(initial=0.0) / max(np.abs(trial[dof, b]).max(initial=0.0), 1e-9))
                if error[b] < best[b][0]:
                    best[b] = (error[b], self.nodal(b) - pushed[b])
                if error[b] < tolerance:
                    running.remove(b)
                    continue
                rows, stiffness, _ = self.rows(b, geometric=False)
                small = rows @ a @ rows.T
                small[np.diag_indices_from(small)] += 1.0 / stiffness
                dq[b] = rho - rows.T @ np.linalg.solve(small, rows @ miss)
                move[b] = a @ dq[b]
                level[b], slope[b], step[b] = energy, dq[b] @ miss, 1.0
                q[b] = q[b] + dq[b]
                trial[dof, b] += move[b]
            if not running:
                break
        return [best[b][1] for b in columns], np.array([best[b][0] for b in columns])

    # ------------------------------------------------------------------------------------------ nothing slips through

    def grow(self, columns: np.ndarray, pose: np.ndarray, u: np.ndarray) -> bool:
        """Extend the patch of any touch whose probe has met surface outside it; True if one grew.

        Args:
            columns: touches. pose: (B, 4, 4). u: displacements (3 n, B) [m].
        """
        mesh = self.model.mesh
        surface = mesh.surface_nodes()
        grown = False
        for b in columns:
            inside = np.zeros(len(mesh.points), bool)
            x = mesh.points[surface] + u.reshape(-1, 3, u.shape[1])[surface, :, b]
            inside[surface] = sdf.distance(self.probe, (x - pose[b, :3, 3]) @ pose[b, :3, :3]) < 0.0
            met = np.flatnonzero(inside[mesh.faces].any(axis=1))
            extra = np.setdiff1d(met, self.patches[b].faces)
            if len(extra):
                near = np.zeros(len(mesh.points), bool)
                near[mesh.faces[extra]] = True
                faces = np.union1d(self.patches[b].faces, np.flatnonzero(near[mesh.faces].any(axis=1)))
                self.patches[b] = contact.make_patch(mesh, faces, self.model.surface_modulus)
                grown = True
        if grown:
            self._upload()
        return grown
