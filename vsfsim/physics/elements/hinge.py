"""Hinge: the bending of a thin sheet, flat at rest, from the three hinges between a triangle and its neighbours.

    E(x) = A D/2 [ (1 - nu) (|h11|^2 + |h22|^2 + 2 |h12|^2) + nu |h11 + h22|^2 ],
    h_ab = d^2 x / dX_a dX_b,     D = E h^3 / (12 (1 - nu^2))

h (three vectors) is the second derivative of the one quadratic map that takes the six nodes of the triangle and its
three neighbours from their rest places X in the plane to their present ones. It is exact for every quadratic
deflection on any mesh whose six places are not on a conic, so D is the plate's bending stiffness. A sum of k theta^2
over dihedral angles is not exact: its D depends on the mesh (on equilateral triangles 3 |e|^2 theta^2 / (A1 + A2) bends
like a plate of Poisson's ratio -1/3, three times too stiff in a clamped disc; Seung and Nelson 1988, Phys. Rev. A 38;
Grinspun et al. 2003). The patch of four triangles is that of Onate and Flores 2005 (the rotation-free triangle EBST,
Comput. Methods Appl. Mech. Eng. 194).

Plate theory has the curvatures n . h; this energy has the vectors h themselves (as in Bergou et al. 2006, "A quadratic
bending model for inextensible surfaces"). It is therefore quadratic, its tangent is constant and positive
semi-definite, and a rotation costs no energy. In return the gradient of an in-plane strain is resisted as a curvature
is: relative to the membrane energy E h eps^2 this adds (h/L)^2/12 for a strain that varies over the length L, 1e-5 for
rubber of 0.5 mm.

At a rim edge there is no neighbour, and the straight continuation of the triangle takes its place: the rim may rotate.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block, element_kernels, struct_of
from vsfsim.physics.runtime import real

_SMALLEST_SINGULAR_VALUE = 0.02
"""Fraction of the largest singular value below which one is treated as zero. Six places on a conic leave one curvature
undetermined; it is then taken as zero."""


def block(triangles: np.ndarray, points: np.ndarray, rest: np.ndarray, bending: float, *,
          poisson_ratio: float = 0.5) -> Block:
    """The bending of a sheet.

    Args:
        triangles: of the whole sheet (m, 3), counter-clockwise in the rest plane.
        points: positions at u = 0 (n, 3) [m].
        rest: positions of the nodes where the sheet is flat and free of stress (n, 2) [m].
        bending: D [J].
        poisson_ratio: nu [-].
    """
    triangles = np.asarray(triangles, np.int64)
    across = neighbours(triangles)
    stencil = np.concatenate([triangles, np.where(across >= 0, across, triangles)], axis=1)
    continued = np.tile(np.eye(6), (len(triangles), 1, 1))
    place = rest[stencil]
    for k in range(3):
        rim = np.flatnonzero(across[:, k] < 0)
        p, q, o = (rest[triangles[rim, (k + i) % 3]] for i in (1, 2, 0))
        share = ((o - p) * (q - p)).sum(axis=1) / ((q - p) ** 2).sum(axis=1)
        place[rim, 3 + k] = 2.0 * (p + share[:, None] * (q - p)) - o
        straight = np.zeros((len(rim), 6))
        straight[:, (k + 1) % 3], straight[:, (k + 2) % 3], straight[:, k] = 2.0 * (1.0 - share), 2.0 * share, -1.0
        continued[rim, 3 + k] = straight
    centre = place.mean(axis=1, keepdims=True)
    size = np.linalg.norm(place - centre, axis=2).mean(axis=1)
    x, y = np.moveaxis((place - centre) / size[:, None, None], 2, 0)
    # The residual of the six places about their best plane determines the three second derivatives.
    rest_of = np.swapaxes(np.linalg.qr(np.stack([np.ones_like(x), x, y], axis=2), mode="complete")[0][:, :, 3:], 1, 2)
    quadratic = rest_of @ np.stack([0.5 * x * x, x * y, 0.5 * y * y], axis=2)
    fit = np.linalg.pinv(quadratic, rcond=_SMALLEST_SINGULAR_VALUE) @ rest_of
    b11, b12, b22 = (fit[:, i] / size[:, None] ** 2 for i in range(3))
    a, b, c = (rest[triangles[:, i]] for i in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    assert (area > 0.0).all() and bending > 0.0 and np.isfinite(fit).all()
    share = 1.0 - poisson_ratio
    curvatures = np.stack([b11, b22, b12, b11 + b22])
    energy = np.einsum("k,kmi,kmj->mij", [share, share, 2.0 * share, poisson_ratio], curvatures, curvatures)
    energy *= (bending * area)[:, None, None]
    return Block("hinge", stencil.astype(np.int32), {"edges": points[stencil] - points[stencil[:, :1]],
                                                     "stiffness": np.swapaxes(continued, 1, 2) @ energy @ continued})


def neighbours(triangles: np.ndarray) -> np.ndarray:
    """The node across the edge opposite each corner (m, 3); -1 on the rim."""
    edges = np.stack([triangles[:, [1, 2]], triangles[:, [2, 0]], triangles[:, [0, 1]]], axis=1).reshape(-1, 2)
    opposite = triangles.reshape(-1)
    other = {(int(i), int(j)): int(o) for (i, j), o in zip(edges, opposite, strict=True)}
    return np.array([other.get((int(j), int(i)), -1) for i, j in edges]).reshape(-1, 3)


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    module, vectors = "vsfsim_hinge", wp.types.matrix(shape=(6, 3), dtype=real)
    arguments = struct_of(module, edges=wp.array(dtype=vectors),
                          stiffness=wp.array(dtype=wp.types.matrix(shape=(6, 6), dtype=real)))

    @wp.func(module=module)
    def from_first(u: vectors):
        out = vectors()
        for a in range(1, 6):
            out[a] = u[a] - u[0]
        return out

    @wp.func(module=module)
    def respond(of: arguments, u: vectors, t: int):
        place = of.edges[t] + from_first(u)
        force = of.stiffness[t] * place
        return force, real(0.5) * wp.ddot(force, place), real(1.0)

    @wp.func(module=module)
    def multiply(of: arguments, u: vectors, x: vectors, t: int, b: int, state_in: wp.array3d(dtype=real)):
        return of.stiffness[t] * from_first(x)

    return element_kernels(module, arguments, 6, respond=respond, multiply=multiply)
