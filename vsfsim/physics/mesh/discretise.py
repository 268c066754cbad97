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

LAYERED = {Box: (0, 1, 2), Cylinder: (2,), Rod: (0,)}
"""Axes along which a shape has layers of elements."""
NEAR = 0.1
"""Of an element: a face of the box that holds a body gets no layer of its own where one is nearer [-]."""


def build_solid(spec: ObjectSpec, *, resolution: float, rng: np.random.Generator | None = None,
                focus: np.ndarray | None = None, parts: np.ndarray | None = None) -> Solid:
    """Fill an object with positively oriented tetrahedra, in its own frame.

    Args:
        spec: the object; only its shape is read.
        resolution: target edge length [m].
        rng: stream from which a family draws its materials and look; None is a stream of seed 0.
        focus: points (k, 3) [m] in the object's frame near which a box keeps ``resolution`` while it
            coarsens up to 3x elsewhere; other shapes ignore it.
        parts: low and high corners of boxes inside (p, 2, 3) [m] in the object's frame, whose faces across an axis of
            `LAYERED` become faces of the elements; other shapes ignore them.

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
            if parts is not None and len(parts):
                upright, tets = blocks.cylinder(radius, length, resolution, parts=parts[:, :, 0])
                vertices = upright[:, [2, 0, 1]] + [0.0, 0.0, radius]
            nearest = functools.partial(blocks.on_round, (0.0, 0.0, radius), (0.0, 1.0, 1.0), radius)
        case _:
            raise AssertionError(shape)
    return Solid(vertices, tets, np.zeros(len(tets), np.int64), ("body",), nearest=nearest)


def beside_supports(spec: ObjectSpec, vertices: np.ndarray, resolution: float) -> np.ndarray:
    """What lies beside the box that holds a body, as ``parts`` (p, 2, 3) [m] of `build_solid`, two elements thick and
    more; none where layers of its elements end at the faces of the box. The nodes in the box are held: where a face
    lies between two layers, what is free is longer than the scene says. If one face needs a layer all faces inside the
    body get theirs, as layers move together.

    Args:
        spec: the object, held by a box.
        vertices: of its mesh without these parts (n, 3) [m].
        resolution: of the mesh [m].
    """
    ends = np.array([vertices.min(axis=0), vertices.max(axis=0)])
    faces = np.sort(np.reshape(spec.fixed, (2, 3)), axis=0)
    near = NEAR * np.minimum(resolution, 0.5 * (ends[1] - ends[0]))
    beside, missing = np.array([ends, ends]), False
    for axis in LAYERED.get(type(spec.shape), ()):
        (low, high), (first, last) = ends[:, axis], faces[:, axis]
        for side, face, end, outward in ((0, first, low, -1.0), (1, last, high, 1.0)):
            if min(face - low, high - face, last - first) > near[axis]:
                into = (face - vertices[:, axis]) * outward
                missing |= not ((into >= -1e-9) & (into <= near[axis])).any()
                room = 2.0 * resolution if abs(end - face) > 3.0 * resolution else abs(end - face)
                beside[side, :, axis] = np.sort([face, face + outward * room])
    return beside[missing & (beside != ends).any(axis=(1, 2))]


def _family(shape: Family, resolution: float, rng: np.random.Generator) -> Solid:
    module = family(shape.name, "[object] shape")
    if not hasattr(module, "build"):
        raise SceneError(f"[object] shape: the family '{shape.name}' is a plant, made of beams and touched by an "
                         f"[arm]; it is no solid body that can be pressed. Use `vsfsim generate`.")
    return module.build(shape.parameters, rng, resolution=resolution, where=f"[object] shape family '{shape.name}'")
