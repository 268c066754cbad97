"""The ray caster: one ray for each pixel against a bounding volume hierarchy, on the CPU or a GPU.

The hierarchy works in float32, centred on the object. The hit triangle is then intersected again in float64, so that
depth is exact on the triangles: z = n.(v0 - o) / n.d with the ray o + z d scaled to one metre along the optical axis.
Colour is albedo x texture x (ambient + wrapped Lambert) + a soft highlight, from lights fixed in the world.
"""

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.solid import TEXTURES
from vsfsim.core.system.exact import inverse3, product
from vsfsim.data.records import View
from vsfsim.sensing.surface import Surface, corner_normals, srgb

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_PLAIN, _NOISE, _WEAVE, _GRAIN, _STRIPES, _LACES, _TREAD, _SEAMS = range(len(TEXTURES))
_TURN = 2.0 * np.pi


def cast(surface: Surface, intrinsics: np.ndarray, camera_pose: np.ndarray, width: int, height: int, *,
         device: str, shading: float, background: tuple[int, int, int]) -> View:
    """See `vsfsim.sensing.camera.render`, which checks the arguments."""
    centre = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    vertices = surface.vertices - centre
    # A ray through pixel (i, j): camera direction K^-1 (i, j, 1) has z = 1, so the ray parameter is the depth.
    to_ray = product(camera_pose[:3, :3], inverse3(intrinsics))
    origin = camera_pose[:3, 3] - centre
    radius = 1.001 * float(np.linalg.norm(vertices, axis=1).max())
    look = surface.appearance
    assert look is not None  # see checked_surface
    with wp.ScopedDevice(device):
        points = wp.array(vertices.astype(np.float32), dtype=wp.vec3)
        indices = wp.array(surface.triangles.reshape(-1), dtype=wp.int32)
        mesh = wp.Mesh(points=points, indices=indices)
        depth = wp.zeros((height, width), dtype=wp.float32)
        colour = wp.zeros((height, width), dtype=wp.vec3)
        wp.launch(cast_kernel, dim=(height, width), inputs=[
            mesh.id,
            wp.array(vertices, dtype=wp.vec3d),
            wp.array(surface.triangles, dtype=wp.int32),
            wp.array(surface.region, dtype=wp.int32),
            wp.array(corner_normals(surface).astype(np.float32), dtype=wp.vec3),
            wp.array(surface.rest_vertices.astype(np.float32), dtype=wp.vec3),
            wp.array(np.asarray(look.albedo, np.float32), dtype=wp.vec3),
            wp.array([TEXTURES.index(name) for name in look.texture], dtype=wp.int32),
            wp.array(np.asarray(look.texture_scale, np.float32), dtype=wp.float32),
            wp.array(np.asarray(look.texture_contrast, np.float32), dtype=wp.float32),
            wp.mat33d(to_ray), wp.vec3d(*origin), radius, shading,
        ], outputs=[depth, colour])
        depth, colour = depth.numpy(), colour.numpy()
    mask = depth > 0.0
    rgb = np.where(mask[..., None], srgb(colour), np.asarray(background, np.uint8)).astype(np.uint8)
    return View(rgb, depth, mask, intrinsics.copy(), camera_pose.copy())


@wp.func
def met(a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, origin: wp.vec3d, ray: wp.vec3d) -> wp.vec3d:
    """How many times ``ray`` it is from ``origin`` to a triangle, 0 where they do not meet, and the weights of b and c
    there."""
    n = wp.cross(b - a, c - a)
    along = wp.dot(n, ray)
    area = wp.dot(n, n)
    if area <= wp.float64(0.0) or wp.abs(along) <= wp.float64(1.0e-14) * wp.length(ray) * wp.sqrt(area):
        return wp.vec3d()
    z = wp.dot(n, a - origin) / along
    if z <= wp.float64(0.0):
        return wp.vec3d()
    p = origin + z * ray
    v = wp.clamp(wp.dot(wp.cross(p - a, c - a), n) / area, wp.float64(0.0), wp.float64(1.0))
    w = wp.clamp(wp.dot(wp.cross(b - a, p - a), n) / area, wp.float64(0.0), wp.float64(1.0) - v)
    return wp.vec3d(z, v, w)


@wp.func
def cell_hash(x: int, y: int, z: int) -> float:
    """A fixed number from 0 to 1 for the cell with these indices, the same on every device."""
    h = wp.uint32(x) * wp.uint32(73856093) ^ wp.uint32(y) * wp.uint32(19349663) ^ wp.uint32(z) * wp.uint32(83492791)
    h = (h ^ (h >> wp.uint32(16))) * wp.uint32(2146121005)
    h = (h ^ (h >> wp.uint32(13))) * wp.uint32(1540483477)
    h = h ^ (h >> wp.uint32(16))
    return float(h >> wp.uint32(8)) / 16777216.0


@wp.func
def _value_noise(p: wp.vec3) -> float:
    """Smoothly interpolated cell noise, 0..1, wavelength about 1."""
    x = int(wp.floor(p[0]))
    y = int(wp.floor(p[1]))
    z = int(wp.floor(p[2]))
    f = wp.vec3(p[0] - float(x), p[1] - float(y), p[2] - float(z))
    w = wp.vec3(f[0] * f[0] * (3.0 - 2.0 * f[0]), f[1] * f[1] * (3.0 - 2.0 * f[1]), f[2] * f[2] * (3.0 - 2.0 * f[2]))
    a = wp.lerp(cell_hash(x, y, z), cell_hash(x + 1, y, z), w[0])
    b = wp.lerp(cell_hash(x, y + 1, z), cell_hash(x + 1, y + 1, z), w[0])
    c = wp.lerp(cell_hash(x, y, z + 1), cell_hash(x + 1, y, z + 1), w[0])
    d = wp.lerp(cell_hash(x, y + 1, z + 1), cell_hash(x + 1, y + 1, z + 1), w[0])
    return wp.lerp(wp.lerp(a, b, w[1]), wp.lerp(c, d, w[1]), w[2])


@wp.func
def _texture(kind: int, p: wp.vec3) -> float:
    """Brightness of a texture at ``p`` (in wavelengths), -1..1 with mean about 0."""
    turn = float(_TURN)
    if kind == _NOISE:
        n = (_value_noise(p) + 0.5 * _value_noise(2.03 * p + wp.vec3(17.0))
             + 0.25 * _value_noise(4.01 * p + wp.vec3(41.0)))
        return wp.clamp((n / 1.75 - 0.5) * 3.0, -1.0, 1.0)
    if kind == _WEAVE:
        # Two crossing sets of threads over all three axes: cuts in any plane show a weave.
        a = wp.sin(turn * (p[0] + p[2]))
        b = wp.sin(turn * (p[1] - p[2]))
        return wp.clamp(a * b + 0.3 * (a + b), -1.0, 1.0)
    if kind == _GRAIN:
        # Leather: creases where two noises of about the wavelength cross their mean.
        n = wp.abs(2.0 * _value_noise(1.3 * p) - 1.0)
        m = wp.abs(2.0 * _value_noise(2.9 * p + wp.vec3(7.0)) - 1.0)
        return wp.clamp(2.2 * wp.min(n, m + 0.15) - 0.55, -1.0, 1.0)
    if kind == _STRIPES:
        s = wp.sin(turn * (p[0] + 0.35 * p[2]))
        return wp.clamp(4.0 * s, -1.0, 1.0)
    if kind == _LACES:
        # Two crossing sets of bands across the object's middle plane: bright bands on a slightly darker ground.
        a = wp.sin(turn * (0.8 * p[0] + 0.6 * p[1]))
        b = wp.sin(turn * (0.8 * p[0] - 0.6 * p[1]))
        return wp.clamp(6.0 * (wp.max(a, b) - 0.75), -0.3, 1.0)
    if kind == _TREAD:
        # Ribs across the sole, with narrow dark grooves.
        return wp.clamp(1.0 - 12.0 * (wp.sin(turn * p[0]) - 0.6), -1.0, 0.3)
    if kind == _SEAMS:
        # A double line of stitches about every second wavelength, along a slanted direction.
        s = 0.5 * (0.9 * p[0] - 0.5 * p[2])
        away = wp.abs(s - wp.floor(s) - 0.5)
        line = wp.min(wp.abs(away - 0.03), wp.abs(away - 0.11))
        dash = wp.sin(3.0 * turn * (0.5 * p[0] + 0.9 * p[2] + p[1]))
        if line < 0.018 and dash > -0.4:
            return 1.0
        return wp.clamp(0.6 * (_value_noise(2.0 * p) - 0.5), -1.0, 1.0)
    return 0.0


@wp.func
def _lit(albedo: wp.vec3, n: wp.vec3, to_eye: wp.vec3, shading: float) -> wp.vec3:
    """Linear RGB under a key and a fill light fixed in the world and a sky brighter than the ground."""
    key = wp.normalize(wp.vec3(0.45, -0.35, 0.82))
    fill = wp.normalize(wp.vec3(-0.7, 0.6, 0.35))
    ambient = 0.22 + 0.12 * n[2]
    lambert = 0.72 * wp.max(wp.dot(n, key), 0.0) + 0.20 * wp.max((wp.dot(n, fill) + 0.3) / 1.3, 0.0)
    half_way = wp.normalize(key + to_eye)
    highlight = 0.06 * wp.pow(wp.max(wp.dot(n, half_way), 0.0), 24.0)
    return albedo * wp.lerp(1.0, ambient + lambert, shading) + wp.vec3(shading * highlight)


@wp.kernel(enable_backward=False)
def cast_kernel(
    # model
    mesh: wp.uint64,
    vertex_in: wp.array(dtype=wp.vec3d),
    triangle_in: wp.array2d(dtype=wp.int32),
    region_in: wp.array(dtype=wp.int32),
    normal_in: wp.array2d(dtype=wp.vec3),
    rest_in: wp.array(dtype=wp.vec3),
    albedo_in: wp.array(dtype=wp.vec3),
    texture_in: wp.array(dtype=wp.int32),
    scale_in: wp.array(dtype=wp.float32),
    contrast_in: wp.array(dtype=wp.float32),
    # state in
    to_ray: wp.mat33d,
    origin: wp.vec3d,
    radius: wp.float64,
    shading: float,
    # state out
    depth_out: wp.array2d(dtype=wp.float32),
    colour_out: wp.array2d(dtype=wp.vec3),
):
    row, column = wp.tid()
    ray = to_ray * wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
    # The search starts just before the object and not at the camera, which may stand far off in float32's digits.
    closest = wp.max(-wp.dot(origin, ray) / wp.dot(ray, ray), wp.float64(0.0))
    nearest = origin + closest * ray
    if wp.length(nearest) > radius:
        return
    length = wp.length(ray)
    direction = ray / length
    start = nearest - wp.min(closest * length, radius) * direction
    query = wp.mesh_query_ray(mesh, wp.vec3(start), wp.vec3(direction), float(wp.float64(2.1) * radius))
    if not query.result:
        return
    face = query.face
    hit = met(vertex_in[triangle_in[face, 0]], vertex_in[triangle_in[face, 1]], vertex_in[triangle_in[face, 2]], origin,
              ray)
    if hit[0] == wp.float64(0.0):
        return
    fv = float(hit[1])
    fw = float(hit[2])
    fu = 1.0 - fv - fw
    rest = fu * rest_in[triangle_in[face, 0]] + fv * rest_in[triangle_in[face, 1]] + fw * rest_in[triangle_in[face, 2]]
    shade = wp.normalize(fu * normal_in[face, 0] + fv * normal_in[face, 1] + fw * normal_in[face, 2])
    to_eye = wp.vec3(-direction)
    if wp.dot(shade, to_eye) < 0.0:
        # Seen from behind (an open surface), or smoothed past the silhouette.
        shade = wp.normalize(shade - 2.0 * wp.dot(shade, to_eye) * to_eye)
    region = region_in[face]
    bright = 1.0 + contrast_in[region] * _texture(texture_in[region], rest / wp.max(scale_in[region], 1.0e-6))
    depth_out[row, column] = float(hit[0])
    colour_out[row, column] = _lit(albedo_in[region] * wp.max(bright, 0.0), shade, to_eye, shading)
