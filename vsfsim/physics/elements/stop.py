"""Stop: a node in front of a frictionless rigid plate, as the membrane of a bubble is in front of its housing.

    E(z) = k p^2 (1/2 + p / (3 h)),     p = <-z>,  z = Z + u_z - v_z

The plate lies across z through a second node, its support, which bears the force. Z is the height of the node over it
at rest, u and v are the displacements of the two, and k is the penalty [N/m]. Beyond h = 0.2 mm the penalty hardens, so
a node does not pass through the plate whatever pushes it. E is convex: its tangent needs no projection.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block, element_kernels, struct_of
from vsfsim.physics.runtime import real

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


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    module, hard, nought = "vsfsim_stop", wp.constant(real(HARD)), wp.constant(real(0.0))
    vectors = wp.types.matrix(shape=(2, 3), dtype=real)
    arguments = struct_of(module, height=wp.array(dtype=real), stiffness=wp.array(dtype=real))

    @wp.func(module=module)
    def penetration(of: arguments, u: vectors, t: int):
        return wp.max(-(of.height[t] + u[0, 2] - u[1, 2]), nought)

    @wp.func(module=module)
    def pull(along: real):
        return vectors(nought, nought, along, nought, nought, -along)

    @wp.func(module=module)
    def respond(of: arguments, u: vectors, t: int):
        p = penetration(of, u, t)
        energy = of.stiffness[t] * p * p * (real(0.5) + p / (real(3.0) * hard))
        return pull(-of.stiffness[t] * p * (real(1.0) + p / hard)), energy, real(1.0)

    @wp.func(module=module)
    def multiply(of: arguments, u: vectors, x: vectors, t: int, b: int, state_in: wp.array3d(dtype=real)):
        p = penetration(of, u, t)
        stiffness = nought
        if p > nought:
            stiffness = of.stiffness[t] * (real(1.0) + real(2.0) * p / hard)
        return pull(stiffness * (x[0, 2] - x[1, 2]))

    return element_kernels(module, arguments, 2, respond=respond, multiply=multiply)
