"""Frictionless contact of the object's surface with a rigid probe.

    Pi_c = sum_q w_q k_q / 2 <-g(x_q)>^2,     f = -dPi_c/dx = -w_q k_q g n   where g < 0

integrated over six Gauss points of every quadratic surface triangle (exact to degree 4), never at vertices alone.
k_q = stiffness / (element size) x the local modulus: so stiff that the penetration stays far under 1 % of the element size
(it is measured and stored in every frame), and soft enough that float64 keeps its digits; the solver inverts
this block exactly, so stiffness costs no iterations.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics import sdf
from vsfsim.physics.mesh import QuadraticMesh

PENALTY = 1000.0  # contact pressure of a penetration of one element size, in units of the modulus under the surface

# Degree-4 rule with six points on the triangle (Strang and Fix 1973; Cowper 1973), weights sum to 1.
_A, _WA = 0.445948490915965, 0.223381589678011
_B, _WB = 0.091576213509771, 0.109951743655322
_BARY = np.array([[1 - 2 * a if i == k else a for i in range(3)] for a in (_A, _B) for k in range(3)])
WEIGHTS = np.array([_WA] * 3 + [_WB] * 3)


def shape_values(bary: np.ndarray) -> np.ndarray:
    """Quadratic shape functions of a triangle's six nodes (k, 6) at barycentric coordinates (k, 3)."""
    return np.stack([*(bary[:, k] * (2 * bary[:, k] - 1) for k in range(3)),
                     *(4 * bary[:, i] * bary[:, j] for i, j in ((0, 1), (1, 2), (2, 0)))], axis=1)


SHAPE = shape_values(_BARY)  # (6 points, 6 nodes)


@functools.cache
def kernels(given: type) -> Any:
    """The contact kernel, in double, for displacements of scalar type ``given``.

    A contact force is a stiff spring on a small difference of positions: single precision there would drown it.
    """
    real = wp.float64
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    mat66 = wp.types.matrix(shape=(6, 6), dtype=real)
    mat63 = wp.types.matrix(shape=(6, 3), dtype=real)
    module = f"vsfsim_contact_{given.__name__}"
    probe = sdf.functions(real, module)

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # model
        rest: wp.array(dtype=vec3),
        shape: mat66,
        bodies: probe.Bodies,
        columns: wp.array(dtype=wp.int32),
        face_nodes: wp.array3d(dtype=wp.int32),
        stiffness: wp.array3d(dtype=real),
        softening: wp.array(dtype=real),
        origin: wp.array(dtype=vec3),
        turn: wp.array(dtype=mat33),
        # state in
        u_in: wp.array2d(dtype=given),
        # state out
        gap_out: wp.array3d(dtype=real),
        normal_out: wp.array3d(dtype=vec3),
        curvature_out: wp.array3d(dtype=mat33),
        energy_out: wp.array2d(dtype=real),
        force_out: wp.array3d(dtype=vec3),
    ):
        f, k = wp.tid()
        b = columns[k]
        energy = real(0.0)
        total = mat63()
        if face_nodes[b, f, 0] >= 0:
            x = mat63()
            for a in range(6):
                i = face_nodes[b, f, a]
                for c in range(3):
                    x[a, c] = rest[i][c] + real(u_in[3 * i + c, b])
            rotation = turn[b]
            for q in range(6):
                point = vec3()
                for a in range(6):
                    for c in range(3):
                        point[c] += shape[q, a] * x[a, c]
                local = wp.transpose(rotation) * (point - origin[b])
                g = probe.gap(bodies, 0, local)
                gap_out[b, f, q] = g
                if g < real(0.0):
                    n = rotation * probe.normal(bodies, 0, local)
                    normal_out[b, f, q] = n
                    curvature_out[b, f, q] = rotation * probe.curvature(bodies, 0, local) * wp.transpose(rotation)
                    w = softening[b] * stiffness[b, f, q]
                    energy += real(0.5) * w * g * g
                    for a in range(6):
                        for c in range(3):
                            total[a, c] -= shape[q, a] * w * g * n[c]
        for a in range(6):
            force_out[b, f, a] = vec3(total[a, 0], total[a, 1], total[a, 2])
        energy_out[b, f] = energy

    class Kernels:
        pass

    out = Kernels()
    out.evaluate, out.vec3, out.mat33, out.mat66, out.probe = evaluate, vec3, mat33, mat66, probe
    return out


@dataclass(frozen=True)
class Patch:
    """The part of the surface that one touch can reach.

    faces: boundary triangles (f,). nodes: their nodes (s,). local: position of each face's nodes in ``nodes`` (f, 6).
    stiffness: w_q k_q of each Gauss point (f, 6) [N/m].
    """

    faces: np.ndarray
    nodes: np.ndarray
    local: np.ndarray
    stiffness: np.ndarray


def make_patch(mesh: QuadraticMesh, faces: np.ndarray, modulus: np.ndarray) -> Patch:
    """The patch of the given boundary triangles.

    Args:
        mesh: the mesh. faces: indices (f,). modulus: Young's modulus under every boundary triangle (all,) [Pa].
    """
    nodes, local = np.unique(mesh.faces[faces], return_inverse=True)
    area = mesh.face_area()[faces]
    size = np.sqrt(area)
    pressure_per_metre = PENALTY * modulus[faces] / size
    stiffness = (area * pressure_per_metre)[:, None] * WEIGHTS[None, :]
    return Patch(faces, nodes, local.reshape(len(faces), 6), stiffness)


def contact_matrices(patch: Patch, gap: np.ndarray, normal: np.ndarray,
                     curvature: np.ndarray, *, bend: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows and curvature block of the active Gauss points.

    Args:
        patch: the touch's patch. gap (f, 6) [m], normal (f, 6, 3), curvature (f, 6, 3, 3) [1/m]: from the kernel.
        bend: also the geometric part.

    Returns:
        rows (m, 3 s): derivative of each active gap by the patch's degrees of freedom; stiffness (m,) [N/m];
        geometric (3 s, 3 s) [N/m]: w k g Hess(g), negative semi-definite, or zeros.
    """
    f, q = np.nonzero(gap < 0.0)
    dof = 3 * patch.local[f][:, :, None] + np.arange(3)  # (m, 6, 3)
    values = SHAPE[q][:, :, None] * normal[f, q][:, None, :]
    m = len(f)
    rows = np.zeros((m, 3 * len(patch.nodes)))
    rows[np.arange(m)[:, None], dof.reshape(m, 18)] = values.reshape(m, 18)
    stiffness = patch.stiffness[f, q]
    geometric = np.zeros((rows.shape[1], rows.shape[1]))
    if not bend:
        return rows, stiffness, geometric
    weight = stiffness * gap[f, q]
    blocks = np.einsum("m,ma,mb,mcd->macbd", weight, SHAPE[q], SHAPE[q], curvature[f, q]).reshape(m, 18, 18)
    flat = dof.reshape(m, 18)
    np.add.at(geometric, (flat[:, :, None], flat[:, None, :]), blocks)
    return rows, stiffness, geometric
