"""What of an object's boundary rigid bodies can reach on their way, and how finely contact samples it there."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import has_edges
from vsfsim.physics.contact.patch import smooth_radius, solid_cuts
from vsfsim.physics.model import Model

_BULGE = 0.15  # of the depth: margin for surface that bulges up
# share of the depth of a mount that its spring is taken to give way; that of shoes-v3 gives way by more. What a body
# that comes further meets becomes part of the patch when it does
_BEHIND = 0.3


class Reach:
    """Distances from the boundary of an object to rigid bodies.

    Args:
        model: the object.
        bodies: the rigid bodies (K).
        uploaded: the same on the device, see `RigidBodies.upload`.
        kernels: of `rigid_kernels`.
        device: Warp device.
        local: whether round bodies sink in locally, see `local_indentation`: their contact is small.
        by_place: whether by what the object lacks where it is touched.
        sprung: whether springs carry the bodies: poses are those of their mounts, and the bodies stay behind.
    """

    def __init__(self, model: Model, bodies: RigidBodies, uploaded: Any, kernels: Any, device: str, *,
                 local: bool = False, by_place: bool = False, sprung: bool = False):
        self.model, self.bodies, self.device = model, bodies, device
        self._behind = _BEHIND if sprung else 0.0
        self._local = {"local": local, "by_place": by_place}
        self._set, self._kernels = uploaded, kernels
        self._surface = torch.as_tensor(model.mesh.surface_nodes(), device=device)
        self._faces = torch.as_tensor(model.mesh.faces.astype(np.int64), device=device)
        self._rest = torch.as_tensor(model.mesh.points, device=device)[self._surface][:, None]

    def nearest(self, poses: np.ndarray | tuple[torch.Tensor, torch.Tensor], points: torch.Tensor, *,
                body: int | None = None) -> torch.Tensor:
        """Least gap (s, B) [m] of points (s, 1 or B, 3) over the poses (T, B, K, 4, 4), or their origins (T, B, K, 3)
        and rotations (T, B, K, 3, 3), to one ``body`` or to all."""
        k = self._kernels
        first, end = (0, len(self.bodies)) if body is None else (body, body + 1)
        origin, turn = poses if isinstance(poses, tuple) else (
            torch.as_tensor(np.ascontiguousarray(a), device=self.device)
            for a in (poses[..., :3, 3], poses[..., :3, :3]))
        out = torch.empty((len(points), origin.shape[1]), dtype=torch.float64, device=self.device)
        wp.launch(k.nearest, dim=out.shape, device=self.device, inputs=[
            self._set, first, end, wp.from_torch(origin.contiguous(), dtype=k.vec3),
            wp.from_torch(turn.contiguous(), dtype=k.mat33), wp.from_torch(points.contiguous(), dtype=k.vec3),
            wp.from_torch(out)])
        return out

    def plan(self, poses: np.ndarray, cuts: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What the bodies can reach on their way.

        Args:
            poses: all poses to come (T, B, K, 4, 4).
            cuts: least number of parts along the edge of a face.

        Returns:
            Least gaps at the first poses (B,) [m], whether each boundary face may come into contact (B, f) bool, and
            the number of parts along its edge (B, f).
        """
        first = self.nearest(poses[:1], self._rest).amin(dim=0).cpu().numpy()
        gaps = [self.nearest(poses, self._rest, body=k) for k in range(len(self.bodies))]
        reachable = self._reachable(torch.stack(gaps).amin(dim=0)).cpu().numpy()
        out = np.full(reachable.shape, cuts)
        if self.model.mesh.faces.shape[1] == 6:
            edge = np.sqrt(2.0 * self.model.mesh.face_area())
            for shape, gap in zip(self.bodies.shapes, gaps, strict=True):
                radius = smooth_radius(shape)
                if radius == 0.0 and not has_edges(shape):
                    radius = np.inf  # the mesh of a smooth body: faces are cut where it is found between the points
                wanted = solid_cuts(radius, edge, **self._local)
                out = np.maximum(out, np.where(self._reachable(gap).cpu().numpy(), wanted, 1))
        return first, reachable, out

    def _reachable(self, gap: torch.Tensor) -> torch.Tensor:
        """Boundary faces (B, f) bool that may come into contact: by the least gaps (s, B) [m] of the surface nodes at
        rest, with a margin for surface that bulges up."""
        nearest = torch.full((len(self.model.mesh.points), gap.shape[1]), float("inf"), dtype=gap.dtype,
                             device=self.device)
        nearest[self._surface] = gap
        deepest = (-gap.amin(dim=0)).clamp(min=0.0)
        margin = (_BULGE * (1.0 - self._behind) - self._behind) * deepest + 0.1 * self.model.element_size
        return (torch.stack([nearest[nodes] for nodes in self._faces.T]).amin(dim=0) < margin).T

    def met(self, pose: np.ndarray, u: torch.Tensor) -> torch.Tensor:
        """Boundary faces with a node inside a body (B, f) bool, at poses (B, K, 4, 4) and displacements u (3 n, B)
        [m]."""
        points = self._rest + u.view(-1, 3, u.shape[1])[self._surface].transpose(1, 2)
        inside = torch.zeros((len(self.model.mesh.points), u.shape[1]), dtype=torch.bool, device=self.device)
        inside[self._surface] = self.nearest(pose[None], points) < 0.0
        return inside[self._faces].any(dim=1).T

    def depth(self, values: torch.Tensor, x: torch.Tensor, local: torch.Tensor, used: torch.Tensor,
              pose: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """Depth (k,) [m] of the deepest point of the faces of k patches inside any body.

        Args:
            values: shape values of the points of a face (s, 6).
            x: positions of the patches' nodes (k, n, 3) [m].
            local: nodes of each face (k, f, 6).
            used: which faces are no padding (k, f) bool.
            pose: origins (1, k, K, 3) [m] and rotations (1, k, K, 3, 3) of the bodies.
        """
        count, f = local.shape[:2]
        corner = x.gather(1, local.reshape(count, 6 * f, 1).expand(-1, -1, 3)).view(count, f, 6, 3)
        gap = self.nearest(pose, torch.einsum("sa,kfac->fskc", values, corner).reshape(-1, count, 3))
        return -torch.where(used.T.repeat_interleave(len(values), dim=0), gap, torch.inf).amin(dim=0)
