"""Takes a picture of depth in another renderer, and keeps it with the time that it took.

    python drawing.py PEER CASE.npz OUT.npz

It imports nothing of vsfsim, since each peer runs in a venv of its own. The case has the triangles of a surface, seen
from a pinhole camera with OpenCV axes at the origin: ``points`` (n, 3) [m], ``triangles`` (m, 3), ``size`` (width,
height) [px], and ``focal`` [px]; the optical axis meets the middle of the picture. A peer has a function of the case
that returns its version, its settings in words, and a function that draws the picture of z (height, width) [m], 0 where
there is no surface.
"""

import os
import sys
import time

import numpy as np

PICTURES = 5
"""That are drawn; the first, which is not timed, may make what the others use."""
FLIP = np.array([1.0, -1.0, -1.0])  # from OpenCV to OpenGL axes


def _rays(given):
    """Directions of all pixels with z = 1 (k, 3)."""
    width, height = given["size"]
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([(column - 0.5 * (width - 1)) / given["focal"], (row - 0.5 * (height - 1)) / given["focal"],
                     np.ones(column.shape)], axis=-1).reshape(-1, 3)


def _planes(given):
    z = given["points"][:, 2]
    return 0.95 * float(z.min()), 1.05 * float(z.max())


def trimesh(given):
    """Rays by Embree, single precision."""
    import embreex
    import trimesh as library
    from trimesh.ray.ray_pyembree import RayMeshIntersector

    caster = RayMeshIntersector(library.Trimesh(given["points"], given["triangles"], process=False))
    rays = _rays(given)
    width, height = given["size"]

    def draw():
        out = np.zeros(len(rays))
        at, ray, _ = caster.intersects_location(np.zeros_like(rays), rays, multiple_hits=False)
        out[ray] = at[:, 2]
        return out.reshape(height, width)

    return library.__version__, f"one ray a pixel, Embree by embreex {embreex.__version__}", draw


def open3d(given):
    """Rays by Embree, single precision."""
    import open3d as library

    scene = library.t.geometry.RaycastingScene()
    scene.add_triangles(given["points"].astype(np.float32), given["triangles"].astype(np.uint32))
    rays = _rays(given).astype(np.float32)
    both = library.core.Tensor(np.concatenate([np.zeros_like(rays), rays], axis=1))
    width, height = given["size"]

    def draw():
        far = scene.cast_rays(both)["t_hit"].numpy()
        return np.where(np.isfinite(far), far, 0.0).reshape(height, width)

    return library.__version__, "one ray a pixel, RaycastingScene", draw


def pyrender(given):
    """Rasterised by OpenGL."""
    os.environ["PYOPENGL_PLATFORM"] = "egl"
    import pyrender as library
    from OpenGL.GL import GL_RENDERER, glGetString

    width, height = map(int, given["size"])
    corners = (given["points"] * FLIP)[given["triangles"].reshape(-1)].astype(np.float32)
    near, far = _planes(given)
    scene = library.Scene()
    node = scene.add(library.Mesh([library.Primitive(positions=corners, mode=4)]))
    focal = float(given["focal"])
    scene.add(library.IntrinsicsCamera(focal, focal, 0.5 * width, 0.5 * height, znear=near, zfar=far))
    renderer = library.OffscreenRenderer(width, height)

    def draw():
        # of its passes this one alone samples the middle of a pixel; the others average four samples
        return renderer.render(scene, flags=library.RenderFlags.SEG | library.RenderFlags.SKIP_CULL_FACES,
                               seg_node_map={node: (255, 255, 255)})[1]

    draw()
    name = glGetString(GL_RENDERER).decode()
    return library.__version__, f"rasterised by OpenGL, {name}, planes at {near:.3g} and {far:.3g} m", draw


def mujoco(given):
    """MuJoCo's renderer, rasterised by OpenGL."""
    os.environ["MUJOCO_GL"] = "egl"
    import mujoco as library

    width, height = map(int, given["size"])
    near, far = _planes(given)
    spec = library.MjSpec()
    spec.add_mesh(name="surface", uservert=(given["points"] * FLIP).ravel().tolist(),
                  userface=given["triangles"].ravel().astype(int).tolist())
    spec.worldbody.add_geom(type=library.mjtGeom.mjGEOM_MESH, meshname="surface")
    spec.worldbody.add_camera(name="eye", fovy=float(np.degrees(2.0 * np.arctan(0.5 * height / given["focal"]))))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples = 0  # in place of four samples a pixel, of which depth is one
    spec.visual.map.znear, spec.visual.map.zfar = near, far
    spec.stat.extent = 1.0
    model = spec.compile()
    data = library.MjData(model)
    library.mj_forward(model, data)
    renderer = library.Renderer(model, height, width)
    renderer.enable_depth_rendering()

    def draw():
        renderer.update_scene(data, camera="eye")
        z = renderer.render()
        return np.where(z < 0.999 * far, z, 0.0)

    return library.__version__, f"rasterised by OpenGL, planes at {near:.3g} and {far:.3g} m", draw


def main(peer, case, out):
    """Draw a case and write what came of it."""
    given = dict(np.load(case))
    version, settings, draw = globals()[peer](given)
    draw()
    began = time.process_time()
    for _ in range(PICTURES):
        depth = draw()
    np.savez(out, depth=np.asarray(depth, float), seconds=(time.process_time() - began) / PICTURES, version=version,
             settings=settings)


if __name__ == "__main__":
    main(*sys.argv[1:])
