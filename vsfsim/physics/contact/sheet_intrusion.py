"""Whether a rigid body lies behind a sheet that it cannot have passed: a check by geometry for membranes with a rim.

The sheet and a cone from its rim to a point far behind it close a volume. A point of a body's surface that lies in that
volume is as deep behind the sheet as it is far from it. A body in contact dents the sheet, past the plane of the rim
perhaps, and stays outside; one that went through between two equilibria is inside, where no contact point feels it.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import closest_point
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import body_samples, inner_radius
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.runtime import mat33, real, vec3

_SPACING = 0.5  # of the samples over the inner radius of their body: a body that went through has most of them inside
_FAR = 2.0  # way of that point behind the rim, over the rim's width
_DEEP = (0.1, 0.25)  # depth above which a body has gone through, over the element size and over its inner radius


class SheetIntrusion:
    """The check for one sheet and its bodies.

    Args:
        mesh: triangles, wound outwards; their rim lies in a plane.
        bodies: the rigid bodies (K).
        size: element size [m].
        device: Warp device.
    """

    tolerance: float
    """Depth above which a body counts as having gone through [m]."""

    def __init__(self, mesh: QuadraticMesh, bodies: RigidBodies, size: float, *, device: str):
        k, faces = kernels(), mesh.faces
        radii = [inner_radius(s) for s in bodies.shapes]
        self.device, self.tolerance = device, min(_DEEP[0] * size, _DEEP[1] * min(radii))
        samples = [body_samples(s, _SPACING * r) if np.isfinite(r) else np.zeros((0, 3))
                   for s, r in zip(bodies.shapes, radii, strict=True)]
        self._count = sum(map(len, samples))
        self._samples = wp.array(np.concatenate(samples), dtype=k.vec3, device=device)
        self._owner = wp.array(np.repeat(np.arange(len(samples)), list(map(len, samples))), dtype=wp.int32,
                               device=device)
        self._sheet = len(faces)
        cone, tip = rim_cone(faces, mesh.points)
        self._closed = wp.array(np.concatenate([faces, cone]).astype(np.int32), dtype=wp.int32, device=device)
        self._rest, self._tip = (torch.as_tensor(p, device=device) for p in (mesh.points, tip))

    def check(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> torch.Tensor:
        """How deep the bodies lie behind the sheet (k,) [m] in the touches ``columns`` (k,), at poses (B, K, 4, 4) and
        displacements u (3 n, B) [m]."""
        k, count = kernels(), len(columns)
        depth = torch.zeros((count, max(1, self._count)), dtype=torch.float64, device=self.device)
        if self._count:
            host = columns.cpu().numpy()
            at = self._rest + u[:, columns].view(-1, 3, count).permute(2, 0, 1)
            at = torch.cat([at, self._tip.expand(count, 1, 3)], dim=1)
            box = (wp.from_torch(v.contiguous(), dtype=k.vec3) for v in (at.amin(dim=1), at.amax(dim=1)))
            wp.launch(k.behind, dim=(count, self._count), device=self.device, inputs=[
                self._closed, self._sheet, self._samples, self._owner,
                wp.array(pose[host][..., :3, 3], dtype=k.vec3, device=self.device),
                wp.array(pose[host][..., :3, :3], dtype=k.mat33, device=self.device),
                wp.from_torch(at.contiguous(), dtype=k.vec3), *box, wp.from_torch(depth)])
        return depth.amax(dim=1)


def rim_cone(faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (d, 3) that close a sheet of triangles (f, 3) at ``points`` (n, 3) [m] behind its rim, none if it has
    no rim, and their common point (3,) [m], which has the number n."""
    disk = rim_disk(faces)
    ring = points[disk[:, 1]] if len(disk) else points[:1]
    a, b, c = (points[faces[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a).sum(axis=0)
    far = _FAR * np.linalg.norm(np.ptp(ring, axis=0)) / max(float(np.linalg.norm(outward)), 1e-300)
    disk[:, 0] = len(points)
    return disk, ring.mean(axis=0) - far * outward


def rim_disk(faces: np.ndarray) -> np.ndarray:
    """Triangles (d, 3) that close a sheet of triangles (f, 3) along its rim; none if it has no rim."""
    edges = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)]).tolist()
    there = {(a, b) for a, b in edges}
    rim = [(a, b) for a, b in edges if (b, a) not in there]
    return np.array([(rim[0][0], b, a) for a, b in rim], np.int32).reshape(-1, 3)


@functools.cache
def kernels() -> Any:
    """The kernel of the check and its types."""
    module = "vsfsim_sheet_intrusion"
    closest = closest_point.functions(module)
    whole = wp.constant(real(2.0 * np.pi))

    @wp.kernel(module=module, enable_backward=False)
    def behind(
        # model
        closed: wp.array2d(dtype=wp.int32),
        sheet: int,
        samples: wp.array(dtype=vec3),
        owner: wp.array(dtype=wp.int32),
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        low: wp.array(dtype=vec3),
        high: wp.array(dtype=vec3),
        # state out
        depth_out: wp.array2d(dtype=real),
    ):
        # The solid angles of all triangles add up to 4 pi inside the closed surface and to 0 outside; the distance is
        # that to the sheet alone.
        b, s = wp.tid()
        j = owner[s]
        p = origin[b, j] + turn[b, j] * samples[s]
        for c in range(3):
            if p[c] < low[b][c] or p[c] > high[b][c]:
                return
        angle = real(0.0)
        nearest = real(1e30)
        for t in range(closed.shape[0]):
            x0 = x_in[b, closed[t, 0]]
            x1 = x_in[b, closed[t, 1]]
            x2 = x_in[b, closed[t, 2]]
            angle += closest.half_angle(p, x0, x1, x2)
            if t < sheet:
                at = closest.on_triangle(p, x0, x1, x2)
                nearest = wp.min(nearest, wp.length(at[0] * x0 + at[1] * x1 + at[2] * x2 - p))
        # each triangle's angle is twice its arc tangent: inside, the sum of the arc tangents is 2 pi
        if wp.abs(angle) > real(0.5) * whole:
            depth_out[b, s] = nearest

    return SimpleNamespace(behind=behind, vec3=vec3, mat33=mat33)
