"""From the shape a scene names to a volume of corner tetrahedra."""

from __future__ import annotations

import functools
import math

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import ObjectSpec
from vsfsim.core.shape import Box, Cylinder, Family, MeshFile, Rod, Sphere, extent
from vsfsim.core.shelf import family
from vsfsim.core.solid import Solid
from vsfsim.physics.mesh import structured as blocks


def build_solid(spec: ObjectSpec, *, resolution: float, rng: np.random.Generator | None = None,
                focus: np.ndarray | None = None, parts: np.ndarray | None = None) -> Solid:
    """Fill an object with positively oriented tetrahedra, in its own frame.

    Args:
        spec: the object; only its shape is read.
        resolution: target edge length [m].
        rng: stream from which a family draws its materials and look; None is a stream of seed 0.
        focus: points (k, 3) [m] in the object's frame near which a box keeps ``resolution`` while it
            coarsens up to 3x elsewhere; other shapes ignore it.
        parts: low and high corners of boxes inside (p, 2, 3) [m] in the object's frame, whose faces become faces of the
            elements of a box, and whose tops and bottoms those of a cylinder; other shapes ignore them.

    Raises:
        SceneError: an unknown family, bad family parameters, or a resolution that gives too many cells.
        MeshError: a mesh file that cannot be read, repaired or filled.
    """
    shape = spec.shape
    if not (math.isfinite(resolution) and resolution > 0.0):
        raise SceneError(f"resolution is {resolution!r}; it must be an edge length in metres, greater than 0.")
    if isinstance(shape, MeshFile):
        # scan imports trimesh, which a box does not need
        from vsfsim.physics.mesh.scan import fill_mesh_file
        return fill_mesh_file(shape, resolution=resolution)
    if isinstance(shape, Family):
        return _family(shape, resolution, np.random.default_rng(0) if rng is None else rng)
    blocks.check_cells(extent(shape), resolution, "[object]")
    nearest = None
    match shape:
        case Box(size):
            vertices, tets = blocks.box(size, resolution, focus=focus, parts=parts)
        case Sphere(radius):
            vertices, tets = blocks.ball(radius, resolution)
            nearest = functools.partial(blocks.on_round, (0.0, 0.0, radius), (1.0, 1.0, 1.0), radius)
        case Cylinder(radius, height):
            layers = None if parts is None or not len(parts) else parts[:, :, 2]
            vertices, tets = blocks.cylinder(radius, height, resolution, parts=layers)
            nearest = functools.partial(blocks.on_round, (0.0, 0.0, 0.0), (1.0, 1.0, 0.0), radius)
        case Rod(length, radius):
            vertices, tets = blocks.rod(length, radius, resolution)
            nearest = functools.partial(blocks.on_round, (0.0, 0.0, radius), (0.0, 1.0, 1.0), radius)
        case _:
            raise AssertionError(shape)
    return Solid(vertices, tets, np.zeros(len(tets), np.int64), ("body",), nearest=nearest)


def _family(shape: Family, resolution: float, rng: np.random.Generator) -> Solid:
    module = family(shape.name, "[object] shape")
    if not hasattr(module, "build"):
        raise SceneError(f"[object] shape: the family '{shape.name}' is a plant, made of beams and touched by an "
                         f"[arm]; it is no solid body that can be pressed. Use `vsfsim generate`.")
    return module.build(shape.parameters, rng, resolution=resolution, where=f"[object] shape family '{shape.name}'")
