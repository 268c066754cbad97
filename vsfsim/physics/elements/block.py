"""A block: elements of one kind in a model, and what every element file provides.

A file ``elements/NAME.py`` is found by its name. It provides

    block(...) -> Block          makes a block, and refuses what the element cannot be
    kernels()                    its Warp kernels in double precision; ``kernels(law)`` of a solid element

and, where the default does not do,

    state_size(block)            numbers that a tangent stores per element and touch, besides the displacements; 0
    rest_stiffness(block)        (m, 3 a, 3 a) [N/m], rows node by node: the tangent at u = 0; `matrices` there
    softened(block)              a block whose stiffness at rest preconditions a deformed body better than its own;
                                 the block itself

``kernels()`` is what `element_kernels` makes of the Warp struct ``arguments`` and three Warp functions of one element t
whose nodes move by u (a x 3) [m]. The members of ``arguments`` are ``nodes`` (m, a) int32 and parameters of the block,
each with a row for every element, but for those that elements share: ``terms``, as of a foam.

    respond  (arguments, u, t)                           +dE/du (a x 3) [N], energy [J], and the smallest det F, 1 where
                                                         the element has none
    linearise(arguments, u, t, b, projected, state_out)  writes what the tangent of touch b stores to the column b of
                                                         state_out[t]: of a positive semi-definite tangent if projected
                                                         is 1, else of the true one
    multiply (arguments, u, x, t, b, state_in)           the tangent at u times x (a x 3)

A block that couples all of its nodes through one number, as a gas does through its volume (elements/gas.py), has
``COLLECTIVE = True`` in its file:

    share        (arguments, index, u_in, share_out)
    respond      (law, index, number_in, response_out)
    forces       (arguments, index, u_in, response_in, force_out, energy_out, det_out)
    share_change (arguments, index, at_in, x_in, share_out)
    multiply     (arguments, index, at_in, response_in, true_in, change_in, x_in, force_out)

are its kernels. share_out (m, B) float64 is each element's part of the number, or of its change along x. response_out
(RESPONSES, B) float64 is a function of the number, for a gas the pressure, its derivative and the energy. ``law(block,
device)`` is the array that `respond` takes. `Elasticity` adds the shares in a fixed order.
"""

import functools
import importlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.runtime import real


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
        struct = self.kernels().arguments
        out = struct()
        for name, member in struct.vars.items():
            given = self.nodes if name == "nodes" else self.parameters[name]
            setattr(out, name, wp.array(given, dtype=member.type.dtype, device=device))
        return out

    def part(self, rows: slice, nodes: np.ndarray) -> "Block":
        """The elements ``rows`` with other ``nodes`` (k, a)."""
        return replace(self, nodes=nodes, parameters={
            name: value if name == "terms" else value[rows] for name, value in self.parameters.items()})

    @property
    def collective(self) -> bool:
        """Whether the block couples all of its nodes through one number."""
        return getattr(self.element, "COLLECTIVE", False)

    @property
    def state_size(self) -> int:
        """Numbers that a tangent stores per element and touch."""
        return self.element.state_size(self) if hasattr(self.element, "state_size") else 0

    def rest_stiffness(self) -> np.ndarray:
        """The sparse part of the tangent at u = 0 (m, 3 a, 3 a) [N/m], rows node by node."""
        own = getattr(self.element, "rest_stiffness", None)
        return own(self) if own else self.matrices(np.zeros(3 * (int(self.nodes.max(initial=-1)) + 1)))

    def softened(self) -> "Block":
        """The block to precondition with: this one, unless its element says otherwise."""
        return self.element.softened(self) if hasattr(self.element, "softened") else self

    def matrices(self, u: np.ndarray, state: np.ndarray | None = None) -> np.ndarray:
        """Tangents of the elements at displacements u (3 n,) [m], (m, 3 a, 3 a) [N/m]: products with the unit vectors
        of their own nodes, on the CPU.

        Args:
            state: what the tangents store (m, `state_size`); None for the true tangents at u.
        """
        own, (count, width) = self.kernels(), self.nodes.shape
        alone = self.part(slice(None), np.arange(count * width, dtype=np.int32).reshape(count, width)).arguments("cpu")
        at = u[3 * self.nodes.reshape(-1, 1).astype(np.int64) + np.arange(3)]
        index = wp.zeros(3 * width, dtype=wp.int32, device="cpu")
        moved = wp.array(at.reshape(-1, 1), dtype=real, device="cpu")
        stored = wp.zeros((count, self.state_size, 1), dtype=real, device="cpu")
        if state is not None:
            stored = wp.array(state.reshape(count, -1, 1), dtype=real, device="cpu")
        elif own.tangent is not None:
            wp.launch(own.tangent, dim=(count, 1), inputs=[alone, index, 0, moved, stored], device="cpu")
        out = wp.empty((count, 3 * width, 3 * width), dtype=real, device="cpu")
        wp.launch(own.multiply, dim=(count, 3 * width), device="cpu",
                  inputs=[alone, index, moved, stored, _units(count, 3 * width), out])
        return out.numpy()

    def __len__(self) -> int:
        return len(self.nodes)


@functools.lru_cache(maxsize=8)
def _units(count: int, size: int) -> wp.array:
    """The unit vectors of ``count`` elements with ``size`` degrees of freedom, below one another, on a CPU."""
    return wp.array(np.tile(np.eye(size), (count, 1)), dtype=real, device="cpu")


def elements_of(blocks: Iterable[Block]) -> list[tuple[str, str]]:
    """Kinds and laws of some blocks, each pair once."""
    return list(dict.fromkeys((block.kind, block.law) for block in blocks))


def kernels_of(kind: str, law: str) -> Any:
    """The kernels of elements of a ``kind`` under a ``law`` (empty for elements that take none)."""
    make = importlib.import_module(f"vsfsim.physics.elements.{kind}").kernels
    return make(law) if law else make()


def struct_of(module: str, **members: Any) -> Any:
    """The Warp struct of an element's arguments, compiled into ``module``: ``nodes`` and these members."""
    types = {"nodes": wp.array2d(dtype=wp.int32), **members}
    return wp.struct(type("Arguments", (), {"__annotations__": types, "__module__": __name__}), module=module)


def nodal(module: str, arguments: Any, nodes: int) -> Any:
    """Two Warp functions, compiled into ``module``: ``load`` reads vectors at the nodes of an element (``nodes`` x 3)
    from a column of an array (3 n, B), and ``store`` writes them to a column of one (m, 3 a, B)."""
    vectors = wp.types.matrix(shape=(nodes, 3), dtype=real)

    @wp.func(module=module)
    def load(of: arguments, x: wp.array2d(dtype=real), t: int, b: int):
        out = vectors()
        for a in range(nodes):
            row = 3 * of.nodes[t, a]
            for c in range(3):
                out[a, c] = x[row + c, b]
        return out

    @wp.func(module=module)
    def store(f: vectors, out: wp.array3d(dtype=real), t: int, b: int):
        for a in range(nodes):
            for c in range(3):
                out[t, 3 * a + c, b] = f[a, c]

    return SimpleNamespace(load=load, store=store)


def element_kernels(module: str, arguments: Any, nodes: int, *, respond: Any, multiply: Any,
                    linearise: Any = None) -> Any:
    """The kernels of an element with so many ``nodes`` from its functions, see above: ``forces``, ``tangent`` (None
    without ``linearise``), ``multiply``, and ``arguments``.

    They are launched over (m elements, k touches), so that neighbouring threads are neighbouring touches and read
    neighbouring numbers. Their arrays are

        index (k,) int32             the touch of each column
        u_in, at_in (3 n, B)         present displacements, and those at which the tangent was taken [m]
        force_out (m, 3 a, B)        of the element [N]; `forces` writes column index[k], `multiply` column k
        energy_out, det_out (m, B)   energy [J], smallest det F [-]
        state_out (m, state_size, B) what the tangent stores
        x_in (3 n, k)                the vectors to multiply
    """
    at_nodes = nodal(module, arguments, nodes)
    load, store, response, product = at_nodes.load, at_nodes.store, respond, multiply

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        of: arguments,
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
        force, energy, det = response(of, load(of, u_in, t, b), t)
        store(force, force_out, t, b)
        energy_out[t, b] = energy
        det_out[t, b] = det

    tangent = None
    if linearise is not None:

        @wp.kernel(module=module, enable_backward=False)
        def store_tangent(
            of: arguments,
            index: wp.array(dtype=wp.int32),
            projected: int,
            # state in
            u_in: wp.array2d(dtype=real),
            # state out
            state_out: wp.array3d(dtype=real),
        ):
            t, k = wp.tid()
            linearise(of, load(of, u_in, t, index[k]), t, index[k], projected, state_out)

        tangent = store_tangent

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        of: arguments,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        state_in: wp.array3d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        store(product(of, load(of, at_in, t, index[k]), load(of, x_in, t, k), t, index[k], state_in), force_out, t, k)

    return SimpleNamespace(forces=forces, tangent=tangent, multiply=multiply, arguments=arguments)
