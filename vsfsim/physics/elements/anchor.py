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
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block
from vsfsim.physics.runtime import real

NODES = 1


def block(nodes: np.ndarray, stiffness: np.ndarray) -> Block:
    """A block of anchors.

    Args:
        nodes: (m,).
        stiffness: kappa V of each anchor (m,) [N/m], not negative.
    """
    stiffness = np.asarray(stiffness, float)
    assert (stiffness >= 0.0).all()
    return Block("anchor", np.asarray(nodes, np.int32).reshape(-1, 1), {"stiffness": stiffness})


def state_size(block: Block) -> int:
    """0: the tangent does not depend on the displacements."""
    return 0


def rest_stiffness(block: Block) -> np.ndarray:
    """The tangent at every displacement (m, 3, 3) [N/m]."""
    return block.parameters["stiffness"][:, None, None] * np.eye(3)


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    module = "vsfsim_anchor"

    class Anchors:  # see `block`
        nodes: wp.array2d(dtype=wp.int32)
        stiffness: wp.array(dtype=real)

    Anchors = wp.struct(Anchors, module=module)

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        of: Anchors,
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
        row = 3 * of.nodes[t, 0]
        energy = real(0.0)
        for c in range(3):
            u = u_in[row + c, b]
            force_out[t, c, b] = of.stiffness[t] * u
            energy += real(0.5) * of.stiffness[t] * u * u
        energy_out[t, b] = energy
        det_out[t, b] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        of: Anchors,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        state_in: wp.array3d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        row = 3 * of.nodes[t, 0]
        for c in range(3):
            force_out[t, c, k] = of.stiffness[t] * x_in[row + c, k]

    return SimpleNamespace(forces=forces, tangent=None, multiply=multiply, arguments=Anchors)
