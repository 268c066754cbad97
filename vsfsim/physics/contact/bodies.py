"""A set of rigid shapes: a struct of arrays for the contact kernels, and distances and sizes for the host.

Poses are not part of it: each frame gives one pose for each shape.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.shape import MeshFile, ProbeShape
from vsfsim.physics.contact import sdf


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
        if not self.shapes:
            raise ValueError("no rigid shape given")
        self.notes = tuple(dict.fromkeys(note for s in self.shapes if isinstance(s, MeshFile)
                                         for note in sdf.grid(s).notes))

    def __len__(self) -> int:
        return len(self.shapes)

    def distance(self, k: int, points: np.ndarray) -> np.ndarray:
        """Signed distance (...,) [m] of ``points`` (..., 3) in the frame of body ``k``; as the kernels' `gap`."""
        return sdf.distance(self.shapes[k], points)

    @property
    def reaches(self) -> np.ndarray:
        """As `sdf.reach` of each body (K,) [m]."""
        return np.array([sdf.reach(shape) for shape in self.shapes])

    def upload(self, functions: Any, device: str) -> Any:
        """The ``functions.Bodies`` struct on ``device``; ``functions`` are those of `sdf.functions`.

        Memory: 8 (float64) or 4 bytes a grid node, a few megabytes a mesh; the same mesh twice is stored once.
        """
        grids = [sdf.grid(s) if isinstance(s, MeshFile) else None for s in self.shapes]
        different = {id(g): g for g in grids if g is not None}
        ends = np.cumsum([0, *(g.coefficients.size for g in different.values())])
        starts = dict(zip(different, ends, strict=False))
        if ends[-1] >= 2**31:
            raise ValueError("the distance grids of all meshes hold more than 2^31 nodes")

        def of(value: Any, default: Any) -> np.ndarray:
            return np.array([default if g is None else value(g) for g in grids])

        kinds, sizes = zip(*(sdf.encode(s) for s in self.shapes), strict=True)
        columns = {
            "kind": kinds, "size": sizes, "start": of(lambda g: starts[id(g)], 0),
            "nodes": of(lambda g: g.coefficients.shape, (0, 0, 0)), "spacing": of(lambda g: g.spacing, 1.0),
            **{name: of(operator.attrgetter(name), np.zeros(3)) for name in ("origin", "lower", "upper")},
            "coefficients": np.concatenate([np.zeros(0), *(g.coefficients.ravel() for g in different.values())])}
        bodies = functions.Bodies()
        for name, values in columns.items():
            dtype = functions.Bodies.vars[name].type.dtype
            setattr(bodies, name, wp.array(np.array(values), dtype=dtype, device=device))
        return bodies
