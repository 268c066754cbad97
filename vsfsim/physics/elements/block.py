"""A block: elements of one kind in a model, and what every element file provides.

A file ``elements/NAME.py`` is found by its name. It provides

    NODES                        nodes of one element, a
    block(...) -> Block          makes a block, and refuses what the element cannot be
    rest_stiffness(block)        (m, 3 a, 3 a) [N/m], rows node by node: the tangent at u = 0; (0, 3 a, 3 a) for none
    kernels()                    Warp kernels in double precision, see below; ``kernels(law)`` of a solid element
    state_size(block)            numbers that a tangent stores per element and touch, besides the displacements

``kernels()`` is an object with the Warp struct ``arguments``, whose members are ``nodes`` (m, a) int32 and parameters
of the block, each with a row for every element, but for those that elements share: ``terms``, as of a foam. Such a
struct comes first in

    forces   (arguments, index, u_in, force_out, energy_out, det_out)
    tangent  (arguments, index, projected, u_in, state_out)          or None if state_size is 0
    multiply (arguments, index, at_in, state_in, x_in, force_out)

launched over (m elements, k touches), so that neighbouring threads are neighbouring touches and read neighbouring
numbers. Their arrays are

    index (k,) int32             the touch of each column
    u_in, at_in (3 n, B)         present displacements, and those at which the tangent was taken [m]
    force_out (m, 3 a, B)        +dE/du of the element [N]; `forces` writes column index[k], `multiply` column k
    energy_out (m, B)            energy [J]
    det_out (m, B)               smallest det F of the element, 1 where it has none [-]
    state_out (m, state_size, B) what the tangent stores
    projected (int)              1 for a positive semi-definite tangent, 0 for the true one
    x_in (3 n, k)                the vectors to multiply

An element may also provide ``matrices(block, state)``, its tangents (m, 3 a, 3 a) from their stored states
(m, state_size). `matrices_at_rest` is then its rest stiffness, and a host solver can assemble the tangent at any state.

An element may provide ``softened(block)``, a block whose stiffness at rest preconditions a deformed body better than
its own.

A block that couples all of its nodes through one number, as a gas does through its volume (elements/gas.py), has
``COLLECTIVE = True`` in its file:

    share        (arguments, index, u_in, share_out)
    respond      (law, index, number_in, response_out)
    forces       (arguments, index, u_in, response_in, force_out, energy_out, det_out)
    share_change (arguments, index, at_in, x_in, share_out)
    multiply     (arguments, index, at_in, response_in, true_in, change_in, x_in, force_out)

share_out (m, B) float64 is each element's part of the number, or of its change along x. response_out (RESPONSES, B)
float64 is a function of the number, for a gas the pressure, its derivative and the energy. ``law(block, device)`` is
the array that `respond` takes. `Elasticity` adds the shares in a fixed order.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Block:
    """Elements of one kind."""

    kind: str
    """Name of the element's file."""
    nodes: np.ndarray
    """Nodes of each element (m, a), int32."""
    parameters: Mapping[str, np.ndarray]
    """Parameters of each element (m, ...); the element's file gives their units."""
    law: str = ""
    """Name of the law of a solid element's material, see `vsfsim.physics.laws`; empty for other elements."""

    @property
    def element(self) -> ModuleType:
        """The element's module."""
        return importlib.import_module(f"vsfsim.physics.elements.{self.kind}")

    def kernels(self) -> Any:
        """The element's kernels."""
        return kernels_of(self.kind, self.law)

    def arguments(self, device: str) -> Any:
        """The first argument of its kernels, on a Warp ``device``."""
        import warp as wp

        struct = self.kernels().arguments
        out = struct()
        for name, member in struct.vars.items():
            given = self.nodes if name == "nodes" else self.parameters[name]
            setattr(out, name, wp.array(given, dtype=member.type.dtype, device=device))
        return out

    def part(self, rows: slice, nodes: np.ndarray) -> Block:
        """The elements ``rows`` with other ``nodes`` (k, a)."""
        return replace(self, nodes=nodes, parameters={
            name: value if name == "terms" else value[rows] for name, value in self.parameters.items()})

    @property
    def collective(self) -> bool:
        """Whether the block couples all of its nodes through one number."""
        return getattr(self.element, "COLLECTIVE", False)

    def softened(self) -> Block:
        """The block to precondition with: this one, unless its element says otherwise."""
        return self.element.softened(self) if hasattr(self.element, "softened") else self

    def __len__(self) -> int:
        return len(self.nodes)


def elements_of(blocks: Iterable[Block]) -> list[tuple[str, str]]:
    """Kinds and laws of some blocks, each pair once."""
    return list(dict.fromkeys((block.kind, block.law) for block in blocks))


def kernels_of(kind: str, law: str) -> Any:
    """The kernels of elements of a ``kind`` under a ``law`` (empty for elements that take none)."""
    make = importlib.import_module(f"vsfsim.physics.elements.{kind}").kernels
    return make(law) if law else make()


def matrices_at_rest(block: Block) -> np.ndarray:
    """True tangent at u = 0 (m, 3 a, 3 a) [N/m] of a block whose element has ``matrices``, by its own kernel on the
    CPU."""
    import warp as wp

    element, own = block.element, block.kernels()
    width = int(block.nodes.max()) + 1 if len(block) else 1
    state = wp.zeros((len(block), element.state_size(block), 1), dtype=wp.float64, device="cpu")
    wp.launch(own.tangent, dim=(len(block), 1), device="cpu", inputs=[
        block.arguments("cpu"), wp.zeros(1, dtype=wp.int32, device="cpu"), 0,
        wp.zeros((3 * width, 1), dtype=wp.float64, device="cpu"), state])
    return element.matrices(block, state.numpy()[:, :, 0])
