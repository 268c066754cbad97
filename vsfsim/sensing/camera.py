"""A pinhole RGB-D camera: where it stands, what it sees, and the two renderers behind it.

Pixel (column i, row j) has its centre at (i, j); a point at camera coordinates (x, y, z), OpenCV axes, falls on
(fx x / z + cx, fy y / z + cy). Depth is z, not the length of the ray.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vsfsim.core.errors import VsfsimError, did_you_mean
from vsfsim.core.scene import CameraSpec
from vsfsim.core.solid import TEXTURES, Appearance
from vsfsim.data.records import View

RENDERERS = ("warp", "pyrender")


class RenderError(VsfsimError):
    """A picture cannot be made: a surface or camera that does not fit, or a renderer that is not there."""


@dataclass(frozen=True)
class Surface:
    """What the camera looks at: a triangle mesh that knows its material.

    vertices: corners, world (n, 3) [m].
    triangles: corner indices, wound outwards (f, 3).
    region: region of each triangle, an index into the appearance's arrays (f,).
    appearance: the look of each region, or None for a plain grey.
    rest_vertices: the same corners undeformed in the object's frame (n, 3) [m]; textures live there, so that they
        move with the material.
    """

    vertices: np.ndarray
    triangles: np.ndarray
    region: np.ndarray
    appearance: Appearance | None
    rest_vertices: np.ndarray


def look_at(spec: CameraSpec, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) [px] and camera-to-world pose (4, 4) [m] of a camera with ``target`` in its middle.

    Args:
        spec: resolution, field of view and the direction from the object to the camera.
        target: the point looked at, world (3,) [m].

    Raises:
        RenderError: the target is not three finite numbers.
    """
    target = np.asarray(target, np.float64)
    if target.shape != (3,) or not np.isfinite(target).all():
        raise RenderError(f"camera: target is {target.tolist()}; give a finite world point (3,) in metres.")
    focal = 0.5 * spec.height / math.tan(0.5 * spec.fov)
    intrinsics = np.array([[focal, 0.0, 0.5 * (spec.width - 1)], [0.0, focal, 0.5 * (spec.height - 1)],
                           [0.0, 0.0, 1.0]])
    outward = np.array([math.cos(spec.elevation) * math.cos(spec.azimuth),
                        math.cos(spec.elevation) * math.sin(spec.azimuth), math.sin(spec.elevation)])
    forward = -outward
    # The elevation stays under 1.55 rad, so that "up" always has a direction across the view.
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = target + spec.distance * outward
    return intrinsics, pose


def render(surface: Surface, intrinsics: np.ndarray, camera_pose: np.ndarray, width: int, height: int, *,
           device: str = "cpu", renderer: str = "warp", shading: float = 1.0,
           background: tuple[int, int, int] = (226, 228, 231)) -> View:
    """Take one RGB-D picture.

    Args:
        surface: what is seen; nothing else is in the picture.
        intrinsics: pinhole matrix (3, 3) [px].
        camera_pose: camera-to-world transform, OpenCV axes (4, 4) [m].
        width, height: of the picture [px].
        device: Warp device of the ray caster; pyrender takes the machine's GL whatever it says.
        renderer: "warp" casts one ray a pixel, depth exact on the triangles; "pyrender" rasterises with OpenGL
            (colours without the procedural textures).
        shading: 1 for full light and shade, 0 for the bare albedo (pyrender knows only these two, cut at 0.5).
        background: sRGB colour where there is no object.

    Returns:
        The view; depth is 0 and the mask False where no ray meets the object.

    Raises:
        RenderError: a surface or camera that does not fit, an unknown renderer, or no GL for pyrender.
    """
    surface = _checked(surface)
    intrinsics, camera_pose = np.asarray(intrinsics, np.float64), np.asarray(camera_pose, np.float64)
    if intrinsics.shape != (3, 3) or camera_pose.shape != (4,
                                                           4) or not (np.isfinite(intrinsics).all()
                                                                      and np.isfinite(camera_pose).all()):
        raise RenderError(f"render: intrinsics {intrinsics.shape} and camera_pose {camera_pose.shape}; give finite (3, "
                          f"3) and (4, 4).")
    if not 0.0 <= shading <= 1.0:
        raise RenderError(f"render: shading is {shading!r}; it must be from 0 (bare albedo) to 1 (full light "
                          f"and shade).")
    if width < 1 or height < 1:
        raise RenderError(f"render: the picture is {width} x {height}; it must have at least one pixel.")
    if renderer == "warp":
        from vsfsim.sensing.render_warp import cast
        return cast(surface, intrinsics, camera_pose, width, height, device=device, shading=shading,
                    background=background)
    if renderer == "pyrender":
        from vsfsim.sensing.render_pyrender import rasterise
        return rasterise(surface, intrinsics, camera_pose, width, height, shading=shading, background=background)
    raise RenderError(f"render: unknown renderer '{renderer}'. {did_you_mean(renderer, RENDERERS)}")


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


def _checked(surface: Surface) -> Surface:
    vertices, triangles = np.asarray(surface.vertices, np.float64), np.asarray(surface.triangles)
    region, rest = np.asarray(surface.region), np.asarray(surface.rest_vertices, np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or rest.shape != vertices.shape:
        raise RenderError(f"render: vertices {vertices.shape} and rest_vertices {rest.shape}; both must be (n, "
                          f"3) in metres.")
    if not (np.isfinite(vertices).all() and np.isfinite(rest).all()):
        raise RenderError("render: the surface has a vertex that is not finite; give finite positions in metres.")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or len(triangles) == 0 or region.shape != (len(triangles),):
        raise RenderError(f"render: triangles {triangles.shape} and region {region.shape}; give (f, 3) and (f,) "
                          f"with f >= 1.")
    if triangles.min() < 0 or triangles.max() >= len(vertices):
        raise RenderError(f"render: a triangle names vertex {int(triangles.max())} of {len(vertices)}; indices go from "
                          f"0 to {len(vertices) - 1}.")
    look = surface.appearance
    if look is None:
        look = Appearance(np.full((1, 3), 0.45), ("plain",), np.ones(1), np.zeros(1))
        region = np.zeros_like(region)
    regions = len(look.texture)
    if region.min() < 0 or region.max() >= regions:
        raise RenderError(f"render: a triangle is of region {int(region.max())}, but the appearance has {regions}; "
                          f"give one entry a region.")
    if np.shape(look.albedo) != (regions, 3) or np.shape(look.texture_scale) != (regions,
                                                                                 ) or np.shape(look.texture_contrast) != (regions,):
        raise RenderError(f"render: the appearance has {regions} textures; albedo must be ({regions}, 3), scale and "
                          f"contrast ({regions},).")
    for name in look.texture:
        if name not in TEXTURES:
            raise RenderError(f"render: unknown texture '{name}'. {did_you_mean(name, TEXTURES)}")
    return Surface(vertices, triangles.astype(np.int32), region.astype(np.int32), look, rest)
