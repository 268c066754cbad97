"""Cell: four nodes, and a pressure that keeps the volume between them from vanishing.

    E(x) = k V (c^2 / 2 + c^4),     c = max(0, J0 - J),     J = (x_1 - x_0) x (x_2 - x_0) . (x_3 - x_0) / (6 V)

V is the volume at rest and J0 = `LEAST`. Above it the cell does nothing: a network of springs keeps its law at small
strain. Below it the pressure k (c + 4 c^3) opposes what springs do not, a cell that is pushed flat and inside out
(Teschner et al. 2004, "A versatile and robust model for geometrically complex deformable solids", section 3). It acts
early, for a network of springs alone softens in compression and gives way: its cells collapse one by one below about
half of their volume. It grows through J = 0, so a cell that was pushed through recovers.

The tangent is k V ((1 + 12 c^2) dJ (x) dJ - (c + 4 c^3) d2J); the projected one has its first term alone.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.elements.block import Block

NODES = 4
LEAST = 0.9
"""J0, volume over that at rest under which the pressure acts [-]."""


def block(nodes: np.ndarray, points: np.ndarray, stiffness: np.ndarray) -> Block:
    """A block of cells.

    Args:
        nodes: (m, 4), in any order, no volume 0.
        points: rest positions (n, 3) [m].
        stiffness: k (m,) [Pa], not negative.
    """
    turned = np.linalg.det(points[nodes[:, 1:]] - points[nodes[:, :1]]) < 0.0
    nodes = np.where(turned[:, None], nodes[:, [0, 2, 1, 3]], nodes)
    edges = points[nodes[:, 1:]] - points[nodes[:, :1]]
    volume = np.linalg.det(edges) / 6.0
    assert (volume > 0.0).all() and (np.asarray(stiffness) >= 0.0).all()
    return Block("cell", np.asarray(nodes, np.int32), {
        "edges": edges, "volume": volume, "stiffness": np.asarray(stiffness, float)})


def state_size(block: Block) -> int:
    """A tangent stores the factors of its two terms."""
    return 2


def rest_stiffness(block: Block) -> np.ndarray:
    """None: (0, 12, 12) [N/m]."""
    return np.zeros((0, 3 * NODES, 3 * NODES))


@functools.cache
def kernels(real: type) -> Any:
    """The kernels of this element for one scalar type."""
    vec3 = wp.types.vector(length=3, dtype=real)
    module = f"vsfsim_cell_{real.__name__}"
    onset = wp.constant(real(LEAST))

    @wp.func(module=module)
    def edge(nodes: wp.array2d(dtype=wp.int32), x: wp.array2d(dtype=real), t: int, a: int, b: int):
        i = 3 * nodes[t, 0]
        j = 3 * nodes[t, a]
        return vec3(x[j, b] - x[i, b], x[j + 1, b] - x[i + 1, b], x[j + 2, b] - x[i + 2, b])

    @wp.func(module=module)
    def give(out: wp.array3d(dtype=real), t: int, k: int, a: vec3, b: vec3, c: vec3):
        # forces on nodes 1 to 3, and what balances them on node 0
        for i in range(3):
            out[t, i, k] = -a[i] - b[i] - c[i]
            out[t, 3 + i, k] = a[i]
            out[t, 6 + i, k] = b[i]
            out[t, 9 + i, k] = c[i]

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        rest: wp.array2d(dtype=vec3),
        volume: wp.array(dtype=real),
        stiffness: wp.array(dtype=real),
        index: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        d1 = rest[t, 0] + edge(nodes, u_in, t, 1, b)
        d2 = rest[t, 1] + edge(nodes, u_in, t, 2, b)
        d3 = rest[t, 2] + edge(nodes, u_in, t, 3, b)
        whole = real(6.0) * volume[t]
        j = wp.dot(wp.cross(d1, d2), d3) / whole
        short = wp.max(onset - j, real(0.0))
        push = -stiffness[t] * short * (real(1.0) + real(4.0) * short * short) / real(6.0)
        give(force_out, t, b, push * wp.cross(d2, d3), push * wp.cross(d3, d1), push * wp.cross(d1, d2))
        energy_out[t, b] = stiffness[t] * volume[t] * short * short * (real(0.5) + short * short)
        det_out[t, b] = j

    @wp.kernel(module=module, enable_backward=False)
    def tangent(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        rest: wp.array2d(dtype=vec3),
        volume: wp.array(dtype=real),
        stiffness: wp.array(dtype=real),
        index: wp.array(dtype=wp.int32),
        projected: int,
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        state_out: wp.array3d(dtype=real),
    ):
        # k (1 + 12 c^2) / (36 V) (row 0) and -k (c + 4 c^3) / 6 (row 1) where the pressure acts
        t, k = wp.tid()
        b = index[k]
        d1 = rest[t, 0] + edge(nodes, u_in, t, 1, b)
        d2 = rest[t, 1] + edge(nodes, u_in, t, 2, b)
        d3 = rest[t, 2] + edge(nodes, u_in, t, 3, b)
        short = onset - wp.dot(wp.cross(d1, d2), d3) / (real(6.0) * volume[t])
        state_out[t, 0, b] = real(0.0)
        state_out[t, 1, b] = real(0.0)
        if short > real(0.0):
            state_out[t, 0, b] = stiffness[t] * (real(1.0) + real(12.0) * short * short) / (real(36.0) * volume[t])
            if projected == 0:
                state_out[t, 1, b] = -stiffness[t] * short * (real(1.0) + real(4.0) * short * short) / real(6.0)

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        rest: wp.array2d(dtype=vec3),
        volume: wp.array(dtype=real),
        stiffness: wp.array(dtype=real),
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        state_in: wp.array3d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        first = state_in[t, 0, b]
        second = state_in[t, 1, b]
        f1 = vec3()
        f2 = vec3()
        f3 = vec3()
        if first > real(0.0):
            d1 = rest[t, 0] + edge(nodes, at_in, t, 1, b)
            d2 = rest[t, 1] + edge(nodes, at_in, t, 2, b)
            d3 = rest[t, 2] + edge(nodes, at_in, t, 3, b)
            e1 = edge(nodes, x_in, t, 1, k)
            e2 = edge(nodes, x_in, t, 2, k)
            e3 = edge(nodes, x_in, t, 3, k)
            n1 = wp.cross(d2, d3)
            n2 = wp.cross(d3, d1)
            n3 = wp.cross(d1, d2)
            along = first * (wp.dot(n1, e1) + wp.dot(n2, e2) + wp.dot(n3, e3))
            f1 = along * n1 + second * (wp.cross(e2, d3) + wp.cross(d2, e3))
            f2 = along * n2 + second * (wp.cross(e3, d1) + wp.cross(d3, e1))
            f3 = along * n3 + second * (wp.cross(e1, d2) + wp.cross(d1, e2))
        give(force_out, t, k, f1, f2, f3)

    def parameters(block: Block, device: str) -> list[wp.array]:
        p = block.parameters
        return [wp.array(p["edges"], dtype=vec3, device=device),
                *(wp.array(p[name], dtype=real, device=device) for name in ("volume", "stiffness"))]

    return SimpleNamespace(forces=forces, tangent=tangent, multiply=multiply, parameters=parameters)
