"""The ray caster inside the bubble: one ray for each pixel from the camera in the chamber to the skin.

As in `render_warp`, the hierarchy works in float32 and the hit triangle is intersected again in float64, so that depth
is exact on the triangles. Colour is albedo x (light of one lamp + light that the white housing scatters). The lamp's is
green to cyan and falls with the square of the distance; the housing's is a yellowish green and even. The print on the
skin is a threshold of fractal noise at fixed material points, so it moves and stretches with the skin; the noise comes
from a hash, which is the same on every device. Rays that miss the skin meet the housing in the rim's plane.
"""

import numpy as np
import warp as wp

from vsfsim.sensing.render_warp import cell_hash, met

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_FAR = 0.5  # length of a ray [m]; the chamber is far smaller


def cast_inside(points: np.ndarray, triangles: np.ndarray, normals: np.ndarray, material: np.ndarray,
                intrinsics: np.ndarray, pose: np.ndarray, width: int, height: int, *, lamp: np.ndarray, power: float,
                patch: float, rim: tuple[float, float], device: str) -> tuple[np.ndarray, np.ndarray]:
    """Depth (T, H, W) [m] and linear RGB (T, H, W, 3); see `vsfsim.sensing.bubble_camera.look_inside`, which checks the
    arguments."""
    frames = len(points)
    inverse = np.linalg.inv(intrinsics)
    to_ray = pose[:3, :3] @ inverse
    depth_out = np.empty((frames, height, width), np.float32)
    light_out = np.empty((frames, height, width, 3), np.float32)
    with wp.ScopedDevice(device):
        # float32 is finest near its zero: the camera is the origin of the hierarchy
        corners = wp.array((points[0] - pose[:3, 3]).astype(np.float32), dtype=wp.vec3)
        mesh = wp.Mesh(points=corners, indices=wp.array(triangles.reshape(-1), dtype=wp.int32))
        faces = wp.array(triangles, dtype=wp.int32)
        flat = wp.array(material.astype(np.float32), dtype=wp.vec2)
        depth, light = wp.empty((height, width), dtype=wp.float32), wp.empty((height, width), dtype=wp.vec3)
        for t in range(frames):
            shifted = points[t] - pose[:3, 3]
            corners.assign(shifted.astype(np.float32))
            mesh.refit()
            wp.launch(inside_kernel, dim=(height, width), inputs=[
                mesh.id, faces, flat, wp.vec3(*(lamp - pose[:3, 3]).tolist()), wp.mat33d(to_ray), wp.mat33(inverse),
                wp.vec3(*(-pose[:3, 3]).tolist()), wp.vec2(*rim), power, patch,
                wp.array(shifted, dtype=wp.vec3d), wp.array(normals[t].astype(np.float32), dtype=wp.vec3),
            ], outputs=[depth, light])
            depth_out[t], light_out[t] = depth.numpy(), light.numpy()
    return depth_out, light_out


@wp.func
def _noise(p: wp.vec2, layer: int) -> float:
    """Smoothly interpolated cell noise, -1..1, wavelength about 1."""
    x = int(wp.floor(p[0]))
    y = int(wp.floor(p[1]))
    f = wp.vec2(p[0] - float(x), p[1] - float(y))
    w = wp.vec2(f[0] * f[0] * (3.0 - 2.0 * f[0]), f[1] * f[1] * (3.0 - 2.0 * f[1]))
    a = wp.lerp(cell_hash(x, y, layer), cell_hash(x + 1, y, layer), w[0])
    b = wp.lerp(cell_hash(x, y + 1, layer), cell_hash(x + 1, y + 1, layer), w[0])
    return 2.0 * wp.lerp(a, b, w[1]) - 1.0


@wp.func
def _print(p: wp.vec2, patch: float, blur: float) -> float:
    """Share of bright print, 0 to 1, at material point ``p`` [m]: patches of wavelengths up to ``patch`` with ragged
    edges, and flecks between them; edges are as soft as ``blur`` [m]."""
    q = p / patch
    total = wp.float32(0.0)
    frequency = wp.float32(1.0)
    size = wp.float32(1.0)
    for octave in range(5):
        total += size * _noise(wp.vec2(frequency * q[0] + 3.7 * float(octave), frequency * q[1] - 5.3 * float(octave)),
                               octave)
        frequency = 2.03 * frequency
        size = 0.55 * size
    slope = 2.6 / patch  # of the noise where it crosses the threshold
    patches = wp.clamp(0.5 + (total - 0.36) / (slope * blur), 0.0, 1.0)
    fleck = _noise(p / 0.00085, 11) + 0.5 * _noise(p / 0.0004, 12)
    flecks = wp.clamp(0.5 + (fleck - 0.72) * 0.0004 / (1.2 * blur), 0.0, 1.0)
    return wp.max(patches, 0.35 * flecks)


@wp.func
def _light(p: wp.vec3, normal: wp.vec3, lamp: wp.vec3, power: float) -> wp.vec3:
    """Linear RGB of the light at a point ``p`` [m] with a unit ``normal``: the lamp's and the housing's."""
    away = lamp - p
    reach = wp.max(wp.length(away), 1.0e-3)
    direct = power * (0.35 + 0.65 * wp.max(wp.dot(normal, away) / reach, 0.0)) / (reach * reach)
    return 1.10 * direct * wp.vec3(0.045, 1.0, 0.88) + wp.vec3(0.050, 0.45, 0.10)


@wp.func
def _fittings(u: float, v: float, colour: wp.vec3) -> wp.vec3:
    """What stands between camera and skin at the ray (u, v, 1): a black tube at the left and a printed label at the
    lower left; else ``colour``."""
    if u < -0.43 - 0.3 * wp.abs(v - 0.03) and wp.abs(v - 0.03) < 0.11:
        return wp.vec3(0.001, 0.010, 0.004)
    # the label is turned by about 12 degrees and bears two lines of print
    a = 0.978 * (u + 0.46) + 0.208 * (v - 0.34)
    b = -0.208 * (u + 0.46) + 0.978 * (v - 0.34)
    if wp.abs(a) < 0.235 and wp.abs(b) < 0.115:
        row = wp.abs(wp.abs(b) - 0.045)
        if row < 0.022 and wp.abs(a) < 0.20 and cell_hash(int(wp.floor(a / 0.014)), int(wp.floor(b / 0.011)), 5) > 0.45:
            return wp.vec3(0.004, 0.06, 0.03)
        return wp.vec3(0.055, 0.62, 0.36)
    return colour


@wp.kernel(enable_backward=False)
def inside_kernel(
    # model
    mesh: wp.uint64,
    triangle_in: wp.array2d(dtype=wp.int32),
    material_in: wp.array(dtype=wp.vec2),
    lamp: wp.vec3,
    to_ray: wp.mat33d,
    to_view: wp.mat33,
    rim_centre: wp.vec3,
    rim: wp.vec2,
    power: float,
    patch: float,
    # state in
    vertex_in: wp.array(dtype=wp.vec3d),
    normal_in: wp.array(dtype=wp.vec3),
    # state out
    depth_out: wp.array2d(dtype=wp.float32),
    light_out: wp.array2d(dtype=wp.vec3),
):
    row, column = wp.tid()
    depth_out[row, column] = 0.0
    light_out[row, column] = wp.vec3(0.0)
    seen = to_view * wp.vec3(float(column), float(row), 1.0)
    ray = to_ray * wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
    direction = wp.normalize(ray)
    query = wp.mesh_query_ray(mesh, wp.vec3(0.0, 0.0, 0.0), wp.vec3(direction), float(_FAR))
    if not query.result:
        if ray[2] > wp.float64(0.0):
            # the white housing in the rim's plane, with six clips
            at_rim = wp.vec3(ray * (wp.float64(rim_centre[2]) / ray[2]))
            x = (at_rim[0] - rim_centre[0]) / rim[0]
            y = (at_rim[1] - rim_centre[1]) / rim[1]
            house = wp.cw_mul(wp.vec3(0.55, 0.36, 0.28), _light(at_rim, wp.vec3(0.0, 0.0, -1.0), lamp, power))
            beside = wp.atan2(y, x) * (3.0 / float(np.pi))
            turn = wp.abs(beside - wp.floor(beside) - 0.5)
            far = wp.sqrt(x * x + y * y)
            if turn < 0.06 and far > 1.03 and far < 1.13:
                house = 0.15 * house
            light_out[row, column] = _fittings(seen[0], seen[1], house)
        return
    face = query.face
    i = triangle_in[face, 0]
    j = triangle_in[face, 1]
    k = triangle_in[face, 2]
    hit = met(vertex_in[i], vertex_in[j], vertex_in[k], wp.vec3d(), ray)
    z = float(hit[0])
    if z == 0.0:
        return
    v = float(hit[1])
    w = float(hit[2])
    u = 1.0 - v - w
    depth_out[row, column] = z
    shade = wp.normalize(u * normal_in[i] + v * normal_in[j] + w * normal_in[k])
    if wp.dot(shade, wp.vec3(direction)) > 0.0:
        shade = -shade  # towards the chamber
    p = wp.vec3(hit[0] * ray)
    # a pixel covers about this much of the skin; the edge of a patch is 2 to 3 pixels wide, as the real lens makes it
    blur = wp.max(2.2 * z * float(wp.length(wp.vec3d(to_ray[0, 0], to_ray[1, 0], to_ray[2, 0]))), 1.0e-6)
    at = u * material_in[i] + v * material_in[j] + w * material_in[k]
    share = _print(at, patch, blur)
    albedo = wp.lerp(wp.vec3(0.012, 0.074, 0.030), wp.vec3(0.80, 1.20, 0.80), share)
    light_out[row, column] = _fittings(seen[0], seen[1], wp.cw_mul(albedo, _light(p, shade, lamp, power)))
