"""What a sensor's vertices swept, as the continuous VSF sees it: forces that are linear in the stiffness at known
points (Neural VSF eq. 5).

    f(t) = sum_i K(p_i) c_i,   p_i = v(tau_i),   c_i = -(v(t) - v(tau_i)) s(tau_i) . dv(tau_i)

with v the way of a vertex and s its oriented area. `VertexForces` are the papers' observations, one a touch, frame and
vertex. `TotalForces` are the pressure-only baseline: one a touch and frame, the sum over all vertices along an axis; a
rigid probe's surface and force sensor give them, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from vsfsim.core.errors import VsfError
from vsfsim.vsf.fields.palpation import DenseTouch, oriented_areas


@dataclass(frozen=True)
class TotalTouch:
    """One touch of a surface whose force is known in total only. vertices: world (T, N, 3) [m]. triangles: wound
    outwards (m, 3). axis: unit (3,) [-].
    force: of the object on the surface against the axis (T,) [N]; NaN where there is no reading."""

    vertices: np.ndarray
    triangles: np.ndarray
    axis: np.ndarray
    force: np.ndarray


@dataclass(frozen=True)
class _Ways:
    """Touches side by side, the shorter ones padded with their last frame. place, area: (K, T, N, 3)."""

    place: torch.Tensor
    area: torch.Tensor

    @classmethod
    def of(cls, touches: Sequence[DenseTouch] | Sequence[TotalTouch], device: str) -> _Ways:
        if len({t.vertices.shape[1] for t in touches}) != 1:
            raise VsfError("vsf.swept: the touches have surfaces of different numbers of vertices; they must be of "
                           "one sensor.")
        longest = max(len(t.vertices) for t in touches)

        def joined(parts: list[np.ndarray]) -> torch.Tensor:
            return torch.as_tensor(np.stack([np.concatenate([x, np.repeat(x[-1:], longest - len(x), axis=0)])
                                             for x in parts]), dtype=torch.float32, device=device)

        return cls(joined([t.vertices for t in touches]),
                   joined([oriented_areas(t.vertices, t.triangles) for t in touches]))

    def pieces(self, touch: torch.Tensor, frame: torch.Tensor, vertex: torch.Tensor,
               samples: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Middles p (b, S, 3) [m] and c (b, S, 3) [m^4] of the ways from frame 0 to ``frame``, cut into S pieces of
        equal time."""
        grid = torch.linspace(0.0, 1.0, samples + 1, device=self.place.device)
        ends = _along(self.place, touch, frame[:, None] * grid, vertex)
        points = 0.5 * (ends[:, 1:] + ends[:, :-1])
        middle = _along(self.area, touch, frame[:, None] * (0.5 * (grid[1:] + grid[:-1])), vertex)
        volume = (middle * (ends[:, 1:] - ends[:, :-1])).sum(dim=2)
        return points, -(ends[:, -1:] - points) * volume[..., None]


@dataclass(frozen=True)
class VertexForces:
    """All (touch, frame, vertex) of some touches. index: of every observation (M, 3). force: (M, 3) [N]."""

    ways: _Ways
    index: torch.Tensor
    force: torch.Tensor

    @classmethod
    def of(cls, touches: Sequence[DenseTouch], *, device: str = "cpu") -> VertexForces:
        """From touches; frame 0 has no way behind it and is left out, as are frames whose forces are NaN as a whole.

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
        return cls(_Ways.of(touches, device), torch.as_tensor(np.concatenate(index), device=device),
                   torch.as_tensor(np.concatenate(force), dtype=torch.float32, device=device))

    def rows(self, which: torch.Tensor, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Points (b, S, 3) [m], factors (b, S, 3) [m^4] and forces (b, 3) [N] of observations ``which``: f = sum_S
        K(point) factor."""
        touch, frame, vertex = self.index[which].T
        points, factor = self.ways.pieces(touch, frame, vertex, samples)
        return points, factor, self.force[which]

    def cost(self) -> int:
        """Samples of one observation, in units of ``samples``."""
        return 1


@dataclass(frozen=True)
class TotalForces:
    """All (touch, frame) of some touches. index: of every observation (M, 2). force: (M, 1) [N]. axis: of each touch
    (K, 3)."""

    ways: _Ways
    index: torch.Tensor
    force: torch.Tensor
    axis: torch.Tensor

    @classmethod
    def of(cls, touches: Sequence[TotalTouch], *, device: str = "cpu") -> TotalForces:
        """From touches; frame 0 and frames without a reading are left out.

        Raises:
            VsfError: no touch, or no reading behind frame 0.
        """
        pairs = [(k, t) for k, touch in enumerate(touches) for t in 1 + np.flatnonzero(np.isfinite(touch.force[1:]))]
        if not pairs:
            raise VsfError(f"vsf.neural: {len(touches)} touches without a reading that has a way behind it; give "
                           f"touches of at least two frames.")
        tensors = (torch.as_tensor(np.array(x), dtype=kind, device=device) for x, kind in (
            (pairs, torch.int64), ([[touches[k].force[t]] for k, t in pairs],
                                   torch.float32), ([t.axis for t in touches], torch.float32)))
        return cls(_Ways.of(touches, device), *tensors)

    def rows(self, which: torch.Tensor, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Points (b, N S, 3) [m], factors (b, N S, 1) [m^4] and forces (b, 1) [N]."""
        touch, frame = self.index[which].T
        count = self.ways.place.shape[2]
        vertex = torch.arange(count, device=touch.device).repeat(len(touch))
        points, factor = self.ways.pieces(touch.repeat_interleave(count), frame.repeat_interleave(count), vertex,
                                          samples)
        along = -(factor * self.axis[touch].repeat_interleave(count, dim=0)[:, None]).sum(dim=2, keepdim=True)
        return points.reshape(len(touch), -1, 3), along.reshape(len(touch), -1, 1), self.force[which]

    def cost(self) -> int:
        """Samples of one observation, in units of ``samples``."""
        return int(self.ways.place.shape[2])


def _along(values: torch.Tensor, touch: torch.Tensor, time: torch.Tensor, vertex: torch.Tensor) -> torch.Tensor:
    """Values (K, T, N, 3) of vertices (b,) of touches (b,) at fractional frames (b, S): (b, S, 3)."""
    low = time.floor().long().clamp(0, values.shape[1] - 2)
    part = (time - low)[..., None]
    return (1.0 - part) * values[touch[:, None], low, vertex[:,
                                                             None]] + part * values[touch[:, None], low + 1,
                                                                                    vertex[:, None]]
