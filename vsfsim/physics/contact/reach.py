"""What of an object's boundary rigid bodies can reach on their way, and how finely contact samples it there."""

from __future__ import annotations

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import rigid_kernels
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import has_edges
from vsfsim.physics.contact.patch import smooth_radius, solid_cuts
from vsfsim.physics.model import Model

_BULGE = 0.15  # of the depth: margin for surface that bulges up
# share of the depth of a mount that its spring is taken to give way; that of shoes-v3 gives way by more. What a body
# that comes further meets becomes part of the patch when it does
_BEHIND = 0.3


class Gaps:
    """Distances from points to K rigid bodies, on the device.

    Args:
        bodies: the rigid bodies.
        device: Warp device.
    """

    def __init__(self, bodies: RigidBodies, device: str):
        self._kernels, self._device, self._count = rigid_kernels.kernels(), device, len(bodies)
        self.set = bodies.upload(self._kernels.sdf, device)
        """The bodies as the kernels take them."""

    def nearest(self, poses: np.ndarray, points: torch.Tensor, *, body: int | None = None) -> torch.Tensor:
        """Least gap (s, B) [m] of points (s, 1 or B, 3) over the poses (T, B, K, 4, 4), to one ``body`` or to all."""
        k = self._kernels
        first, end = (0, self._count) if body is None else (body, body + 1)
        origin, turn = (torch.as_tensor(np.ascontiguousarray(a), device=self._device)
                        for a in (poses[..., :3, 3], poses[..., :3, :3]))
        out = torch.empty((len(points), origin.shape[1]), dtype=torch.float64, device=self._device)
        wp.launch(k.nearest, dim=out.shape, device=self._device, inputs=[
            self.set, first, end, wp.from_torch(origin, dtype=k.vec3),
            wp.from_torch(turn, dtype=k.mat33), wp.from_torch(points.contiguous(), dtype=k.vec3),
            wp.from_torch(out)])
        return out


class Reach(Gaps):
    """Distances from the boundary of an object to rigid bodies.

    Args:
        model: the object.
        bodies: the rigid bodies (K).
        device: Warp device.
        local: whether round bodies sink in locally, see `local_indentation`: their contact is small.
        by_place: whether by what the object lacks where it is touched.
        sprung: whether springs carry the bodies: poses are those of their mounts, and the bodies stay behind.
    """

    def __init__(self, model: Model, bodies: RigidBodies, device: str, *, local: bool = False, by_place: bool = False,
                 sprung: bool = False):
        super().__init__(bodies, device)
        self.model, self.bodies, self.device = model, bodies, device
        self._behind = _BEHIND if sprung else 0.0
        self._local = {"local": local, "by_place": by_place}
        self._surface = torch.as_tensor(model.mesh.surface_nodes(), device=device)
        self._faces = torch.as_tensor(model.mesh.faces.astype(np.int64), device=device)
        self._rest = torch.as_tensor(model.mesh.points, device=device)[self._surface][:, None]

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
