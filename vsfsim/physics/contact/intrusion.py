"""Whether a rigid body lies inside a deformed object: a check by geometry that knows nothing of the contact points.

Two questions are asked of every touch. How deep do points of the object lie inside a body: on a fine grid over every
boundary face (the *penetration*), at all nodes, and at the middle of every element? And how deep do points of a body's
surface lie inside the object: a point that is inside a deformed quadratic tetrahedron (Newton's method for its
barycentric coordinates) is as deep as it is far from the deformed boundary (`closest_point`).
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import closest_point, sdf
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import body_samples, has_edges, inner_radius
from vsfsim.physics.contact.patch import shape_values
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.runtime import mat33, real, vec3

DEEP = 0.05
"""Depth above which a body lies inside the object, over the element size [-]."""
FINE = 0.03
"""Penetration above which a face gets more contact points, over the element size [-]."""
_FINE_SHARP = 0.045  # the same under bodies with edges, whose own points act by then, see `body_points`
LOST = 4.0
"""Times that tolerance: a body in contact that is deeper inside has been lost [-]."""
_SMALL = 0.25  # the same over the inner radius of the smallest body
_SPACING = 0.5  # of a body's samples over the element size, and over the inner radius of the body
_GRID = (6, 20)  # least and most steps of the grid on a face
_INVERSIONS = 8  # of Newton's method for the barycentric coordinates


@dataclass(frozen=True)
class Overlap:
    """How far k touches' bodies and object lie in one another."""

    penetration: torch.Tensor
    """Depth of the deepest point of the boundary inside a body (k,) [m]."""
    inside: torch.Tensor
    """Depth of the deepest point of a body inside the object, or of the object's inner points inside a body (k,)
    [m]."""
    faces: torch.Tensor
    """Depth of the deepest point of each boundary face inside a body (k, F) [m]."""
    near: torch.Tensor
    """Depth of the deepest point of a body inside the object that is nearest to each face (k, F) [m]."""


class Intrusion:
    """The check for one object and its bodies.

    Args:
        mesh: quadratic tetrahedra.
        bodies: the rigid bodies (K).
        size: element size [m].
        device: Warp device.
        coupled: whether the object's inner points go with its boundary. The tier `vsf` has columns under its boundary
            and no state of what lies inside them: there only the boundary and points of the bodies are looked at.
        sinks: how deep bodies sink in locally by `local_indentation`, over the element size [-]. The elements do not
            show it, so that bodies may lie so much deeper inside.
    """

    tolerance: float
    """Depth above which a body counts as inside the object [m]."""
    lost: float
    """Depth above which a body that was in contact when a step began has been lost in it [m]."""
    fine: float
    """Penetration of a face above which it gets more contact points [m]."""

    def __init__(self, mesh: QuadraticMesh, bodies: RigidBodies, size: float, *, device: str,
                 coupled: bool = True, sinks: float = 0.0):
        self.device, self.kernels, self._coupled = device, kernels(), coupled
        k = self.kernels
        small = min(inner_radius(s) for s in bodies.shapes)
        self.tolerance = min((DEEP + sinks) * size, _SMALL * small)
        self.lost = LOST * self.tolerance
        sharp = any(has_edges(s) for s in bodies.shapes)
        self.fine = (_FINE_SHARP if sharp else FINE) / DEEP * self.tolerance
        self._set, self._count = bodies.upload(k.sdf, device), len(bodies)
        samples = [body_samples(s, _SPACING * min(size, inner_radius(s))) for s in bodies.shapes]
        self._owner = np.repeat(np.arange(len(samples)), [len(s) for s in samples])
        self._samples = wp.array(np.concatenate(samples), dtype=k.vec3, device=device)
        self._starts = wp.array(np.cumsum([0, *(len(s) for s in samples)]), dtype=wp.int32, device=device)
        steps = int(np.clip(np.ceil(3.0 * size / small), *_GRID)) if np.isfinite(small) else _GRID[0]
        bary = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
        self._grid = wp.array(shape_values(bary), dtype=wp.float64, device=device)
        self._tets = wp.array(mesh.tets, dtype=wp.int32, device=device)
        self._faces = torch.as_tensor(mesh.faces[None].astype(np.int32), device=device)
        self._rest = torch.as_tensor(mesh.points, device=device)

    def check(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> Overlap:
        """The overlap of the touches ``columns`` (k,) at poses (B, K, 4, 4) and displacements u (3 n, B) [m]."""
        k, device, count = self.kernels, self.device, len(columns)
        host = columns.cpu().numpy()
        origin = wp.array(pose[host][..., :3, 3], dtype=k.vec3, device=device)
        turn = wp.array(pose[host][..., :3, :3], dtype=k.mat33, device=device)
        moved = u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        at = wp.from_torch((self._rest + moved).contiguous(), dtype=k.vec3)

        surface = wp.from_torch(self._faces.expand(count, -1, -1))

        def zeros(*size: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
            return torch.zeros(size, dtype=dtype, device=device)

        faces, balls = zeros(count, self._faces.shape[1]), zeros(count, self._faces.shape[1], 4)
        wp.launch(k.surface, dim=faces.shape, device=device, inputs=[
            self._set, self._count, surface, self._grid, origin, turn, at, wp.from_torch(faces),
            wp.from_torch(balls, dtype=k.vec4)])
        penetration, near = faces.amax(dim=1), torch.zeros_like(faces)
        inner, held = zeros(count, len(self._tets)), zeros(count, len(self._samples), dtype=torch.int32)
        wp.launch(k.volume, dim=inner.shape, device=device, inputs=[
            self._set, self._count, self._tets, self._samples, self._starts, origin, turn, at, wp.from_torch(inner),
            wp.from_torch(held)])
        inside = inner.amax(dim=1) if self._coupled else zeros(count)
        touch, sample = held.nonzero(as_tuple=True)
        if len(touch):
            depth, face = zeros(len(touch)), zeros(len(touch), dtype=torch.int32)
            body = torch.as_tensor(self._owner, device=device)[sample]
            wp.launch(k.depth, dim=len(touch), device=device, inputs=[
                surface, self._samples, wp.from_torch(touch.to(torch.int32)),
                wp.from_torch(sample.to(torch.int32)), wp.from_torch(body.to(torch.int32)), origin, turn, at,
                wp.from_torch(balls, dtype=k.vec4), wp.from_torch(depth), wp.from_torch(face)])
            inside = inside.scatter_reduce(0, touch, depth, "amax")
            flat = touch * faces.shape[1] + face.long()
            near = near.flatten().scatter_reduce(0, flat, depth, "amax").view_as(faces)
        return Overlap(penetration, inside, faces, near)

    def grow(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor, coarse: torch.Tensor,
             touched: torch.Tensor | None) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Where the contact needs more.

        Args:
            columns, pose, u: see `check`.
            coarse: faces that can be cut further (B, F) bool.
            touched: touches that were in contact when the step began (B,) bool. One of these that has lost a body gets
                nothing.

        Returns:
            Penetration and depth inside (2, k) [m], the faces that meet a body (B, F) bool, and those that need more
            points (B, F) bool.
        """
        found = self.check(columns, pose, u)
        met, cut = torch.zeros_like(coarse), torch.zeros_like(coarse)
        inside = found.near > self.tolerance
        met[columns], cut[columns] = (found.faces > 0.0) | inside, (found.faces > self.fine) | inside
        depth = torch.stack([found.penetration, found.inside])
        if touched is not None:
            jumped = columns[touched[columns] & (depth.amax(dim=0) > self.lost)]
            met[jumped], cut[jumped] = False, False
        return depth, met, cut & coarse


@functools.cache
def kernels() -> Any:
    """The kernels of the check and their types."""
    vec4 = wp.types.vector(length=4, dtype=real)
    module = "vsfsim_intrusion"
    probe = sdf.functions(real, module)
    closest = closest_point.functions(module)
    inversions = wp.constant(_INVERSIONS)

    @wp.kernel(module=module, enable_backward=False)
    def surface(
        # model
        bodies: probe.Bodies,
        count: int,
        faces: wp.array3d(dtype=wp.int32),
        grid: wp.array2d(dtype=real),
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        # state out
        depth_out: wp.array2d(dtype=real),
        ball_out: wp.array2d(dtype=vec4),
    ):
        # a ball about each face, and the depth of its deepest grid point inside any body
        b, f = wp.tid()
        middle = vec3()
        for a in range(6):
            middle += x_in[b, faces[b, f, a]] / real(6.0)
        radius = real(0.0)
        for a in range(6):
            radius = wp.max(radius, wp.length(x_in[b, faces[b, f, a]] - middle))
        radius = real(1.5) * radius  # a quadratic face bulges beyond its nodes
        ball_out[b, f] = vec4(middle[0], middle[1], middle[2], radius)
        deepest = real(0.0)
        for j in range(count):
            if probe.gap(bodies, j, wp.transpose(turn[b, j]) * (middle - origin[b, j])) < radius:
                for s in range(grid.shape[0]):
                    p = vec3()
                    for a in range(6):
                        p += grid[s, a] * x_in[b, faces[b, f, a]]
                    deepest = wp.max(deepest,
                                     -probe.gap(bodies, j, wp.transpose(turn[b, j]) * (p - origin[b, j])))
        depth_out[b, f] = deepest

    @wp.func(module=module)
    def place(t: int, b: int, l: vec3, tets: wp.array2d(dtype=wp.int32), x: wp.array2d(dtype=vec3)):  # noqa: E741
        # point of a quadratic tetrahedron at barycentric coordinates 1, 2, 3, and its derivatives by them
        one = real(1.0)
        two = real(2.0)
        four = real(4.0)
        l0 = one - l[0] - l[1] - l[2]
        x0 = x[b, tets[t, 0]]
        x1 = x[b, tets[t, 1]]
        x2 = x[b, tets[t, 2]]
        x3 = x[b, tets[t, 3]]
        x01 = x[b, tets[t, 4]]
        x12 = x[b, tets[t, 5]]
        x20 = x[b, tets[t, 6]]
        x03 = x[b, tets[t, 7]]
        x13 = x[b, tets[t, 8]]
        x23 = x[b, tets[t, 9]]
        p = (l0 * (two * l0 - one) * x0 + l[0] * (two * l[0] - one) * x1 + l[1] * (two * l[1] - one) * x2
             + l[2] * (two * l[2] - one) * x3
             + four * (l0 * l[0] * x01 + l[0] * l[1] * x12 + l[1] * l0 * x20 + l0 * l[2] * x03
                       + l[0] * l[2] * x13 + l[1] * l[2] * x23))
        d0 = (four * l0 - one) * x0 + four * (l[0] * x01 + l[1] * x20 + l[2] * x03)
        d1 = (four * l[0] - one) * x1 + four * (l0 * x01 + l[1] * x12 + l[2] * x13)
        d2 = (four * l[1] - one) * x2 + four * (l[0] * x12 + l0 * x20 + l[2] * x23)
        d3 = (four * l[2] - one) * x3 + four * (l0 * x03 + l[0] * x13 + l[1] * x23)
        return p, d1 - d0, d2 - d0, d3 - d0

    @wp.kernel(module=module, enable_backward=False)
    def volume(
        # model
        bodies: probe.Bodies,
        count: int,
        tets: wp.array2d(dtype=wp.int32),
        samples: wp.array(dtype=vec3),
        starts: wp.array(dtype=wp.int32),
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        # state out
        depth_out: wp.array2d(dtype=real),
        held_out: wp.array2d(dtype=wp.int32),
    ):
        # depth of an element's nodes and middle inside any body; which samples of the bodies are inside the element
        b, t = wp.tid()
        quarter = real(0.25)
        middle, _t1, _t2, _t3 = place(t, b, vec3(quarter, quarter, quarter), tets, x_in)
        radius = real(0.0)
        for a in range(10):
            radius = wp.max(radius, wp.length(x_in[b, tets[t, a]] - middle))
        radius = real(1.2) * radius
        deepest = real(0.0)
        for j in range(count):
            gap = probe.gap(bodies, j, wp.transpose(turn[b, j]) * (middle - origin[b, j]))
            deepest = wp.max(deepest, -gap)
            if gap < radius:
                for a in range(10):
                    x = wp.transpose(turn[b, j]) * (x_in[b, tets[t, a]] - origin[b, j])
                    deepest = wp.max(deepest, -probe.gap(bodies, j, x))
            if gap < radius and gap > -radius:
                for s in range(starts[j], starts[j + 1]):
                    p = origin[b, j] + turn[b, j] * samples[s]
                    if wp.length(p - middle) < radius:
                        l = vec3(quarter, quarter, quarter)  # noqa: E741
                        near = int(1)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
                        for _ in range(inversions):
                            if near == 1:
                                at, d1, d2, d3 = place(t, b, l, tets, x_in)
                                r = p - at
                                det = wp.dot(d1, wp.cross(d2, d3))
                                if wp.abs(det) > real(1e-30):
                                    l = l + vec3(wp.dot(r, wp.cross(d2, d3)), wp.dot(d1, wp.cross(r, d3)),  # noqa: E741
                                                 wp.dot(d1, wp.cross(d2, r))) / det
                                if wp.length(l) > real(4.0):
                                    near = int(0)  # noqa: UP018, RUF046
                        low = wp.min(wp.min(l[0], l[1]), wp.min(l[2], real(1.0) - l[0] - l[1] - l[2]))
                        if near == 1 and low > real(-1e-6):
                            at, d1, d2, d3 = place(t, b, l, tets, x_in)
                            if wp.length(p - at) < real(1e-3) * radius:
                                held_out[b, s] = 1
        depth_out[b, t] = deepest

    @wp.kernel(module=module, enable_backward=False)
    def depth(
        # model
        faces: wp.array3d(dtype=wp.int32),
        samples: wp.array(dtype=vec3),
        touch: wp.array(dtype=wp.int32),
        sample: wp.array(dtype=wp.int32),
        body: wp.array(dtype=wp.int32),
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        ball_in: wp.array2d(dtype=vec4),
        # state out
        depth_out: wp.array(dtype=real),
        face_out: wp.array(dtype=wp.int32),
    ):
        # distance of a body's sample from the deformed boundary, and the nearest face
        i = wp.tid()
        b = touch[i]
        j = body[i]
        p = origin[b, j] + turn[b, j] * samples[sample[i]]
        least = real(1e30)
        nearest = int(0)  # noqa: UP018, RUF046
        for f in range(faces.shape[1]):
            ball = ball_in[b, f]
            if wp.length(p - vec3(ball[0], ball[1], ball[2])) - ball[3] < least:
                _values, c, _n = closest.nearest(p, b, f, 6, faces, x_in)
                away = wp.length(p - c)
                if away < least:
                    least = away
                    nearest = f
        depth_out[i] = least
        face_out[i] = nearest

    return SimpleNamespace(surface=surface, volume=volume, depth=depth, vec3=vec3, vec4=vec4, mat33=mat33, sdf=probe)
