"""How deep the two surfaces of a pair lie in one another, between their contact points too: a check by geometry.

Points on a grid over every face of either surface are held against the other body. A point is inside it if it is
behind the nearest face and the solid angles of all faces around it add up to a whole turn; it is then as deep as it is
far from the surface. A membrane is closed by the disk in its rim.
"""

import functools
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import closest_point
from vsfsim.physics.contact.intrusion import rim_disk
from vsfsim.physics.contact.patch import shape_values
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import real, vec3

_DEEP = 0.1  # that depth over the smaller of both element sizes
_SPACING = 0.4  # of the points on a face over the smaller of both element sizes
_STEPS = (3, 16)  # least and most steps of the grid on a face
_MOST_FACES = 96  # faces of the other body that are kept as those that may be close to a face


@dataclass(frozen=True)
class _Surface:
    """One of the two surfaces, its nodes numbered as those of both bodies."""

    faces: torch.Tensor
    """Nodes of its faces (1, F, 3 or 6), int32."""
    disk: wp.array
    """Triangles that close it (d, 3)."""
    grid: wp.array
    """Shape values of the points on a face (s, 6); of a flat face the last three are 0."""


class PairOverlap:
    """The check for an object and a sensor.

    Args:
        model: the object.
        sensor: the body with the touching surface, in its own frame.
        device: Warp device.
    """

    tolerance: float
    """Depth above which one body lies inside the other where no contact point feels it [m]."""

    def __init__(self, model: Model, sensor: Model, *, device: str):
        self.device = device
        self._count = len(model.mesh.points)
        self._rest = torch.as_tensor(np.concatenate([model.mesh.points, sensor.mesh.points]), device=device)
        sizes = model.element_size, sensor.element_size
        self._margin, self.tolerance = max(sizes), _DEEP * min(sizes)
        none = np.zeros((0, 3), np.int32)
        carried = sensor.mesh.faces + self._count
        self._object = self._surface(model.mesh.faces, none, sizes[0] / min(sizes))
        self._sensor = self._surface(carried, rim_disk(carried), sizes[1] / min(sizes))

    def _surface(self, faces: np.ndarray, disk: np.ndarray, ratio: float) -> _Surface:
        steps = int(np.clip(np.ceil(ratio / _SPACING), *_STEPS))
        bary = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
        values = shape_values(bary) if faces.shape[1] == 6 else np.pad(bary, ((0, 0), (0, 3)))
        return _Surface(torch.as_tensor(faces[None].astype(np.int32), device=self.device),
                        wp.array(disk.astype(np.int32).reshape(-1, 3), dtype=wp.int32, device=self.device),
                        wp.array(values, dtype=wp.float64, device=self.device))

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
        count, k = len(columns), kernels()
        x = self._rest + u[:, columns].view(-1, 3, count).permute(2, 0, 1)
        x[:, self._count:] = x[:, self._count:] @ turn.mT + origin
        at = wp.from_torch(x.contiguous(), dtype=k.vec3)
        balls = [closest_point.balls(x, s.faces) for s in (self._sensor, self._object)]
        out = []
        for i, (own, other) in enumerate(((self._sensor, self._object), (self._object, self._sensor))):
            depth = torch.zeros((count, own.faces.shape[1]), dtype=torch.float64, device=self.device)
            near, close = (self._within(balls[j], balls[1 - j]) for j in (i, 1 - i))
            mine, theirs = (wp.from_torch(s.faces.expand(count, -1, -1)) for s in (own, other))
            wp.launch(k.behind, dim=near.shape, device=self.device, inputs=[
                own.faces.shape[2], mine, own.grid, other.faces.shape[2], theirs, other.disk,
                wp.from_torch(near), wp.from_torch(close), self._margin,
                *(wp.from_torch(balls[j], dtype=k.vec4) for j in (i, 1 - i)), at, wp.from_torch(depth)])
            out.append(depth)
        return torch.cat(out, dim=1).amax(dim=1)

    def _within(self, balls: torch.Tensor, others: torch.Tensor) -> torch.Tensor:
        """The faces (k, P) whose ``balls`` (k, F, 4) come within the margin of the box about ``others`` (k, G, 4),
        padded with -1."""
        away = self._margin + balls[:, :, 3:]
        low = (others[:, :, :3] - others[:, :, 3:]).amin(dim=1, keepdim=True)
        high = (others[:, :, :3] + others[:, :, 3:]).amax(dim=1, keepdim=True)
        near = ((balls[:, :, :3] + away > low) & (balls[:, :, :3] - away < high)).all(dim=2)
        on, order = torch.sort(near.to(torch.int8), dim=1, descending=True, stable=True)
        most = max(1, int(near.sum(dim=1).amax()))
        return torch.where(on > 0, order, -1)[:, :most].to(torch.int32).contiguous()


@functools.cache
def kernels() -> Any:
    """The kernels of the check and their types."""
    vec4 = wp.types.vector(length=4, dtype=real)
    module = "vsfsim_pair_overlap"
    closest = closest_point.functions(module)
    most = wp.constant(_MOST_FACES)
    list_t = wp.types.vector(length=_MOST_FACES, dtype=wp.int32)

    @wp.func(module=module)
    def apart(one: vec4, two: vec4):
        # distance from the middle of the first ball to the second ball
        return wp.length(vec3(one[0] - two[0], one[1] - two[1], one[2] - two[2])) - two[3]

    @wp.kernel(module=module, enable_backward=False)
    def behind(
        # model
        nodes: int,
        faces: wp.array3d(dtype=wp.int32),
        grid: wp.array2d(dtype=real),
        other_nodes: int,
        other: wp.array3d(dtype=wp.int32),
        disk: wp.array2d(dtype=wp.int32),
        # state in
        near: wp.array2d(dtype=wp.int32),
        close: wp.array2d(dtype=wp.int32),
        margin: real,
        own_in: wp.array2d(dtype=vec4),
        ball_in: wp.array2d(dtype=vec4),
        x_in: wp.array2d(dtype=vec3),
        # state out
        depth_out: wp.array2d(dtype=real),
    ):
        # depth of the deepest point of a face's grid inside the other body
        b, at = wp.tid()
        f = near[b, at]
        if f < 0:
            return
        own = own_in[b, f]
        # the faces that may be the nearest to some point of this one
        middle = vec3(own[0], own[1], own[2])
        far = margin
        guess = int(-1)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
        for k in range(close.shape[1]):
            g = close[b, k]
            if g >= 0:
                if apart(own, ball_in[b, g]) < far:
                    _v, place, _n = closest.nearest(middle, b, g, other_nodes, other, x_in)
                    away = wp.length(middle - place)
                    if away < far:
                        far = away
                        guess = g
        if guess < 0:
            return
        held = int(0)  # noqa: UP018, RUF046
        beside = list_t()
        for k in range(close.shape[1]):
            g = close[b, k]
            if g >= 0:
                if apart(own, ball_in[b, g]) <= far + real(2.0) * own[3]:
                    if held < most:
                        beside[held] = g
                    held += 1
        count = grid.shape[0]
        if far > own[3]:
            count = 1  # no face of the other body is so close that this one could pass through it
        deepest = real(0.0)
        for s in range(count):
            p = vec3()
            for i in range(nodes):
                p += grid[s, i] * x_in[b, faces[b, f, i]]
            here = vec4(p[0], p[1], p[2], real(0.0))
            _v, place, out = closest.nearest(p, b, guess, other_nodes, other, x_in)
            least = wp.length(p - place)
            height = wp.dot(p - place, out)
            first = guess
            for k in range(wp.where(held > most, close.shape[1], held)):
                g = beside[wp.min(k, most - 1)]
                if held > most:
                    g = close[b, k]
                if g >= 0 and g != first:
                    if apart(here, ball_in[b, g]) < least:
                        _v, place, out = closest.nearest(p, b, g, other_nodes, other, x_in)
                        least, height, guess = closest.nearer(p, place, out, g, least, height, guess)
            if height < real(0.0) and least > deepest and closest.encloses(p, height, least, b, other_nodes, other,
                                                                           disk, x_in):
                deepest = least
        depth_out[b, f] = deepest

    return SimpleNamespace(behind=behind, vec3=vec3, vec4=vec4)
