"""A set of rigid shapes: a struct of arrays for the contact kernels, and distances and sizes for the host.

Poses are not part of it: each frame gives one pose for each shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.core.shape import MeshFile, ProbeShape
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.kernels import bound
from vsfsim.physics.runtime import mat33, real, vec3


class RigidBodies:
    """K rigid shapes, each in a frame of its own.

    Args:
        shapes: the shapes (K), or one.

    Raises:
        MeshError: a mesh cannot be read or closed.
    """

    notes: tuple[str, ...]
    """What was repaired or decided for their meshes."""

    def __init__(self, shapes: ProbeShape | Sequence[ProbeShape]):
        self.shapes: tuple[ProbeShape, ...] = tuple(shapes) if isinstance(shapes, Sequence) else (shapes,)
        self.notes = tuple(dict.fromkeys(note for s in self.shapes if isinstance(s, MeshFile)
                                         for note in sdf.grid(s).notes))
        self._on: dict[str, Any] = {}

    def __len__(self) -> int:
        return len(self.shapes)

    def distance(self, k: int, points: np.ndarray) -> np.ndarray:
        """Signed distance (...,) [m] of ``points`` (..., 3) in the frame of body ``k``; as the kernels' `gap`."""
        return sdf.distance(self.shapes[k], points)

    @property
    def reaches(self) -> np.ndarray:
        """As `sdf.reach` of each body (K,) [m]."""
        return np.array([sdf.reach(shape) for shape in self.shapes])

    def nearest(self, poses: np.ndarray, points: torch.Tensor, *, body: int | None = None) -> torch.Tensor:
        """Least gap (s, B) [m] of points (s, 1 or B, 3) over the poses (T, B, K, 4, 4), to one ``body`` or to all, on
        the device of the points."""
        first, end = (0, len(self)) if body is None else (body, body + 1)
        origin, turn = (torch.as_tensor(np.ascontiguousarray(a), device=points.device)
                        for a in (poses[..., :3, 3], poses[..., :3, :3]))
        out = torch.empty((len(points), origin.shape[1]), dtype=torch.float64, device=points.device)
        device = str(points.device)
        wp.launch(least_gap, dim=out.shape, device=device, inputs=[
            self.on(device), first, end, wp.from_torch(origin, dtype=vec3), wp.from_torch(turn, dtype=mat33),
            wp.from_torch(points.contiguous(), dtype=vec3), wp.from_torch(out)])
        return out

    def on(self, device: str) -> Any:
        """The struct `sdf.Bodies` on ``device``, made once.

        Memory: 8 (float64) or 4 bytes a grid node, a few megabytes a mesh; the same mesh twice is stored once.
        """
        if device in self._on:
            return self._on[device]
        grids = [sdf.grid(s) if isinstance(s, MeshFile) else None for s in self.shapes]
        different = {id(g): g for g in grids if g is not None}
        ends = np.cumsum([0, *(g.coefficients.size for g in different.values())])
        starts = dict(zip(different, ends, strict=False))

        def of(value: Any, default: Any) -> np.ndarray:
            return np.array([default if g is None else value(g) for g in grids])

        kinds, sizes = zip(*(sdf.encode(s) for s in self.shapes), strict=True)
        columns = {
            "kind": np.array(kinds), "size": np.array(sizes), "start": of(lambda g: starts[id(g)], 0),
            "nodes": of(lambda g: g.coefficients.shape, (0, 0, 0)), "spacing": of(lambda g: g.spacing, 1.0),
            "origin": of(lambda g: g.origin, np.zeros(3)),
            "coefficients": np.concatenate([np.zeros(0), *(g.coefficients.ravel() for g in different.values())])}
        self._on[device] = bound(sdf.Bodies, columns, (), device)[0]
        return self._on[device]


@wp.kernel(module="vsfsim_intrusion", enable_backward=False)
def least_gap(
    # model
    bodies: sdf.Bodies,
    first: int,
    count: int,
    # state in
    origin: wp.array3d(dtype=vec3),
    turn: wp.array3d(dtype=mat33),
    x_in: wp.array2d(dtype=vec3),
    # state out
    gap_out: wp.array2d(dtype=real),
):
    # least gap of every point over all poses (T, B, K) and the bodies first to count - 1; x_in (s, 1) serves all
    # touches, (s, B) each one
    i, b = wp.tid()
    p = x_in[i, wp.min(b, x_in.shape[1] - 1)]
    least = real(1e30)
    for t in range(origin.shape[0]):
        for j in range(first, count):
            least = wp.min(least, sdf.gap(bodies, j, wp.transpose(turn[t, b, j]) * (p - origin[t, b, j])))
    gap_out[i, b] = least
