"""A block: elements of one kind in a model, and what every element file provides.

A file ``elements/NAME.py`` is found by its name. It provides

    NODES                        nodes of one element, a
    block(...) -> Block          makes a block, and refuses what the element cannot be
    rest_stiffness(block)        (m, 3 a, 3 a) [N/m], rows node by node: the tangent at u = 0
    kernels(real)                Warp kernels for one scalar type, see below
    state_size(block)            numbers that the tangent of one element and touch remembers, besides the displacements

``kernels(real)`` is an object with ``parameters(block, device)``, the element's own device arrays, which follow the nodes in

    forces   (nodes, *parameters, index, u_in, force_out, energy_out, det_out)
    tangent  (nodes, *parameters, index, projected, u_in, state_out)          or None if there is nothing to remember
    multiply (nodes, *parameters, index, at_in, state_in, x_in, force_out)

launched over (m elements, k touches), so that neighbouring threads are neighbouring touches and read neighbouring numbers.
nodes (m, a) int32. index (k,) int32: the touch of each column. u_in, at_in (3 n, B) [m]: present displacements, and those of the
tangent. force_out (m, 3 a, B) [N]: forces of the element on its nodes' balance, i.e. +dE/du; `multiply` writes column k, `forces` column
index[k]. energy_out (m, B) [J]. det_out (m, B): least det F, 1 where the element has none. state_out (m, state_size, B).
projected (int): 1 for a positive semi-definite tangent, 0 for the true one. x_in (3 n, k): one column each.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import ModuleType

import numpy as np


@dataclass(frozen=True)
class Block:
    """Elements of one kind.

    kind: name of the element's file. nodes: of each element (m, a) int32.
    parameters: what the element needs besides, per element (m, ...); units in the element's file.
    """

    kind: str
    nodes: np.ndarray
    parameters: Mapping[str, np.ndarray]

    @property
    def element(self) -> ModuleType:
        """The element's file."""
        return importlib.import_module(f"vsfsim.physics.elements.{self.kind}")

    def __len__(self) -> int:
        return len(self.nodes)
