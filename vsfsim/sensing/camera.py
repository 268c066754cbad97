"""A pinhole RGB-D camera: its pose and intrinsics, and the renderer that takes the picture.

The centre of pixel (column i, row j) is at (i, j). A point at camera coordinates (x, y, z), OpenCV axes, projects to
(fx x / z + cx, fy y / z + cy). Depth is z, not the length of the ray.

`seen_by` adds the depth errors of real cameras, of a `DepthCamera`: noise of each pixel that grows with depth, an error
common to the picture, steps of the stored depth, and lost pixels at depth edges. The noise "kinect" is that of the
released plants: it grows with distance, depth is quantised to whole millimetres, and pixels along depth edges are lost.

    z' = 1 mm * round((z + N(0, s(z))) / 1 mm),   s(z) = 0.5 mm + 0.9 mm (z / 1 m)^2

The standard deviation follows measurements of such a camera (Toelgyessy et al. 2021, Sensors 21:413: about 1 mm at 1 m,
a few millimetres at 3 m). The share of pixels lost where a near and a far surface mix in one pixel is an assumption.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from vsfsim.core.errors import did_you_mean
from vsfsim.core.scene import CameraSpec
from vsfsim.core.scene_tables.object import DEPTH_CAMERAS, DepthCamera
from vsfsim.core.system.exact import length
from vsfsim.data.records import View
from vsfsim.sensing.surface import RenderError, Surface, checked_surface

RENDERERS = ("warp", "pyrender")


def look_at(spec: CameraSpec, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) [px] and camera-to-world pose (4, 4) [m] of a camera with ``target`` in its middle.

    Args:
        spec: resolution, field of view and the direction from the object to the camera.
        target: the point looked at, world (3,) [m].
    """
    focal = 0.5 * spec.height / math.tan(0.5 * spec.fov)
    intrinsics = np.array([[focal, 0.0, 0.5 * (spec.width - 1)], [0.0, focal, 0.5 * (spec.height - 1)],
                           [0.0, 0.0, 1.0]])
    outward = np.array([math.cos(spec.elevation) * math.cos(spec.azimuth),
                        math.cos(spec.elevation) * math.sin(spec.azimuth), math.sin(spec.elevation)])
    forward = -outward
    # The elevation stays under 1.55 rad, so that "up" always has a direction across the view.
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= length(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2] = right, np.cross(forward, right), forward
    pose[:3, 3] = target + spec.distance * outward
    return intrinsics, pose


def fitting_camera(vertices: np.ndarray, near: np.ndarray, width: int, height: int, *,
                   elevation: float = 0.6, azimuth: float = -1.0) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) [px] and pose (4, 4) [m] of a camera that frames a body tightly.

    Args:
        vertices: of the body (v, 3) [m].
        near: of what is next to it (k, 3) [m]; its part close to the body is framed, too.
        width, height: of the picture [px].
        elevation: of the camera above the horizon [rad].
        azimuth: of the camera about z, from x [rad].
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, reach = 0.5 * (low + high), float(np.linalg.norm(high - low))
    # A plane or a long handle would push the camera away: only what is close to the body counts.
    framed = np.concatenate([vertices, near[np.linalg.norm(near - middle, axis=1) < 0.75 * reach]])
    pose = look_at(CameraSpec(width, height, 0.5, 3.0 * reach, azimuth, elevation), middle)[1]
    at = (framed - pose[:3, 3]) @ pose[:3, :3]
    at = at[:, :2] / at[:, 2:]
    first, last = at.min(axis=0), at.max(axis=0)
    focal = 0.92 * float((np.array([width, height]) / (last - first)).min())
    centre = 0.5 * np.array([width - 1, height - 1]) - focal * 0.5 * (first + last)
    return np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]]), pose


def render(surface: Surface, intrinsics: np.ndarray, camera_pose: np.ndarray, width: int, height: int, *,
           device: str = "cpu", renderer: str = "warp", shading: float = 1.0,
           background: tuple[int, int, int] = (226, 228, 231)) -> View:
    """Take one RGB-D picture.

    Args:
        surface: the object; nothing else is in the picture.
        intrinsics: pinhole matrix (3, 3) [px].
        camera_pose: camera-to-world transform, OpenCV axes (4, 4) [m].
        width, height: of the picture [px].
        device: Warp device of the ray caster; pyrender always takes the machine's GL.
        renderer: "warp" casts one ray a pixel, depth exact on the triangles; "pyrender" rasterises with OpenGL
            (colours without the procedural textures).
        shading: 1 for full light and shade, 0 for the bare albedo (pyrender knows only these two, cut at 0.5).
        background: sRGB colour where there is no object.

    Returns:
        The view; depth is 0 and the mask False where no ray meets the object.

    Raises:
        RenderError: a surface that does not fit, see `checked_surface`, an unknown renderer, or no GL for pyrender.
    """
    surface = checked_surface(surface)
    if renderer == "warp":
        from vsfsim.sensing.render_warp import cast
        return cast(surface, intrinsics, camera_pose, width, height, device=device, shading=shading,
                    background=background)
    if renderer == "pyrender":
        from vsfsim.sensing.render_pyrender import rasterise
        return rasterise(surface, intrinsics, camera_pose, width, height, shading=shading, background=background)
    raise RenderError(f"render: unknown renderer '{renderer}'. {did_you_mean(renderer, RENDERERS)}")


STEP = 0.02  # jump in depth between neighbouring pixels that counts as an edge [m]
LOST = 0.35  # share of the edge pixels without a depth [-]
QUANTUM = 0.001  # of the stored depth [m]


def _with_errors(view: View, std: np.ndarray, lost: float, quantum: float, bias: float,
                 seed: np.random.SeedSequence | int) -> View:
    rng = np.random.default_rng(seed)
    z = view.depth.astype(np.float64)
    noise, gone = rng.standard_normal(z.shape), rng.uniform(size=z.shape) < lost
    keep = view.mask & ~(_edges(view) & gone)
    out = quantum * np.round((z + bias * rng.uniform(-1.0, 1.0) + std * noise) / quantum)
    return dataclasses.replace(view, depth=np.where(keep, out, 0.0).astype(np.float32), mask=keep)


def depth_std(camera: DepthCamera, depth: np.ndarray) -> np.ndarray:
    """Standard deviation of a pixel [m] at ``depth`` [m], of the same shape."""
    at, std = np.transpose(camera.curve)
    beyond = (std[-1] - std[-2]) / (at[-1] - at[-2]) * np.maximum(depth - at[-1], 0.0)
    return np.interp(depth, at, std) + beyond


def seen_by(view: View, spec: CameraSpec, seed: np.random.SeedSequence | int) -> View:
    """What the camera ``spec`` records of an exact view, its colours unchanged; the view itself for an ideal camera."""
    z = view.depth.astype(np.float64)
    if spec.model:
        camera = DEPTH_CAMERAS[spec.model]
        return _with_errors(view, depth_std(camera, z), camera.lost, camera.quantum, camera.bias, seed)
    return _with_errors(view, 0.0005 + 0.0009 * z**2, LOST, QUANTUM, 0.0, seed) if spec.noise == "kinect" else view


def _edges(view: View) -> np.ndarray:
    """Pixels beside a jump in depth or the object's outline (H, W)."""
    z = view.depth.astype(np.float64)
    far = np.where(view.mask, z, np.inf)
    edge = np.zeros(z.shape, bool)
    for axis in (0, 1):
        for shift in (1, -1):
            beside = np.roll(far, shift, axis=axis)
            with np.errstate(invalid="ignore"):
                edge |= np.abs(np.where(np.isfinite(beside), beside, z + 1.0) - z) > STEP
    return edge
