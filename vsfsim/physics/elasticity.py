"""All elements of a body on the device: forces, energy, tangent products, for the columns of a batch.

Every element writes its own forces; a node then adds up what its elements wrote, in a fixed order: the sum is the same on every
run, which atomics would not promise.
"""

import functools
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.model import Model

_CHUNKS = 64  # partial sums of energy for each touch: enough threads for a GPU, and the same sum on every device


@functools.cache
def kernels(real: type) -> Any:
    """What all elements share, for one scalar type."""
    vec3 = wp.types.vector(length=3, dtype=real)
    module = f"vsfsim_elasticity_{real.__name__}"

    @wp.kernel(module=module, enable_backward=False)
    def gather(
        # model
        start: wp.array(dtype=wp.int32),
        slot: wp.array(dtype=wp.int32),
        free: wp.array(dtype=real),
        index: wp.array(dtype=wp.int32),
        compact: int,  # 1: column k of both arrays, 0: column index[k]
        # state in
        element_in: wp.array3d(dtype=real),
        # state out
        node_out: wp.array2d(dtype=real),
    ):
        i, k = wp.tid()
        b = k
        if compact == 0:
            b = index[k]
        total = vec3()
        for s in range(start[i], start[i + 1]):
            at = slot[s]
            total += vec3(element_in[at, 0, b], element_in[at, 1, b], element_in[at, 2, b])
        for c in range(3):
            node_out[3 * i + c, b] = total[c] * free[3 * i + c]

    @wp.kernel(module=module, enable_backward=False)
    def remember(index: wp.array(dtype=wp.int32), u_in: wp.array2d(dtype=real), at_out: wp.array2d(dtype=real)):
        i, k = wp.tid()
        at_out[i, index[k]] = u_in[i, index[k]]

    @wp.kernel(module=module, enable_backward=False)
    def partial(
        # model
        index: wp.array(dtype=wp.int32),
        chunk: int,
        # state in
        energy_in: wp.array2d(dtype=real),
        det_in: wp.array2d(dtype=real),
        # state out
        energy_out: wp.array2d(dtype=wp.float64),
        det_out: wp.array2d(dtype=real),
    ):
        p, k = wp.tid()
        b = index[k]
        total = wp.float64(0.0)
        least = real(1e30)
        for t in range(p * chunk, wp.min((p + 1) * chunk, energy_in.shape[0])):
            total += wp.float64(energy_in[t, b])
            least = wp.min(least, det_in[t, b])
        energy_out[p, b] = total
        det_out[p, b] = least

    @wp.kernel(module=module, enable_backward=False)
    def whole(
        # model
        index: wp.array(dtype=wp.int32),
        # state in
        energy_in: wp.array2d(dtype=wp.float64),
        det_in: wp.array2d(dtype=real),
        # state out
        energy_out: wp.array(dtype=wp.float64),
        det_out: wp.array(dtype=real),
    ):
        b = index[wp.tid()]
        total = wp.float64(0.0)
        least = real(1e30)
        for p in range(energy_in.shape[0]):
            total += energy_in[p, b]
            least = wp.min(least, det_in[p, b])
        energy_out[b] = total
        det_out[b] = least

    class Kernels:
        pass

    out = Kernels()
    out.gather, out.remember, out.partial, out.whole = gather, remember, partial, whole
    return out


class Elasticity:
    """Device arrays of one model and one batch of touches. Everything stays on the device; nothing is read back here.

    internal: nodal forces (3 n, B) [N], energy: elastic energy (B,) [J], least_det: least det F (B,) [-]; the columns of the last
    `forces` are renewed, the others stay as they were.

    Args:
        model: the body. device: Warp device. real: `wp.float32` or `wp.float64`.
    """

    def __init__(self, model: Model, *, device: str, real: type):
        self.device, self.real = device, real
        self.kernels = kernels(real)
        self.blocks = model.blocks
        self._points = len(model.mesh.points)
        self._of = [block.element.kernels(real) for block in self.blocks]
        self._model = [[wp.array(block.nodes, dtype=wp.int32, device=device), *k.parameters(block, device)]
                       for block, k in zip(self.blocks, self._of, strict=True)]
        # slot s of the element forces belongs to node flat[s]; slots of one node in increasing order
        flat = np.concatenate([block.nodes.ravel() for block in self.blocks])
        count = np.bincount(flat, minlength=self._points)
        self._start = wp.array(np.concatenate([[0], np.cumsum(count)]), dtype=wp.int32, device=device)
        self._slot = wp.array(np.argsort(flat, kind="stable"), dtype=wp.int32, device=device)
        self._free = wp.array(model.free, dtype=real, device=device)
        self._every = wp.array(np.ones_like(model.free), dtype=real, device=device)

    def begin(self, batch: int) -> None:
        """Room for ``batch`` touches."""
        new = {"dtype": self.real, "device": self.device}
        slots = np.cumsum([0, *(block.nodes.size for block in self.blocks)])
        rows = np.cumsum([0, *(len(block) for block in self.blocks)])
        self._force = wp.zeros((int(slots[-1]), 3, batch), **new)
        self._energies = wp.zeros((int(rows[-1]), batch), **new)
        self._dets = wp.zeros((int(rows[-1]), batch), **new)
        # the part of each block, as its element sees it
        self._part = [(self._force[int(slots[i]):int(slots[i + 1])].reshape((len(block), 3 * block.nodes.shape[1], batch)),
                       self._energies[int(rows[i]):int(rows[i + 1])], self._dets[int(rows[i]):int(rows[i + 1])])
                      for i, block in enumerate(self.blocks)]
        self._state = [wp.zeros((len(block), block.element.state_size(block), batch), **new) for block in self.blocks]
        self._at = wp.zeros((3 * self._points, batch), **new)
        self._partial_energy = wp.zeros((_CHUNKS, batch), dtype=wp.float64, device=self.device)
        self._partial_det = wp.zeros((_CHUNKS, batch), **new)
        self.internal = wp.zeros((3 * self._points, batch), **new)
        self.energy = wp.zeros(batch, dtype=wp.float64, device=self.device)
        self.least_det = wp.zeros(batch, **new)

    def _launch(self, kernel: Any, dim: tuple[int, ...], inputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device)

    def forces(self, index: wp.array, u: wp.array) -> None:
        """Renew `internal`, `energy` and `least_det` of the columns ``index`` (k,) int32 for displacements u (3 n, B) [m]."""
        k, count = self.kernels, len(index)
        for block, own, model, part in zip(self.blocks, self._of, self._model, self._part, strict=True):
            self._launch(own.forces, (len(block), count), [*model, index, u, *part])
        self._launch(k.gather, (self._points, count), [self._start, self._slot, self._every, index, 0, self._force, self.internal])
        chunk = -(-self._energies.shape[0] // _CHUNKS)
        self._launch(k.partial, (_CHUNKS, count), [index, chunk, self._energies, self._dets, self._partial_energy, self._partial_det])
        self._launch(k.whole, (count,), [index, self._partial_energy, self._partial_det, self.energy, self.least_det])

    def tangent(self, index: wp.array, u: wp.array, *, projected: bool) -> None:
        """Make the tangent of the columns ``index`` (k,) at u (3 n, B), projected to positive semi-definite or as it is."""
        self._launch(self.kernels.remember, (3 * self._points, len(index)), [index, u, self._at])
        for block, own, model, state in zip(self.blocks, self._of, self._model, self._state, strict=True):
            if own.tangent is not None:
                self._launch(own.tangent, (len(block), len(index)), [*model, index, int(projected), u, state])

    def multiply(self, index: wp.array, x: wp.array) -> wp.array:
        """Tangent times x (3 n, k) [m]: column j belongs to touch ``index[j]``; rows of held degrees of freedom are 0."""
        out = wp.empty_like(x)
        for block, own, model, state, part in zip(self.blocks, self._of, self._model, self._state, self._part, strict=True):
            self._launch(own.multiply, (len(block), len(index)), [*model, index, self._at, state, x, part[0]])
        self._launch(self.kernels.gather, (self._points, len(index)),
                     [self._start, self._slot, self._free, index, 1, self._force, out])
        return out
