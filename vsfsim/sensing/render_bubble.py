"""The ray caster inside the bubble: one ray for each pixel from the camera in the chamber to the skin.

As in `render_warp`, the hierarchy works in float32 and the hit triangle is intersected again in float64, so that depth
is exact on the triangles. Colour is albedo x sum over two lamps of (cos at the skin x cos at the lamp / distance^2),
as of small diffuse lamps beside the camera. The skin carries dots at fixed material points, so that they move and
stretch with it; their places come from a hash, which is the same on every device.
"""

import numpy as np
import warp as wp

from vsfsim.sensing.cell_hash import cell_hash

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_FAR = 0.5  # length of a ray [m]; the chamber is far smaller


def cast_inside(points: np.ndarray, triangles: np.ndarray, normals: np.ndarray, material: np.ndarray,
                intrinsics: np.ndarray, pose: np.ndarray, width: int, height: int, *, lamps: np.ndarray, power: float,
                dots: tuple[float, float], albedo: tuple[float, float], device: str) -> tuple[np.ndarray, np.ndarray]:
    """Depth (T, H, W) [m] and linear grey light (T, H, W); see `vsfsim.sensing.bubble_camera.look_inside`, which checks
    the arguments."""
    frames = len(points)
    to_ray = pose[:3, :3] @ np.linalg.inv(intrinsics)
    axis = pose[:3, 2]
    depth_out = np.empty((frames, height, width), np.float32)
    light_out = np.empty((frames, height, width), np.float32)
    with wp.ScopedDevice(device):
        # float32 is finest near its zero: the camera is the origin of the hierarchy
        corners = wp.array((points[0] - pose[:3, 3]).astype(np.float32), dtype=wp.vec3)
        mesh = wp.Mesh(points=corners, indices=wp.array(triangles.reshape(-1), dtype=wp.int32))
        faces = wp.array(triangles, dtype=wp.int32)
        flat = wp.array(material.astype(np.float32), dtype=wp.vec2)
        sources = wp.array((lamps - pose[:3, 3]).astype(np.float32), dtype=wp.vec3)
        depth, light = wp.empty((height, width), dtype=wp.float32), wp.empty((height, width), dtype=wp.float32)
        for t in range(frames):
            shifted = points[t] - pose[:3, 3]
            corners.assign(shifted.astype(np.float32))
            mesh.refit()
            wp.launch(inside_kernel, dim=(height, width), inputs=[
                mesh.id, faces, flat, sources, wp.mat33d(to_ray), wp.vec3(*axis.tolist()), power, *dots, *albedo,
                wp.array(shifted, dtype=wp.vec3d), wp.array(normals[t].astype(np.float32), dtype=wp.vec3),
            ], outputs=[depth, light])
            depth_out[t], light_out[t] = depth.numpy(), light.numpy()
    return depth_out, light_out


@wp.func
def _ink(p: wp.vec2, spacing: float, radius: float, blur: float) -> float:
    """Share of ink, 0 to 1, at material point ``p`` [m]: each cell has a dot, up to a third of the spacing off its
    middle."""
    cx = int(wp.floor(p[0] / spacing))
    cy = int(wp.floor(p[1] / spacing))
    most = wp.float32(0.0)
    for i in range(-1, 2):
        for j in range(-1, 2):
            x = cx + i
            y = cy + j
            at = wp.vec2((float(x) + 0.5 + 0.66 * (cell_hash(x, y, 1) - 0.5)) * spacing,
                         (float(y) + 0.5 + 0.66 * (cell_hash(x, y, 2) - 0.5)) * spacing)
            size = radius * (0.75 + 0.5 * cell_hash(x, y, 3))
            most = wp.max(most, wp.clamp(0.5 + (size - wp.length(p - at)) / blur, 0.0, 1.0))
    return most


@wp.kernel(enable_backward=False)
def inside_kernel(
    # model
    mesh: wp.uint64,
    triangle_in: wp.array2d(dtype=wp.int32),
    material_in: wp.array(dtype=wp.vec2),
    lamp_in: wp.array(dtype=wp.vec3),
    to_ray: wp.mat33d,
    optical_axis: wp.vec3,
    power: float,
    spacing: float,
    radius: float,
    skin: float,
    ink: float,
    # state in
    vertex_in: wp.array(dtype=wp.vec3d),
    normal_in: wp.array(dtype=wp.vec3),
    # state out
    depth_out: wp.array2d(dtype=wp.float32),
    light_out: wp.array2d(dtype=wp.float32),
):
    row, column = wp.tid()
    depth_out[row, column] = 0.0
    light_out[row, column] = 0.0
    ray = to_ray * wp.vec3d(wp.float64(column), wp.float64(row), wp.float64(1.0))
    length = wp.length(ray)
    direction = ray / length
    query = wp.mesh_query_ray(mesh, wp.vec3(0.0, 0.0, 0.0), wp.vec3(direction), float(_FAR))
    if not query.result:
        return
    face = query.face
    i = triangle_in[face, 0]
    j = triangle_in[face, 1]
    k = triangle_in[face, 2]
    a = vertex_in[i]
    b = vertex_in[j]
    c = vertex_in[k]
    n = wp.cross(b - a, c - a)
    along = wp.dot(n, ray)
    area = wp.dot(n, n)
    if area <= wp.float64(0.0) or wp.abs(along) <= wp.float64(1.0e-14) * length * wp.sqrt(area):
        return
    z = wp.dot(n, a) / along
    if z <= wp.float64(0.0):
        return
    hit = z * ray
    v = float(wp.clamp(wp.dot(wp.cross(hit - a, c - a), n) / area, wp.float64(0.0), wp.float64(1.0)))
    w = float(wp.clamp(wp.dot(wp.cross(b - a, hit - a), n) / area, wp.float64(0.0), wp.float64(1.0) - wp.float64(v)))
    u = 1.0 - v - w
    depth_out[row, column] = float(z)
    shade = wp.normalize(u * normal_in[i] + v * normal_in[j] + w * normal_in[k])
    if wp.dot(shade, wp.vec3(direction)) > 0.0:
        shade = -shade  # towards the chamber
    p = wp.vec3(hit)
    total = wp.float32(0.0)
    for s in range(lamp_in.shape[0]):
        away = lamp_in[s] - p
        reach = wp.length(away)
        total += wp.max(wp.dot(shade, away), 0.0) * wp.max(-wp.dot(optical_axis, away), 0.0) / wp.pow(reach, 4.0)
    # a pixel covers about this much of the skin; the edge of a dot is no sharper
    blur = wp.max(float(z) * float(wp.length(wp.vec3d(to_ray[0, 0], to_ray[1, 0], to_ray[2, 0]))), 1.0e-6)
    at = u * material_in[i] + v * material_in[j] + w * material_in[k]
    colour = wp.lerp(skin, ink, _ink(at, spacing, radius, blur))
    light_out[row, column] = colour * (0.04 + power * total)
