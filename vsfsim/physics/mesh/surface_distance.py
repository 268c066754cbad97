"""Signed distance of points to a triangle surface: to the exact triangles, in double, its sign from the generalised
winding number (Jacobson et al. 2013; Barill et al. 2018), so that parts that overlap count once."""


import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.elements import closest_point


class SurfaceDistance:
    """A surface that answers for many sets of points.

    Args:
        vertices: corners (n, 3) [m].
        faces: triangles (f, 3), wound outwards.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self._mesh = wp.Mesh(points=_array(vertices.astype(np.float32), wp.vec3),
                             indices=_array(faces.astype(np.int32).reshape(-1), wp.int32),
                             support_winding_number=True)
        self._vertices, self._faces = _array(vertices, wp.vec3d), _array(faces, wp.vec3i)

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (k,) [m] of ``points`` (k, 3) [m]; negative inside."""
        found, sign = self.nearest(points)
        return sign * np.linalg.norm(points - found, axis=1)

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Whether ``points`` (k, 3) [m] lie inside (k,) bool."""
        return self.nearest(points)[1] < 0.0

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The points of the surface (k, 3) [m] that are nearest to ``points`` (k, 3) [m], and -1 for those inside, 1
        for others (k,)."""
        found = wp.empty(len(points), dtype=wp.vec3d, device="cpu")
        sign = wp.empty(len(points), dtype=wp.float32, device="cpu")
        wp.launch(_query, dim=len(points), device="cpu",
                  inputs=[self._mesh.id, self._vertices, self._faces, _array(points, wp.vec3d), found, sign])
        return found.numpy(), sign.numpy().astype(float)


def nearest_on(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The points (k, 3) [m] of `SurfaceDistance.nearest`, of a surface that is asked seldom."""
    return SurfaceDistance(vertices, faces).nearest(points)[0]


def _array(values: np.ndarray, dtype: type) -> wp.array:
    return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")


@wp.kernel(module="vsfsim_distance_grid", enable_backward=False)
def _query(
    # model
    mesh: wp.uint64, vertices: wp.array(dtype=wp.vec3d), faces: wp.array(dtype=wp.vec3i),
    # state in
    point_in: wp.array(dtype=wp.vec3d),
    # state out
    found_out: wp.array(dtype=wp.vec3d), sign_out: wp.array(dtype=wp.float32),
):
    i = wp.tid()
    x = point_in[i]
    found = wp.mesh_query_point_sign_winding_number(mesh, wp.vec3(x), 1.0e6)
    # the search is in single precision; the point of the triangle that it found is computed again in double
    f = faces[found.face]
    m = closest_point.on_triangle(x, vertices[f[0]], vertices[f[1]], vertices[f[2]])
    found_out[i] = m[0] * vertices[f[0]] + m[1] * vertices[f[1]] + m[2] * vertices[f[2]]
    sign_out[i] = found.sign


def crossings(start: np.ndarray, way: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """How many times ``way`` (k, 3) it is from ``start`` (k, 3) [m] to triangles with ``corners`` (f, 3, 3) [m]: (k,
    f), infinite where they are missed (Moeller and Trumbore 1997)."""
    a = corners[:, 0]
    one, two, way = corners[:, 1] - a, corners[:, 2] - a, way[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        across, off = np.cross(way, two), start[:, None] - a
        side, det = np.cross(off, one), (one * across).sum(axis=2)
        u, v, t = ((x * y).sum(axis=2) / det for x, y in ((off, across), (way, side), (two, side)))
        return np.where((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9), t, np.inf)
