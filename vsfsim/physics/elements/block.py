"""A block: elements of one kind in a model, and what every element file provides.

A file ``elements/NAME.py`` is found by its name. It provides

    NODES                        nodes of one element, a
    block(...) -> Block          makes a block, and refuses what the element cannot be
    rest_stiffness(block)        (m, 3 a, 3 a) [N/m], rows node by node: the tangent at u = 0
    kernels(real)                Warp kernels for one scalar type, see below
    state_size(block)            numbers that the tangent of one element and touch remembers, besides the displacements

``kernels(real)`` is an object with ``parameters(block, device)``, the element's own device arrays, which follow the
nodes in

    forces   (nodes, *parameters, index, u_in, force_out, energy_out, det_out)
    tangent  (nodes, *parameters, index, projected, u_in, state_out)          or None if there is nothing to remember
    multiply (nodes, *parameters, index, at_in, state_in, x_in, force_out)

launched over (m elements, k touches), so that neighbouring threads are neighbouring touches and read neighbouring
numbers. nodes (m, a) int32. index (k,) int32: the touch of each column. u_in, at_in (3 n, B) [m]: present
displacements, and those of the tangent. force_out (m, 3 a, B) [N]: forces of the element on its nodes' balance, i.e.
+dE/du; `multiply` writes column k, `forces` column index[k]. energy_out (m, B) [J]. det_out (m, B): least det F, 1
where the element has none. state_out (m, state_size, B). projected (int): 1 for a positive semi-definite tangent, 0
for the true one. x_in (3 n, k): one column each.

An element whose law is long may also provide ``matrices(block, state)``, its tangents (m, 3 a, 3 a) from what they
remember (m, state_size): then `matrices_at_rest` is its rest stiffness, and a host solver can assemble the tangent at
any state.

A block that couples all of its nodes through one number, as a gas does through its volume (elements/gas.py), has
``COLLECTIVE = True`` in its file:

    share        (nodes, *parameters, index, u_in, share_out)
    respond      (law, index, number_in, answer_out)
    forces       (nodes, *parameters, index, u_in, answer_in, force_out, energy_out, det_out)
    share_change (nodes, *parameters, index, at_in, x_in, share_out)
    multiply     (nodes, *parameters, index, at_in, answer_in, true_in, change_in, x_in, force_out)

share_out (m, B) float64: each element's part of the number, or of its change along x. answer_out (ANSWERS, B) float64:
what the number causes. ``law(block, device)`` is the array that `respond` takes. `Elasticity` adds the shares in a
fixed order.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import numpy as np


@dataclass(frozen=True)
class Block:
    """Elements of one kind."""

    kind: str
    """Name of the element's file."""
    nodes: np.ndarray
    """Nodes of each element (m, a), int32."""
    parameters: Mapping[str, np.ndarray]
    """What the element needs besides, for each element (m, ...); the units are in the element's file."""

    @property
    def element(self) -> ModuleType:
        """The element's file."""
        return importlib.import_module(f"vsfsim.physics.elements.{self.kind}")

    @property
    def collective(self) -> bool:
        """Whether all its elements act through one number that they add up to."""
        return getattr(self.element, "COLLECTIVE", False)

    def __len__(self) -> int:
        return len(self.nodes)


def matrices_at_rest(block: Block) -> np.ndarray:
    """True tangent at u = 0 (m, 3 a, 3 a) [N/m] of a block whose element has ``matrices``, by its own kernel on the
    CPU."""
    import warp as wp

    element, own = block.element, block.element.kernels(wp.float64)
    width = int(block.nodes.max()) + 1 if len(block) else 1
    state = wp.zeros((len(block), element.state_size(block), 1), dtype=wp.float64, device="cpu")
    wp.launch(own.tangent, dim=(len(block), 1), device="cpu", inputs=[
        wp.array(block.nodes, dtype=wp.int32, device="cpu"), *own.parameters(block, "cpu"),
        wp.zeros(1, dtype=wp.int32, device="cpu"), 0,
        wp.zeros((3 * width, 1), dtype=wp.float64, device="cpu"), state])
    return element.matrices(block, state.numpy()[:, :, 0])
