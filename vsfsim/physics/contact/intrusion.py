"""Whether a rigid body lies inside a deformed object: a check by geometry that knows nothing of the contact points.

Two questions are asked of every touch. How deep do points of the object's boundary lie inside a body, on a fine grid
over every face (the *penetration*)? And how deep do points of a body's surface lie inside the object: behind the
nearest place of the deformed boundary, and as deep as it is away?

A sheet with a rim has no inside. It and a cone from its rim to a point far behind it close a volume. A body in contact
dents the sheet, past the plane of the rim perhaps, and stays outside; one that went through between two equilibria is
inside, where no contact point feels it.
"""

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import body_samples, has_edges, inner_radius
from vsfsim.physics.contact.patch import face_grid, first_of
from vsfsim.physics.contact.sdf import vec4
from vsfsim.physics.elements import closest_point
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import real, vec3

DEEP = 0.05
"""Depth above which a body lies inside the object, over the element size [-]."""
FINE = 0.03
"""Penetration above which a face gets more contact points, over the element size [-]."""
_FINE_SHARP = 0.045  # the same under bodies with edges, whose own points act by then, see `body_points`
LOST = 4.0
"""Times that tolerance: a body in contact that is deeper inside has been lost [-]."""
_SMALL = 0.25  # the same over the inner radius of the smallest body
_SPACING = 0.5  # of a body's samples over the element size, and over the inner radius of the body
_SHEET = 0.1  # `DEEP` of a sheet
_FAR = 2.0  # way of the tip of the cone behind the rim of a sheet, over the rim's width
_BULGE = 1.5  # of the ball about the nodes of a quadratic face, which bulges beyond them
_GRID = (6, 20)  # least and most steps of the grid on a face
# of two soft bodies: that depth, and the spacing of the points on a face, over the smaller of both element sizes
_DEEP_PAIR, _SPACING_PAIR, _GRID_PAIR = 0.1, 0.4, (3, 16)


def _balls(x: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Balls about the ``faces`` (1, F, 3 or 6) with nodes at x (k, n, 3) [m]: middles and radii (k, F, 4) [m]."""
    corner = x[:, faces[0].long()]
    middle = corner.mean(dim=2)
    radius = (corner - middle[:, :, None]).norm(dim=3).amax(dim=2)
    return torch.cat([middle, (_BULGE if faces.shape[2] == 6 else 1.0) * radius[:, :, None]], dim=2).contiguous()


class Enclosure:
    """A closed surface, and how deep points lie inside it.

    Args:
        faces: its triangles of three or six nodes, wound outwards (F, 3 or 6).
        closing: flat triangles (d, 3) that close it where it is a sheet; depth is not measured from them.
        device: Warp device.
    """

    def __init__(self, faces: np.ndarray, closing: np.ndarray, *, device: str):
        self.device, self.faces = device, torch.as_tensor(faces[None].astype(np.int32), device=device)
        self._closing = wp.array(closing.reshape(-1, 3), dtype=wp.int32, device=device)
        self._nodes = torch.as_tensor(np.union1d(faces, closing).astype(np.int64), device=device)

    def depth(self, x: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Depths (k, m) [m] of ``points`` (k, m, 3) [m] inside the surface with the nodes at x (k, n, 3) [m], 0
        outside, and the nearest face of each that is inside (k, m), int32, 0 for the others."""
        depth, face, *_ = self.nearest(x, points, torch.zeros_like(points), near=0.0, facing=1.0)
        return depth, torch.where(depth > 0.0, face, 0)

    def nearest(self, x: torch.Tensor, points: torch.Tensor, outward: torch.Tensor, *, near: float,
                facing: float) -> tuple[torch.Tensor, ...]:
        """The depths of `depth`; the nearest face of each point (k, m), int32, with a normal whose cosine with its
        direction ``outward`` (k, m, 3) is below ``facing``, -1 where another one is nearer to a point outside and for
        points further than ``near`` [m] outside the box about the surface; the shape values of the place on it (k, m,
        6), and its outward normal (k, m, 3)."""
        count = len(x)
        depth, *more = (points.new_zeros((*points.shape[:2], *size)) for size in ((), (6,), (3,)))
        face = torch.full(depth.shape, -1, dtype=torch.int32, device=self.device)
        if not points.shape[1]:  # a plane has none
            return depth, face, *more
        own = x[:, self._nodes]
        low, high = (wp.from_torch(v.contiguous(), dtype=vec3)
                     for v in (own.amin(dim=1) - near, own.amax(dim=1) + near))
        wp.launch(nearest_faces, dim=depth.shape, device=self.device, inputs=[
            self.faces.shape[2], wp.from_torch(self.faces.expand(count, -1, -1)), self._closing, near or 1e30, facing,
            wp.from_torch(points.contiguous(), dtype=vec3), wp.from_torch(outward.contiguous(), dtype=vec3), low, high,
            wp.from_torch(_balls(x, self.faces), dtype=vec4), wp.from_torch(x.contiguous(), dtype=vec3),
            wp.from_torch(depth), wp.from_torch(face), wp.from_torch(more[0], dtype=closest_point.vec6),
            wp.from_torch(more[1], dtype=vec3)])
        return depth, face, *more


class Intrusion:
    """The check for one object and its bodies.

    Args:
        mesh: quadratic tetrahedra, or the triangles of a sheet, wound outwards, whose rim lies in a plane.
        bodies: the rigid bodies (K).
        size: element size [m].
        device: Warp device.
        sinks: how deep bodies sink in locally by `local_indentation`, over the element size [-]. The elements do not
            show it, so that bodies may lie so much deeper inside.
        steps: of the grid on a face at the least.
    """

    tolerance: float
    """Depth above which a body counts as inside the object [m]."""
    fine: float
    """Penetration of a face above which it gets more contact points [m]."""

    def __init__(self, mesh: QuadraticMesh, bodies: RigidBodies, size: float, *, device: str, sinks: float = 0.0,
                 steps: int = _GRID[0]):
        self.device, solid, radii = device, mesh.faces.shape[1] == 6, [inner_radius(s) for s in bodies.shapes]
        small = min(radii)
        self.tolerance = min((DEEP if solid else _SHEET) * size + sinks * size, _SMALL * small)
        sharp = any(has_edges(s) for s in bodies.shapes)
        self.fine = (_FINE_SHARP if sharp else FINE) / DEEP * self.tolerance
        cone, tip = (np.zeros((0, 3)), np.zeros((0, 3))) if solid else rim_cone(mesh.faces, mesh.points)
        self._bodies, self._surface = bodies, Enclosure(mesh.faces, cone, device=device)
        # of a sheet a body that went through has most of its points behind it
        samples = [body_samples(s, _SPACING * (min(size, r) if solid else r))
                   for s, r in zip(bodies.shapes, radii, strict=True)]
        self._samples, self._owner = np.concatenate(samples), np.repeat(np.arange(len(samples)), [*map(len, samples)])
        steps = int(np.clip(np.ceil(3.0 * size / small), steps, _GRID[1])) if solid and np.isfinite(small) else steps
        self._grid, self._faces, self._rest, self._tip = (torch.as_tensor(a, device=device) for a in (
            face_grid(steps, mesh.faces.shape[1]), mesh.faces.astype(np.int64), mesh.points, tip))

    def check(self, columns: torch.Tensor, pose: np.ndarray, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """How far bodies and object lie in one another.

        Args:
            columns: touches (k,).
            pose: poses (B, K, 4, 4).
            u: displacements (3 n, B) [m].

        Returns:
            Depth of the deepest point of each boundary face inside a body (k, F) [m], and of the deepest point of a
            body inside the object that is nearest to each face (k, F) [m].
        """
        count, here = len(columns), pose[columns.cpu().numpy()]
        x = self._rest + u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        faces = x.new_zeros(count, len(self._faces))
        # the grid of those faces that a body may reach, padded to the most of any touch
        ball = _balls(x, self._surface.faces)
        reached = self._bodies.nearest(here[None], ball[:, :, :3].transpose(0, 1)).T < ball[:, :, 3]
        if (at := first_of(reached)).shape[1]:
            corners = x[torch.arange(count, device=self.device)[:, None, None], self._faces[at]]
            gap = self._bodies.nearest(here[None], (self._grid @ corners).flatten(1, 2).transpose(0, 1))
            faces.scatter_(1, at, (-gap.T.view(*at.shape, -1).amin(dim=2)).clamp(min=0.0))
        closed = torch.cat([x, self._tip.expand(count, -1, -1)], dim=1)
        own = here[:, self._owner]
        places = np.einsum("kmij,mj->kmi", own[..., :3, :3], self._samples) + own[..., :3, 3]
        depth, face = self._surface.depth(closed, torch.as_tensor(places, device=self.device))
        return faces, torch.zeros_like(faces).scatter_reduce(1, face.long(), depth, "amax")


class PairOverlap:
    """How deep the two surfaces of an object and a sensor lie in one another, between their contact points too: points
    on a grid over every face of either surface are held against the other body. A membrane is closed by the disk in
    its rim.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame.
        device: Warp device.
    """

    tolerance: float
    """Depth above which one body lies inside the other where no contact point feels it [m]."""

    def __init__(self, model: Model, sensor: Model, *, device: str):
        self._count = len(model.mesh.points)
        self._rest = torch.as_tensor(np.concatenate([model.mesh.points, sensor.mesh.points]), device=device)
        sizes = model.element_size, sensor.element_size
        self.tolerance = _DEEP_PAIR * min(sizes)
        carried = sensor.mesh.faces + self._count
        self._surfaces = (Enclosure(model.mesh.faces, np.zeros((0, 3)), device=device),
                          Enclosure(carried, rim_disk(carried), device=device))
        steps = np.clip(np.ceil(np.array(sizes) / min(sizes) / _SPACING_PAIR), *_GRID_PAIR).astype(int)
        self._grids = [torch.as_tensor(face_grid(n, surface.faces.shape[2]), device=device)
                       for n, surface in zip(steps, self._surfaces, strict=True)]

    def check(self, columns: torch.Tensor, turn: torch.Tensor, origin: torch.Tensor,
              u: torch.Tensor) -> torch.Tensor:
        """How deep the surfaces lie in one another.

        Args:
            columns: touches (k,).
            turn, origin: rotations (k, 3, 3) [-] and origins (k, 1, 3) [m] of the sensor in the world.
            u: displacements (3 n, B) [m], the object's in the world, then the sensor's in its frame.

        Returns:
            Depth of the deepest point of either surface inside the other body (k,) [m].
        """
        count = len(columns)
        x = self._rest + u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        x[:, self._count:] = x[:, self._count:] @ turn.mT + origin
        balls = [_balls(x, surface.faces) for surface in self._surfaces]
        touch, out = torch.arange(count, device=x.device)[:, None, None], x.new_zeros(count)
        for own, other, grid, ball, around in zip(self._surfaces, self._surfaces[::-1], self._grids, balls,
                                                  balls[::-1], strict=True):
            # faces that come near the box about the other surface, padded to the most of any touch
            low = (around[:, :, :3] - around[:, :, 3:]).amin(dim=1, keepdim=True)
            high = (around[:, :, :3] + around[:, :, 3:]).amax(dim=1, keepdim=True)
            near = ((ball[:, :, :3] + ball[:, :, 3:] > low) & (ball[:, :, :3] - ball[:, :, 3:] < high)).all(dim=2)
            if (at := first_of(near)).shape[1]:
                points = grid @ x[touch, own.faces[0].long()[at]]
                out = torch.maximum(out, other.depth(x, points.flatten(1, 2))[0].amax(dim=1))
        return out


def rim_cone(faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles (d, 3) that close a sheet of triangles (f, 3) at ``points`` (n, 3) [m] behind its rim, none if it has
    no rim, and their common point (1, 3) [m], which has the number n."""
    disk = rim_disk(faces)
    ring = points[disk[:, 1]] if len(disk) else points[:1]
    a, b, c = (points[faces[:, k]] for k in range(3))
    outward = np.cross(b - a, c - a).sum(axis=0)
    far = _FAR * np.linalg.norm(np.ptp(ring, axis=0)) / max(float(np.linalg.norm(outward)), 1e-300)
    disk[:, 0] = len(points)
    return disk, (ring.mean(axis=0) - far * outward)[None]


def rim_disk(faces: np.ndarray) -> np.ndarray:
    """Triangles (d, 3) that close a sheet of triangles (f, 3) along its rim; none if it has no rim."""
    edges = np.concatenate([faces[:, [i, (i + 1) % 3]] for i in range(3)]).tolist()
    there = {(a, b) for a, b in edges}
    rim = [(a, b) for a, b in edges if (b, a) not in there]
    return np.array([(rim[0][0], b, a) for a, b in rim], np.int32).reshape(-1, 3)


@wp.kernel(module="vsfsim_intrusion", enable_backward=False)
def nearest_faces(
    # model
    nodes: int,
    faces: wp.array3d(dtype=wp.int32),
    closing: wp.array2d(dtype=wp.int32),
    near: real,
    facing: real,
    # state in
    point: wp.array2d(dtype=vec3),
    outward: wp.array2d(dtype=vec3),
    low: wp.array(dtype=vec3),
    high: wp.array(dtype=vec3),
    ball_in: wp.array2d(dtype=vec4),
    x_in: wp.array2d(dtype=vec3),
    # state out
    depth_out: wp.array2d(dtype=real),
    face_out: wp.array2d(dtype=wp.int32),
    values_out: wp.array2d(dtype=closest_point.vec6),
    normal_out: wp.array2d(dtype=vec3),
):
    # the depth, the nearest face to which `outward` has a cosine below `facing`, and the place on it
    b, s = wp.tid()
    p = point[b, s]
    for i in range(3):
        if p[i] < low[b][i] or p[i] > high[b][i]:
            return
    least = near
    least_facing = near
    most = real(1e30)  # that the nearest face is away at most
    for f in range(wp.where(facing < real(1.0), 0, faces.shape[1])):
        ball = ball_in[b, f]
        most = wp.min(most, wp.length(p - vec3(ball[0], ball[1], ball[2])) + ball[3])
    height = real(0.0)
    known = int(0)  # noqa: UP018, RUF046  Warp variables, not constants: they change in a loop
    face = int(-1)  # noqa: UP018, RUF046
    for f in range(faces.shape[1]):
        ball = ball_in[b, f]
        if wp.length(p - vec3(ball[0], ball[1], ball[2])) - ball[3] < wp.min(least_facing, most):
            v, c, n = closest_point.nearest(p, b, f, nodes, faces, x_in)
            if wp.length(p - c) < least_facing and wp.dot(n, outward[b, s]) < facing:
                least_facing = wp.length(p - c)
                face = f
                values_out[b, s] = v
                normal_out[b, s] = n
            least, height, known = closest_point.nearer(p, c, n, f, least, height, known)
    if height < real(0.0) and closest_point.encloses(p, height, least, b, nodes, faces, closing, x_in):
        depth_out[b, s] = least
    elif least < least_facing:  # outside the object, beside a face that `outward` does not meet
        face = -1
    face_out[b, s] = face
