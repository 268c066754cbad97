"""What a camera looks at: a triangle mesh with the appearance of its material."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.errors import VsfsimError, one_of
from vsfsim.core.solid import TEXTURES, Appearance


class RenderError(VsfsimError):
    """A picture cannot be made: the surface or the camera is not valid, or the renderer is not installed."""


@dataclass(frozen=True)
class Surface:
    """A triangle mesh and the appearance of each of its regions."""

    vertices: np.ndarray
    """Positions in the world (n, 3) [m]."""
    triangles: np.ndarray
    """Vertex indices, wound outwards (f, 3)."""
    region: np.ndarray
    """Region of each triangle, an index into the appearance's arrays (f,)."""
    appearance: Appearance | None
    """Look of each region; None for plain grey."""
    rest_vertices: np.ndarray
    """The same vertices undeformed, in the object's frame (n, 3) [m]; textures are defined there, so that they move
    with the material."""


def flat_coloured(vertices: np.ndarray, triangles: np.ndarray, colour: np.ndarray,
                  rest_vertices: np.ndarray | None = None) -> Surface:
    """A surface without texture, one sRGB colour for each triangle.

    Args:
        vertices: (n, 3) [m].
        triangles: (f, 3).
        colour: sRGB from 0 to 1 (f, 3).
        rest_vertices: undeformed vertices (n, 3) [m]; default: ``vertices``.
    """
    shades, region = np.unique(np.rint(colour * 255).astype(int), axis=0, return_inverse=True)
    count = len(shades)
    look = Appearance((shades / 255.0) ** 2.2, ("plain",) * count, np.ones(count), np.zeros(count))  # linear light
    return Surface(vertices, triangles, region.reshape(-1), look, vertices if rest_vertices is None else rest_vertices)


def with_rigid(body: Surface, rigid: Sequence[tuple[np.ndarray, np.ndarray]]) -> Surface:
    """A body and rigid bodies in grey as one surface.

    Args:
        body: with an appearance.
        rigid: vertices (v, 3) [m] and triangles (g, 3) of each rigid body, in the body's frame.
    """
    look = body.appearance
    assert look is not None
    if not rigid:
        return body
    placed, faces = zip(*rigid, strict=True)
    start = np.cumsum([len(body.vertices), *(len(v) for v in placed)])
    vertices = np.concatenate([body.vertices, *placed])
    triangles = np.concatenate([body.triangles, *(f + s for f, s in zip(faces, start, strict=False))])
    grey = len(look.texture)
    region = np.concatenate([body.region, np.full(sum(len(f) for f in faces), grey)])
    return Surface(vertices, triangles, region,
                   Appearance(np.vstack([look.albedo, [0.35, 0.37, 0.40]]), (*look.texture, "plain"),
                              np.ones(grey + 1), np.zeros(grey + 1)), vertices)


def srgb(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear RGB (..., 3); IEC 61966-2-1."""
    x = np.clip(linear, 0.0, 1.0)
    coded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.rint(255.0 * coded).astype(np.uint8)


def corner_normals(surface: Surface, *, crease: float = 0.7) -> np.ndarray:
    """Unit normals for shading, one a triangle corner (f, 3, 3).

    Each is the area-weighted mean over the triangles at that vertex whose own normal is within ``crease`` [rad] of
    the corner's triangle: round parts look round, edges stay sharp.
    """
    triangles, f = surface.triangles, len(surface.triangles)
    a, b, c = (surface.vertices[triangles[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    unit = area / np.maximum(size, 1e-300)
    # All ordered pairs of corners that share a vertex: corners sorted by vertex, then a block a vertex.
    vertex = triangles.reshape(-1)
    order = np.argsort(vertex, kind="stable")
    count = np.bincount(vertex, minlength=len(surface.vertices))
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    partners = count[vertex]
    first = np.repeat(np.arange(3 * f), partners)
    step = np.arange(len(first)) - np.repeat(np.cumsum(partners) - partners, partners)
    second = order[start[vertex[first]] + step]
    close = np.einsum("ij,ij->i", unit[first // 3], unit[second // 3]) > math.cos(crease)
    first, second = first[close], second[close]
    total = np.stack([np.bincount(first, area[second // 3, k], minlength=3 * f) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    normals = np.where(length > 1e-300, total / np.maximum(length, 1e-300), np.repeat(unit, 3, axis=0))
    return normals.reshape(f, 3, 3)


def checked_surface(surface: Surface) -> Surface:
    """The surface with float64 positions, int32 indices and an appearance.

    Raises:
        RenderError: a vertex that is not finite, or a region or a texture that there is not.
    """
    vertices, triangles = np.asarray(surface.vertices, np.float64), np.asarray(surface.triangles)
    region, rest = np.asarray(surface.region), np.asarray(surface.rest_vertices, np.float64)
    if not (np.isfinite(vertices).all() and np.isfinite(rest).all()):
        raise RenderError("render: the surface has a vertex that is not finite; give finite positions in metres.")
    look = surface.appearance
    if look is None:
        look = Appearance(np.full((1, 3), 0.45), ("plain",), np.ones(1), np.zeros(1))
        region = np.zeros_like(region)
    regions = len(look.texture)
    if region.min() < 0 or region.max() >= regions:
        raise RenderError(f"render: a triangle is of region {int(region.max())}, but the appearance has {regions}; "
                          f"give one entry a region.")
    for name in look.texture:
        one_of(name, TEXTURES, "render: a texture", RenderError)
    return Surface(vertices, triangles.astype(np.int32), region.astype(np.int32), look, rest)
