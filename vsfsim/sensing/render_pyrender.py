"""The second renderer, OpenGL rasterisation by pyrender: an independent check of depth.

It needs a GL library that works without a display, EGL or OSMesa; nothing else in vsfsim does.
"""

from __future__ import annotations

import os
from ctypes.util import find_library
from types import ModuleType

import numpy as np
import trimesh

from vsfsim.data.records import View
from vsfsim.sensing.surface import RenderError, Surface

_PLATFORMS = {"egl": "EGL", "osmesa": "OSMesa"}
"""Platforms of PyOpenGL that need no display, and their libraries."""
_MISSING = (
    "render: renderer 'pyrender' found no OpenGL that works without a display ({tried}). Install one, e.g. "
    "`apt-get install libegl1 libgl1` (EGL, GPU or Mesa) or `apt-get install libosmesa6` (software), or use "
    "renderer 'warp', which needs none."
)


def rasterise(surface: Surface, intrinsics: np.ndarray, camera_pose: np.ndarray, width: int, height: int, *,
              shading: float, background: tuple[int, int, int]) -> View:
    """See `vsfsim.sensing.camera.render`, which checks the arguments.

    Raises:
        RenderError: no GL library that works off screen.
    """
    pyrender = load_pyrender()
    assert surface.appearance is not None  # see checked_surface
    from pyrender.constants import RenderFlags

    to_camera = np.linalg.inv(camera_pose)
    z = surface.vertices @ to_camera[2, :3] + to_camera[2, 3]
    # The depth buffer has 24 bits between the planes, most of them near the first: keep them close to the object.
    far = 1.02 * max(float(z.max()), 1e-3)
    near = max(0.98 * float(z.min()), 1e-3 * far)
    scene = pyrender.Scene(ambient_light=[0.35] * 3, bg_color=[*(np.asarray(background) / 255.0), 1.0])
    # GL has float32 positions: count them from the camera's frame, where the depth is.
    corners = surface.vertices @ to_camera[:3, :3].T + to_camera[:3, 3]
    flip = np.array([1.0, -1.0, -1.0])
    mesh = trimesh.Trimesh(corners * flip, surface.triangles, process=False,
                           face_colors=surface.appearance.albedo[surface.region])
    material = pyrender.MetallicRoughnessMaterial(metallicFactor=0.0, roughnessFactor=0.7, doubleSided=True)
    node = scene.add(pyrender.Mesh.from_trimesh(mesh, material=material, smooth=False))
    # pyrender counts pixels from the corner of the picture, we from the centre of the first pixel.
    camera = pyrender.IntrinsicsCamera(intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2] + 0.5,
                                       intrinsics[1, 2] + 0.5, znear=near, zfar=far)
    scene.add(camera, pose=np.eye(4))
    light = np.eye(4)
    # The key light of the ray caster, turned from the world into the camera's GL axes; a light shines along its -z.
    towards = (to_camera[:3, :3] @ _unit(np.array([0.45, -0.35, 0.82]))) * flip
    side = _unit(np.cross([0.1, 1.0, 0.2], towards))
    light[:3, 0], light[:3, 1], light[:3, 2] = side, np.cross(towards, side), towards
    scene.add(pyrender.DirectionalLight(intensity=3.0), pose=light)
    try:
        offscreen = pyrender.OffscreenRenderer(width, height)
    except Exception as error:  # GL reports a missing driver by whatever exception its binding happens to raise
        raise RenderError(_MISSING.format(tried=f"{os.environ.get('PYOPENGL_PLATFORM')}: {error}")) from error
    try:
        flat = RenderFlags.FLAT if shading < 0.5 else RenderFlags.NONE
        colour, _ = offscreen.render(scene, flags=RenderFlags.SKIP_CULL_FACES | flat)
        # The colour pass is smoothed over four samples a pixel, and its depth is that of one of them, off centre.
        # The segmentation pass samples pixel centres.
        _, depth = offscreen.render(scene, flags=RenderFlags.SKIP_CULL_FACES | RenderFlags.SEG,
                                    seg_node_map={node: (255, 255, 255)})
    finally:
        offscreen.delete()
    mask = depth > 0.0
    rgb = np.where(mask[..., None], colour, np.asarray(background, np.uint8)).astype(np.uint8)
    return View(rgb, depth.astype(np.float32), mask, intrinsics.copy(), camera_pose.copy())


def load_pyrender() -> ModuleType:
    """pyrender on the first platform of EGL and OSMesa whose library is there.

    PyOpenGL binds to one platform when it is first imported, so PYOPENGL_PLATFORM must be set before. A platform that
    the user has set is kept.

    Raises:
        RenderError: there is no library, or it does not load.
    """
    found = next((name for name, library in _PLATFORMS.items() if find_library(library)), "egl")
    tried = os.environ.setdefault("PYOPENGL_PLATFORM", found)
    try:
        import pyrender
    except (ImportError, OSError, AttributeError) as error:
        raise RenderError(_MISSING.format(tried=f"{tried}: {error}")) from error
    return pyrender


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)
