"""Stop: a node in front of a frictionless rigid plate, as the membrane of a bubble is in front of its housing.

    E(z) = k p^2 (1/2 + p / (3 h)),     p = <-z>,  z = Z + u_z - v_z

The plate lies across z through a second node, its support, which bears the force. Z is the height of the node over it
at rest, u and v are the displacements of the two, and k is the penalty [N/m]. Beyond h = 0.2 mm the penalty hardens, so
a node does not pass through the plate whatever pushes it. E is convex: its tangent needs no projection.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block
from vsfsim.physics.runtime import real

NODES = 2
HARD = 2e-4
"""h, the penetration at which the penalty hardens [m]."""


def block(nodes: np.ndarray, support: int, points: np.ndarray, stiffness: float, *, below: float = 0.0) -> Block:
    """A block of stops.

    Args:
        nodes: the stopped nodes (m,).
        support: node of the plate.
        points: rest positions (n, 3) [m].
        stiffness: k [N/m], positive.
        below: how far the plate is under its node [m].
    """
    height = points[nodes, 2] - points[support, 2] + below
    assert stiffness > 0.0 and (height >= 0.0).all()
    return Block("stop", np.column_stack([nodes, np.full(len(nodes), support)]).astype(np.int32),
                 {"height": height, "stiffness": np.full(len(nodes), float(stiffness))})


def state_size(block: Block) -> int:
    """A tangent follows from the displacements."""
    return 0


def rest_stiffness(block: Block) -> np.ndarray:
    """The tangent at u = 0, where no node is behind the plane: zero (m, 6, 6) [N/m]."""
    return np.zeros((len(block), 6, 6))


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    module, hard = "vsfsim_stop", wp.constant(real(HARD))

    class Stops:  # see `block`
        nodes: wp.array2d(dtype=wp.int32)
        height: wp.array(dtype=real)
        stiffness: wp.array(dtype=real)

    Stops = wp.struct(Stops, module=module)

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        of: Stops,
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
        p = wp.max(-(of.height[t] + u_in[3 * of.nodes[t, 0] + 2, b] - u_in[3 * of.nodes[t, 1] + 2, b]), real(0.0))
        push = of.stiffness[t] * p * (real(1.0) + p / hard)
        for c in range(2):
            force_out[t, c, b] = real(0.0)
            force_out[t, 3 + c, b] = real(0.0)
        force_out[t, 2, b] = -push
        force_out[t, 5, b] = push
        energy_out[t, b] = of.stiffness[t] * p * p * (real(0.5) + p / (real(3.0) * hard))
        det_out[t, b] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        of: Stops,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        state_in: wp.array3d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        i = 3 * of.nodes[t, 0] + 2
        j = 3 * of.nodes[t, 1] + 2
        p = -(of.height[t] + at_in[i, index[k]] - at_in[j, index[k]])
        out = real(0.0)
        if p > real(0.0):
            out = of.stiffness[t] * (real(1.0) + real(2.0) * p / hard) * (x_in[i, k] - x_in[j, k])
        for c in range(2):
            force_out[t, c, k] = real(0.0)
            force_out[t, 3 + c, k] = real(0.0)
        force_out[t, 2, k] = out
        force_out[t, 5, k] = -out

    return SimpleNamespace(forces=forces, tangent=None, multiply=multiply, arguments=Stops)
