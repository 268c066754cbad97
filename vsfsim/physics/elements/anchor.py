"""Anchor: a node tied to its own rest position, the particle of a volumetric stiffness field.

    E(u) = kappa V |u|^2 / 2

kappa is a stiffness density [N/m^4] and V the particle's volume [m^3]. The force depends only on the displacement of
the node itself, not on its neighbours, so kappa is not a modulus. An anchor therefore resists a rigid motion, and its
force is a support reaction. The element is linear: its tangent is the rest stiffness at every displacement, and
positive semi-definite.

Source: Z. Pan et al., visuo-tactile volumetric stiffness fields. The same model is an elastic foundation (Winkler 1867;
Johnson 1985, section 4.3).
"""

import functools
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block, element_kernels, struct_of
from vsfsim.physics.runtime import real


def block(nodes: np.ndarray, stiffness: np.ndarray) -> Block:
    """A block of anchors.

    Args:
        nodes: (m,).
        stiffness: kappa V of each anchor (m,) [N/m], not negative.
    """
    stiffness = np.asarray(stiffness, float)
    assert (stiffness >= 0.0).all()
    return Block("anchor", np.asarray(nodes, np.int32).reshape(-1, 1), {"stiffness": stiffness})


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    module, vector = "vsfsim_anchor", wp.types.matrix(shape=(1, 3), dtype=real)
    arguments = struct_of(module, stiffness=wp.array(dtype=real))

    @wp.func(module=module)
    def respond(of: arguments, u: vector, t: int):
        force = of.stiffness[t] * u
        return force, real(0.5) * wp.ddot(force, u), real(1.0)

    @wp.func(module=module)
    def multiply(of: arguments, u: vector, x: vector, t: int, b: int, state_in: wp.array3d(dtype=real)):
        return of.stiffness[t] * x

    return element_kernels(module, arguments, 1, respond=respond, multiply=multiply)
