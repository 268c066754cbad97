"""Spring: two nodes and the distance between them, at any deformation.

    E(x) = k/2 (l - L)^2,     l = |x_1 - x_0|,  n = (x_1 - x_0) / l

The derivative of E by x_1 is k (l - L) n, and the tangent is k n (x) n + k (1 - L/l) (I - n (x) n). A compressed spring
(l < L) is unstable sideways, so the projected tangent uses max(0, 1 - L/l). At l = 0 the direction is undefined and the
force is set to zero; the energy stays finite.

A network of springs has Cauchy's symmetry, C_ijkl = C_ikjl: Poisson's ratio of an isotropic network is 1/4 where its
nodes follow a uniform strain (Love 1927, note B; `coefficients.SPRING_ALONG`). `network` gives the ratios that
irregular networks have.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.elements.block import Block

NODES = 2


def block(nodes: np.ndarray, points: np.ndarray, stiffness: np.ndarray) -> Block:
    """A block of springs at their rest lengths.

    Args:
        nodes: (m, 2).
        points: rest positions (n, 3) [m].
        stiffness: k (m,) [N/m], not negative.
    """
    stiffness = np.asarray(stiffness, float)
    edge = points[nodes[:, 1]] - points[nodes[:, 0]]
    length = np.linalg.norm(edge, axis=1)
    assert (stiffness >= 0.0).all() and (length > 0.0).all()
    return Block("spring", np.asarray(nodes, np.int32), {"edge": edge, "length": length, "stiffness": stiffness})


def state_size(block: Block) -> int:
    """A tangent stores n and the stiffness across it."""
    return 4


def rest_stiffness(block: Block) -> np.ndarray:
    """The tangent at u = 0 (m, 6, 6) [N/m]."""
    p = block.parameters
    n = p["edge"] / p["length"][:, None]
    along = p["stiffness"][:, None, None] * n[:, :, None] * n[:, None, :]
    return np.block([[along, -along], [-along, along]])


@functools.cache
def kernels(real: type) -> Any:
    """The kernels of this element for one scalar type."""
    vec3 = wp.types.vector(length=3, dtype=real)
    module = f"vsfsim_spring_{real.__name__}"

    @wp.func(module=module)
    def difference(nodes: wp.array2d(dtype=wp.int32), x: wp.array2d(dtype=real), t: int, b: int):
        i = 3 * nodes[t, 0]
        j = 3 * nodes[t, 1]
        return vec3(x[j, b] - x[i, b], x[j + 1, b] - x[i + 1, b], x[j + 2, b] - x[i + 2, b])

    @wp.func(module=module)
    def stretch(edge: vec3, d: vec3, length: real):
        # l and l - L, the latter without cancellation: (l^2 - L^2) / (l + L)
        now = wp.length(edge + d)
        return now, wp.dot(d, real(2.0) * edge + d) / (now + length)

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        edge: wp.array(dtype=vec3),
        length: wp.array(dtype=real),
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
        d = difference(nodes, u_in, t, b)
        now, longer = stretch(edge[t], d, length[t])
        pull = vec3()
        if now > real(0.0):
            pull = (stiffness[t] * longer / now) * (edge[t] + d)
        for c in range(3):
            force_out[t, c, b] = -pull[c]
            force_out[t, 3 + c, b] = pull[c]
        energy_out[t, b] = real(0.5) * stiffness[t] * longer * longer
        det_out[t, b] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def tangent(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        edge: wp.array(dtype=vec3),
        length: wp.array(dtype=real),
        stiffness: wp.array(dtype=real),
        index: wp.array(dtype=wp.int32),
        projected: int,
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        state_out: wp.array3d(dtype=real),
    ):
        # direction n (rows 0-2) and the stiffness across it (row 3)
        t, k = wp.tid()
        b = index[k]
        d = difference(nodes, u_in, t, b)
        now, longer = stretch(edge[t], d, length[t])
        n = vec3()
        across = real(0.0)
        if now > real(0.0):
            n = (edge[t] + d) / now
            across = stiffness[t] * longer / now
        if projected == 1:
            across = wp.max(across, real(0.0))
        for c in range(3):
            state_out[t, c, b] = n[c]
        state_out[t, 3, b] = across

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        # model
        nodes: wp.array2d(dtype=wp.int32),
        edge: wp.array(dtype=vec3),
        length: wp.array(dtype=real),
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
        d = difference(nodes, x_in, t, k)
        n = vec3(state_in[t, 0, b], state_in[t, 1, b], state_in[t, 2, b])
        across = state_in[t, 3, b]
        pull = ((stiffness[t] - across) * wp.dot(n, d)) * n + across * d
        for c in range(3):
            force_out[t, c, k] = -pull[c]
            force_out[t, 3 + c, k] = pull[c]

    def parameters(block: Block, device: str) -> list[wp.array]:
        p = block.parameters
        return [wp.array(p["edge"], dtype=vec3, device=device),
                *(wp.array(p[name], dtype=real, device=device) for name in ("length", "stiffness"))]

    return SimpleNamespace(forces=forces, tangent=tangent, multiply=multiply, parameters=parameters)
