"""The line integrals of the continuous VSF: forces on a sensor's vertices, linear in the stiffness at known points
(Neural VSF eq. 5).

    f(t) = sum_i K(p_i) c_i,   p_i = v(tau_i),   c_i = -(v(t) - v(tau_i)) s(tau_i) . dv(tau_i)

with v the path of a vertex and s its oriented area. `VertexForces` are the papers' observations, one for each touch,
frame and vertex. `TotalForces` are the pressure-only baseline, one for each touch and frame: the sum over all vertices
along an axis, which a rigid probe's surface and force sensor give as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from vsfsim.core.errors import VsfError
from vsfsim.physics.mesh.structured import disc


@dataclass(frozen=True)
class DenseTouch:
    """One touch of a sensor with a surface."""

    vertices: np.ndarray
    """World positions of the surface's vertices (T, N, 3) [m]."""
    triangles: np.ndarray
    """Corners, wound outwards (m, 3)."""
    force: np.ndarray
    """Force of the object on each vertex, world (T, N, 3) [N]."""


def dome(*, radius: float = 0.03, height: float = 0.015, rings: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """A cap of a ball, apex down at the origin: vertices (N, 3) [m] and triangles (m, 3) wound outwards (down).

    Args:
        radius: of its rim [m].
        height: of the rim over the apex [m].
        rings: of vertices; N = 1 + 3 rings (rings + 1).
    """
    ball = (radius**2 + height**2) / (2.0 * height)
    flat, triangles = disc(radius, rings)
    ring = np.repeat(np.arange(rings + 1), [1, *(6 * np.arange(1, rings + 1))])
    above = ball - np.sqrt(ball**2 - (radius * ring / rings) ** 2)
    return np.column_stack([flat, above]), np.ascontiguousarray(triangles[:, ::-1])


def oriented_areas(vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """A third of the area vectors of the triangles around each vertex (..., N, 3) [m^2] (Neural VSF section III-D)."""
    a, b, c = (vertices[..., triangles[:, k], :] for k in range(3))
    area = np.cross(b - a, c - a) / 6.0
    out = np.zeros_like(vertices)
    flat, given = out.reshape(-1, *vertices.shape[-2:]), area.reshape(-1, *area.shape[-2:])
    for frame, part in zip(flat, given):
        for k in range(3):
            np.add.at(frame, triangles[:, k], part)
    return out


@dataclass(frozen=True)
class TotalTouch:
    """One touch of a surface whose force is known in total only."""

    vertices: np.ndarray
    """World positions (T, N, 3) [m]."""
    triangles: np.ndarray
    """Corners, wound outwards (m, 3)."""
    axis: np.ndarray
    """Unit vector (3,) [-]."""
    force: np.ndarray
    """Force of the object on the surface against the axis (T,) [N]; NaN where there is no reading."""


@dataclass(frozen=True)
class _Paths:
    """Touches side by side, the shorter ones padded with their last frame."""

    place: torch.Tensor
    """Positions of the vertices (K, T, N, 3) [m]."""
    area: torch.Tensor
    """Their oriented areas (K, T, N, 3) [m^2]."""

    @classmethod
    def of(cls, touches: Sequence[DenseTouch] | Sequence[TotalTouch], device: str) -> _Paths:
        if len({t.vertices.shape[1] for t in touches}) != 1:
            raise VsfError("vsf.line_integrals: the touches have surfaces of different numbers of vertices; they must "
                           "be of one sensor.")
        longest = max(len(t.vertices) for t in touches)

        def joined(parts: list[np.ndarray]) -> torch.Tensor:
            return torch.as_tensor(np.stack([np.concatenate([x, np.repeat(x[-1:], longest - len(x), axis=0)])
                                             for x in parts]), dtype=torch.float32, device=device)

        return cls(joined([t.vertices for t in touches]),
                   joined([oriented_areas(t.vertices, t.triangles) for t in touches]))

    def pieces(self, touch: torch.Tensor, frame: torch.Tensor, vertex: torch.Tensor,
               samples: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Midpoints p (b, S, 3) [m] and factors c (b, S, 3) [m^4] of the paths from frame 0 to ``frame``, in S pieces
        of equal time."""
        grid = torch.linspace(0.0, 1.0, samples + 1, device=self.place.device)
        ends = _along(self.place, touch, frame[:, None] * grid, vertex)
        points = 0.5 * (ends[:, 1:] + ends[:, :-1])
        middle = _along(self.area, touch, frame[:, None] * (0.5 * (grid[1:] + grid[:-1])), vertex)
        volume = (middle * (ends[:, 1:] - ends[:, :-1])).sum(dim=2)
        return points, -(ends[:, -1:] - points) * volume[..., None]


@dataclass(frozen=True)
class VertexForces:
    """Forces on the vertices of some touches."""

    paths: _Paths
    """Of all touches."""
    index: torch.Tensor
    """Touch, frame and vertex of every observation (M, 3)."""
    force: torch.Tensor
    """(M, 3) [N]."""

    @classmethod
    def of(cls, touches: Sequence[DenseTouch], *, device: str = "cpu") -> VertexForces:
        """From touches, without frame 0, where a path has no length, and without frames whose forces are all NaN.

        Raises:
            VsfError: no touch, fewer than two frames, or values that are not finite.
        """
        if not touches:
            raise VsfError("vsf.neural: there is no touch with contact forces on a surface; a rigid force sensor "
                           "cannot be used here.")
        index, force = [], []
        for k, touch in enumerate(touches):
            known = ~np.isnan(touch.force).all(axis=(1, 2)) if touch.force.ndim == 3 else np.zeros(0, bool)
            if (touch.vertices.shape != touch.force.shape or len(touch.force) < 2 or not known[1:].any()
                or not (np.isfinite(touch.vertices).all() and np.isfinite(touch.force[known]).all())):
                raise VsfError(f"vsf.neural: touch {k} has vertices {touch.vertices.shape} and forces "
                               f"{touch.force.shape}; both must be finite and (T, N, 3) with T of at least 2.")
            count = touch.force.shape[1]
            t, v = (x.ravel() for x in np.meshgrid(1 + np.flatnonzero(known[1:]), np.arange(count), indexing="ij"))
            index.append(np.stack([np.full(t.size, k), t, v], axis=1))
            force.append(touch.force[t, v])
        return cls(_Paths.of(touches, device), torch.as_tensor(np.concatenate(index), device=device),
                   torch.as_tensor(np.concatenate(force), dtype=torch.float32, device=device))

    def rows(self, which: torch.Tensor, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Points (b, S, 3) [m], factors (b, S, 3) [m^4] and forces (b, 3) [N] of observations ``which`` (b,); f is the
        sum over S of K(point) factor."""
        touch, frame, vertex = self.index[which].T
        points, factor = self.paths.pieces(touch, frame, vertex, samples)
        return points, factor, self.force[which]

    def cost(self) -> int:
        """Samples of one observation, in units of ``samples``."""
        return 1


@dataclass(frozen=True)
class TotalForces:
    """Total forces of some touches."""

    paths: _Paths
    """Of all touches."""
    index: torch.Tensor
    """Touch and frame of every observation (M, 2)."""
    force: torch.Tensor
    """(M, 1) [N]."""
    axis: torch.Tensor
    """Axis of each touch (K, 3)."""

    @classmethod
    def of(cls, touches: Sequence[TotalTouch], *, device: str = "cpu") -> TotalForces:
        """From touches, without frame 0 and frames without a reading.

        Raises:
            VsfError: no touch, or no reading after frame 0.
        """
        pairs = [(k, t) for k, touch in enumerate(touches) for t in 1 + np.flatnonzero(np.isfinite(touch.force[1:]))]
        if not pairs:
            raise VsfError(f"vsf.neural: {len(touches)} touches without a reading after their first frame; give "
                           f"touches of at least two frames.")
        columns = ((pairs, torch.int64), ([[touches[k].force[t]] for k, t in pairs], torch.float32),
                   ([t.axis for t in touches], torch.float32))
        tensors = (torch.as_tensor(np.array(x), dtype=kind, device=device) for x, kind in columns)
        return cls(_Paths.of(touches, device), *tensors)

    def rows(self, which: torch.Tensor, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Points (b, N S, 3) [m], factors (b, N S, 1) [m^4] and forces (b, 1) [N] of observations ``which`` (b,)."""
        touch, frame = self.index[which].T
        count = self.paths.place.shape[2]
        vertex = torch.arange(count, device=touch.device).repeat(len(touch))
        points, factor = self.paths.pieces(touch.repeat_interleave(count), frame.repeat_interleave(count), vertex,
                                          samples)
        along = -(factor * self.axis[touch].repeat_interleave(count, dim=0)[:, None]).sum(dim=2, keepdim=True)
        return points.reshape(len(touch), -1, 3), along.reshape(len(touch), -1, 1), self.force[which]

    def cost(self) -> int:
        """Samples of one observation, in units of ``samples``."""
        return int(self.paths.place.shape[2])


def _along(values: torch.Tensor, touch: torch.Tensor, time: torch.Tensor, vertex: torch.Tensor) -> torch.Tensor:
    """Values (K, T, N, 3) of vertices (b,) of touches (b,) at fractional frames (b, S): (b, S, 3)."""
    low = time.floor().long().clamp(0, values.shape[1] - 2)
    part = (time - low)[..., None]
    touch, vertex = touch[:, None], vertex[:, None]
    return (1.0 - part) * values[touch, low, vertex] + part * values[touch, low + 1, vertex]
