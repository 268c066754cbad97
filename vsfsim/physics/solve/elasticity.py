"""All elements of a body on the device: forces, energy, tangent products, for the columns of a batch.

Every element writes its own forces, and a node then adds those of its elements in a fixed order: the sum is the same on
every run, which atomics do not guarantee.
"""

import functools
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.elements.block import Block
from vsfsim.physics.linear.cholesky import Order
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import real, vec3

_TOGETHER = 1024  # elements whose tangents are made at once
_CHUNKS = 64  # partial sums of a touch: enough threads for a GPU, and the same sum on every device and in every batch


@wp.kernel(module="vsfsim_elasticity", enable_backward=False)
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


@wp.kernel(module="vsfsim_elasticity", enable_backward=False)
def add(
    # model
    index: wp.array(dtype=wp.int32),
    compact: int,  # as in `gather`
    rows: int,  # that one sum is of
    # state in
    value_in: wp.array2d(dtype=real),
    # state out
    sum_out: wp.array2d(dtype=real),
):
    p, k = wp.tid()
    b = k
    if compact == 0:
        b = index[k]
    total = real(0.0)
    for t in range(p * rows, wp.min((p + 1) * rows, value_in.shape[0])):
        total += value_in[t, b]
    sum_out[p, b] = total


def _add(index: wp.array, compact: int, values: wp.array, parts: wp.array, out: wp.array) -> None:
    """Sums of ``values`` (m, B) over its rows -> ``out`` (B,), by way of ``parts`` (_CHUNKS, B); see `gather`."""
    whole = out.reshape((1, len(out)))
    for rows, given, found in ((-(-values.shape[0] // _CHUNKS), values, parts), (_CHUNKS, parts, whole)):
        wp.launch(add, dim=(found.shape[0], len(index)), inputs=[index, compact, rows, given, found],
                  device=out.device)


class Elements:
    """The elements of one block, each on its own.

    Args:
        block: a block of the model.
        device: Warp device.
    """

    part: tuple[wp.array, ...]
    """Forces on the nodes of each element (m, 3 a, B) [N], energies (m, B) [J] and least det F (m, B) [-]."""
    state: wp.array
    """What the elements know of their tangents (m, state_size, B)."""

    def __init__(self, block: Block, device: str):
        self.block, self._device = block, device
        self._model, self._own = block.arguments(device), block.kernels()

    def begin(self, batch: int, part: tuple[wp.array, ...], at: wp.array) -> None:
        """Room for ``batch`` touches; ``at``: displacements of the tangent (3 n, B) [m]."""
        self.part, self._at = part, at
        size = len(self.block), self.block.state_size, batch
        self.state = wp.zeros(size, dtype=real, device=self._device)

    def _launch(self, kernel: Any, index: wp.array, *more: Any) -> None:
        wp.launch(kernel, dim=(len(self.block), len(index)), inputs=[self._model, index, *more], device=self._device)

    def forces(self, index: wp.array, u: wp.array) -> None:
        """Renew `part`; see `Elasticity.forces`."""
        self._launch(self._own.forces, index, u, *self.part)

    def tangent(self, index: wp.array, u: wp.array, projected: bool) -> None:
        """See `Elasticity.tangent`."""
        if self._own.tangent is not None:
            self._launch(self._own.tangent, index, int(projected), u, self.state)

    def multiply(self, index: wp.array, x: wp.array) -> None:
        """Tangent times x (3 n, k) into the forces of `part`."""
        self._launch(self._own.multiply, index, self._at, self.state, x, self.part[0])


class Collective(Elements):
    """A block whose elements act through one number for each touch, as a gas through its volume; see
    `elements/block.py`."""

    number: wp.array
    """The number at the last `forces` (B,), float64."""
    response: wp.array
    """The response to it (RESPONSES, B), float64; see `elements/block.py`."""

    def begin(self, batch: int, part: tuple[wp.array, ...], at: wp.array) -> None:
        """See `Elements`."""
        super().begin(batch, part, at)
        self._law = self._own.law(self.block, self._device)
        new = functools.partial(wp.zeros, dtype=wp.float64, device=self._device)
        self._shares, self._parts = new((len(self.block), batch)), new((_CHUNKS, batch))
        self.number, self._tangent_number, self._true, self._change = (new(batch) for _ in range(4))
        self.response, self._tangent_response = (new((self.block.element.RESPONSES, batch)) for _ in range(2))

    def _respond(self, index: wp.array, u: wp.array, number: wp.array, response: wp.array) -> None:
        self._launch(self._own.share, index, u, self._shares)
        _add(index, 0, self._shares, self._parts, number)
        wp.launch(self._own.respond, dim=len(index), inputs=[self._law, index, number, response], device=self._device)

    def forces(self, index: wp.array, u: wp.array) -> None:
        """The number at u, the response to it, and the forces."""
        self._respond(index, u, self.number, self.response)
        self._launch(self._own.forces, index, u, self.response, *self.part)

    def tangent(self, index: wp.array, u: wp.array, projected: bool) -> None:
        """Store the response at u, and whether the tangent is the true one."""
        self._respond(index, u, self._tangent_number, self._tangent_response)
        wp.to_torch(self._true)[wp.to_torch(index).long()] = float(not projected)

    def multiply(self, index: wp.array, x: wp.array) -> None:
        """See `Elements`."""
        self._launch(self._own.share_change, index, self._at, x, self._shares)
        _add(index, 1, self._shares, self._parts, self._change)
        self._launch(self._own.multiply, index, self._at, self._tangent_response, self._true, self._change, x,
                     self.part[0])


class Elasticity:
    """Device arrays of one model and one batch of touches; nothing is read back to the host here.

    Args:
        model: the body.
        device: Warp device.
    """

    internal: wp.array
    """Nodal forces (3 n, B) [N]; `forces` renews its columns, the others stay."""
    energy: wp.array
    """Elastic energy (B,) [J], float64; likewise."""
    least_det: wp.array
    """Least det F (B,) [-]; likewise."""

    def __init__(self, model: Model, *, device: str):
        self.device = device
        self.blocks = model.blocks
        self._points = len(model.mesh.points)
        self._each = [(Collective if block.collective else Elements)(block, device) for block in self.blocks]
        # slot s of the element forces belongs to node flat[s]; slots of one node in increasing order
        flat = np.concatenate([block.nodes.ravel() for block in self.blocks])
        count = np.bincount(flat, minlength=self._points)
        self._start = wp.array(np.concatenate([[0], np.cumsum(count)]), dtype=wp.int32, device=device)
        self._slot = wp.array(np.argsort(flat, kind="stable"), dtype=wp.int32, device=device)
        self._free = wp.array(model.free, dtype=real, device=device)
        self._every = wp.array(np.ones_like(model.free), dtype=real, device=device)

    def begin(self, batch: int) -> None:
        """Room for ``batch`` touches."""
        new = {"dtype": real, "device": self.device}
        slots = np.cumsum([0, *(block.nodes.size for block in self.blocks)])
        rows = np.cumsum([0, *(len(block) for block in self.blocks)])
        self._force = wp.zeros((int(slots[-1]), 3, batch), **new)
        self._energies = wp.zeros((int(rows[-1]), batch), **new)
        self._dets = wp.zeros((int(rows[-1]), batch), **new)
        self._at, self._parts = wp.zeros((3 * self._points, batch), **new), wp.zeros((_CHUNKS, batch), **new)
        for i, elements in enumerate(self._each):
            own, block = slice(int(rows[i]), int(rows[i + 1])), self.blocks[i]
            force = self._force[int(slots[i]):int(slots[i + 1])].reshape((len(block), 3 * block.nodes.shape[1], batch))
            elements.begin(batch, (force, self._energies[own], self._dets[own]), self._at)
        self.internal = wp.zeros((3 * self._points, batch), **new)
        self.energy = wp.zeros(batch, dtype=wp.float64, device=self.device)
        self.least_det = wp.zeros(batch, **new)

    def _gas(self) -> Collective | None:
        return next((each for each in self._each if each.block.kind == "gas"), None)

    @property
    def pressure(self) -> wp.array | None:
        """Gauge pressure of the first gas at the last `forces` (B,) [Pa], float64; None without a gas."""
        gas = self._gas()
        return None if gas is None else gas.response[0]

    @property
    def volume(self) -> wp.array | None:
        """Volume of the first gas (B,) [m^3], likewise."""
        gas = self._gas()
        return None if gas is None else gas.number

    def _gather(self, index: wp.array, free: wp.array, compact: int, out: wp.array) -> None:
        wp.launch(gather, dim=(self._points, len(index)), device=self.device,
                  inputs=[self._start, self._slot, free, index, compact, self._force, out])

    def forces(self, index: wp.array, u: wp.array) -> None:
        """Renew `internal`, `energy` and `least_det` of the columns ``index`` (k,) int32 for displacements u (3 n, B)
        [m]."""
        for elements in self._each:
            elements.forces(index, u)
        self._gather(index, self._every, 0, self.internal)
        at = wp.to_torch(index).long()
        _add(index, 0, self._energies, self._parts, self.energy)
        wp.to_torch(self.least_det)[at] = wp.to_torch(self._dets)[:, at].amin(dim=0)

    def energy_in(self, part: np.ndarray, touches: torch.Tensor, u: torch.Tensor) -> np.ndarray:
        """Share of the elastic energy in a ``part`` of each element (m,) [-]; arguments and result as of `det`."""
        energy = wp.to_torch(self._energies).cpu().numpy()
        return part @ energy / np.maximum(energy.sum(axis=0), 1e-300)

    def det(self, touches: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """The least det F that the elements have, of all ``touches`` (B,), at u (3 n, B) [m], where `forces` were
        renewed (B,) [-]."""
        return wp.to_torch(self.least_det).clone()

    def tangent(self, index: wp.array, u: wp.array, *, projected: bool) -> None:
        """Make the tangent of the columns ``index`` (k,) at u (3 n, B), projected to positive semi-definite or as it
        is."""
        at = wp.to_torch(index).long()
        wp.to_torch(self._at)[:, at] = wp.to_torch(u)[:, at]
        for elements in self._each:
            elements.tangent(index, u, projected)

    def add_matrices(self, touch: int, order: Order, values: np.ndarray) -> None:
        """Add the tangents of all elements of one touch, on a CPU, to the blocks ``values`` (b, 3, 3) [N/m] of a matrix
        in this ``order``, supports not held: products of each element with the unit vectors of its own nodes."""
        at = self._at.numpy()[:, touch]
        for block, state in zip(self.blocks, (each.state for each in self._each), strict=True):
            for first in range(0, len(block), _TOGETHER):
                rows = slice(first, first + _TOGETHER)
                nodes = block.nodes[rows].astype(np.int64)
                matrix = block.part(rows, nodes).matrices(at, state.numpy()[rows, :, touch])
                places = order.find(nodes[:, :, None], nodes[:, None, :])[:, :, None, :, None]
                entry = 9 * places + 3 * np.arange(3)[:, None, None] + np.arange(3)  # (m, a, 3, a, 3)
                on = np.broadcast_to(places >= 0, entry.shape)
                values.ravel()[:] += np.bincount(entry[on], matrix.reshape(entry.shape)[on], values.size)

    def of_elements(self, block: int) -> np.ndarray:
        """Nodal forces of each element of one block at the last `forces` (m, 3 a, B) [N], until the next product."""
        return self._each[block].part[0].numpy()

    def multiply(self, index: wp.array, x: wp.array, out: wp.array) -> None:
        """Tangent times x (3 n, k) [m] -> ``out`` (3 n, k): column j belongs to touch ``index[j]``; rows of held
        degrees of freedom are 0."""
        for elements in self._each:
            elements.multiply(index, x)
        self._gather(index, self._free, 1, out)


class LinearElasticity(Elasticity):
    """As `Elasticity`, with the forces K u, K the stiffness at rest, which is the tangent of every state: for the tier
    `linear`."""

    def __init__(self, model: Model, *, device: str):
        super().__init__(model, device=device)
        self._factor = model.factor
        self._held = torch.as_tensor(model.free, device=device)[:, None]

    def _times(self, u: torch.Tensor) -> torch.Tensor:
        if self.device == "cpu":
            return torch.as_tensor(self._factor.stiffness @ u.numpy())
        return self._factor.stiffness_on(self.device) @ u

    def forces(self, index: wp.array, u: wp.array) -> None:
        """See `Elasticity`; small strain has no det F, which is 1."""
        at = wp.to_torch(index).long()
        moved = wp.to_torch(u)[:, at]
        force = self._times(moved)
        wp.to_torch(self.internal)[:, at] = force
        wp.to_torch(self.energy)[at] = 0.5 * (moved * force).sum(dim=0)
        wp.to_torch(self.least_det).index_fill_(0, at, 1.0)

    def det(self, touches: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        """See `Elasticity`; those of the elements' own law."""
        index, at = wp.from_torch(touches.int()), wp.from_torch(u)
        super().forces(index, at)
        out = super().det(touches, u)
        self.forces(index, at)
        return out

    def energy_in(self, part: np.ndarray, touches: torch.Tensor, u: torch.Tensor) -> np.ndarray:
        """See `Elasticity`; where the elements' law is that of small strain."""
        index = wp.from_torch(touches)
        super().forces(index, wp.from_torch(1e-4 * u))
        out = super().energy_in(part, touches, u)
        self.forces(index, wp.from_torch(u))
        return out

    def law_error(self, touches: torch.Tensor, u: torch.Tensor) -> np.ndarray:
        """Estimated error of the force of all ``touches`` (B,) because small strain is not the law of the elements
        (B,) [-], at their equilibria u (3 n, B) [m].

        It is 1.5 times that of the energy, as where force and strain go with the depth; where they go with its powers
        1.5 and 0.5, as under a ball, it is 1.2 times. The energy that the elements' law has at u is far too large where
        elements turn or keep their volume: the nodes move on by some -s K^-1 f2, f2 being the part of the law's forces
        that is even in u, which shortens a bent plate and gives volumes back. This step does no work on the bodies,
        K u . K^-1 f2 = 0 without its part along u, and s is where a parabola through energy and slope at 0 and the
        energy at 1 is least, 1 at most.

        On 13 presses of `references/presses.json` by balls and a capsule, of one material at nu 0 to 0.49, with layers
        and with parts, `linear` differs from `fem-coarse` on the same mesh by up to 29 %. Where it does by over 2 %,
        this is 1 to 2.1 times the difference. Where a thin plate bends, the force is off by up to three times as much:
        there the rotation decides, see `mesh.resolved.TURNED`.
        """
        index = wp.from_torch(touches)

        def of_law(moved: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            super(LinearElasticity, self).forces(index, wp.from_torch(moved))
            return wp.to_torch(self.energy).clone(), wp.to_torch(self.internal).clone()

        energy, force = of_law(u)
        even, linear = 0.5 * (force + of_law(-u)[1]) * self._held, self._times(u)
        small = 0.5 * (u * linear).sum(dim=0).clamp(min=1e-300)
        step = torch.as_tensor(self._factor.solve(even.cpu().numpy()), device=u.device)
        step -= 0.5 * (linear * step).sum(dim=0) / small * u
        slope = ((force - linear) * step).sum(dim=0)
        bend = (of_law(u - step)[0] - energy + slope).maximum(0.5 * slope.abs()).clamp(min=1e-300)
        self.forces(index, wp.from_torch(u))
        error = 1.5 * ((energy - 0.25 * slope**2 / bend) / small - 1.0).abs()
        return (error * (small > 1e-300)).cpu().numpy()  # what does not move has none

    def tangent(self, index: wp.array, u: wp.array, *, projected: bool) -> None:
        """It is always there."""

    def multiply(self, index: wp.array, x: wp.array, out: wp.array) -> None:
        """See `Elasticity`."""
        wp.to_torch(out).copy_(self._times(wp.to_torch(x)) * self._held)
