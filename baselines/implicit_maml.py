"""Implicit MAML (Rajeswaran et al. 2019) for many small regression tasks at once.

Meta-parameters theta are where every task starts. A task adapts by gradient descent on its regularised loss

    phi(theta) = argmin_phi  L_support(phi) + lambda/2 |phi - theta|^2

and the gradient of its query loss with respect to theta is, by the implicit function theorem and without unrolling the
descent,

    dL_query/dtheta = (I + H / lambda)^-1 grad L_query(phi),   H = Hessian of L_support at phi

which is solved by a few steps of conjugate gradients. The Hessian is divided by lambda + damping, as in the authors'
code: far from the inner minimum it need not be positive definite, and damping keeps the system positive definite. All
tasks of an outer step are one batch, whose parameters have a leading task axis. Gradients and products with the Hessian
are explicit (backpropagation, and Pearlmutter's forward pass over it, 1994), one matrix product a layer, because for
networks this small automatic differentiation would cost more than the arithmetic.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

Parameters = list[torch.Tensor]
_CG_TOLERANCE = {torch.float64: 1e-10, torch.float32: 1e-5}  # of the residual norm, relative to the right side


@dataclass(frozen=True)
class Batch:
    """Samples of B tasks, padded to the same number R."""

    x: torch.Tensor
    """Actions (B, R, inputs)."""
    token: torch.Tensor
    """Vector of each task's view (B, c); c may be 0."""
    y: torch.Tensor
    """Readings (B, R, outputs)."""
    weight: torch.Tensor
    """1 for a sample, 0 for padding (B, R)."""


class Table:
    """Samples of touches, kept on a device, from which the batches of many steps are gathered there: a step copies row
    numbers and no samples.

    Args:
        touches: of each touch the network's inputs (R_k, inputs) and outputs (R_k, outputs).
        dtype: of the batches. device: where they are.
    """

    def __init__(self, touches: Sequence[tuple[np.ndarray, np.ndarray]], dtype: torch.dtype, device: str):
        self._device = device
        lengths = [len(x) for x, _ in touches]
        ends = np.cumsum(lengths)
        self._rows = [np.arange(end - n, end) for n, end in zip(lengths, ends)]
        self._none = int(ends[-1])  # a row of zeros, which fills the shorter tasks of a batch
        x, y = (np.concatenate([touch[k] for touch in touches]) for k in (0, 1))
        self._x, self._y = (torch.as_tensor(np.concatenate([a, np.zeros((1, a.shape[1]))]), dtype=dtype, device=device)
                            for a in (x, y))

    def batch(self, tasks: Sequence[np.ndarray], token: torch.Tensor) -> Batch:
        """The samples of some touches of every task.

        Args:
            tasks: numbers of the touches of each of B tasks. token: of the tasks' views (B, c).
        """
        own = [np.concatenate([self._rows[k] for k in touches]) for touches in tasks]
        rows = np.full((len(own), max(1, max(len(r) for r in own))), self._none)
        for row, found in zip(rows, own):
            row[:len(found)] = found
        where = torch.as_tensor(rows, device=self._device)
        return Batch(self._x[where], token, self._y[where], (where != self._none).to(self._x.dtype))


class Network:
    """A perceptron from action (and view) to reading. Parameters are lists of tensors, with or without a leading task
    axis.

    Args:
        inputs, outputs: sizes.
        token: size of the view's vector, 0 for no vision.
        hidden: widths.
        encoder: widths of the token's own perceptron, whose output is appended to the action.
    """

    def __init__(self, inputs: int, outputs: int, *, token: int, hidden: Sequence[int], encoder: Sequence[int]):
        self.shapes: list[tuple[int, int]] = []
        self.encoder = [token, *encoder] if token else []
        widths = [inputs + (encoder[-1] if token else 0), *hidden, outputs]
        for sizes in (self.encoder, widths):
            self.shapes += list(itertools.pairwise(sizes))
        self.split = max(len(self.encoder) - 1, 0)

    def start(self, generator: torch.Generator, *, dtype: torch.dtype = torch.float64) -> Parameters:
        """Initial parameters, uniform within 1 / sqrt(fan in); the draws do not depend on ``dtype``."""
        out: Parameters = []
        for a, b in self.shapes:
            for shape in ((a, b), (1, b)):
                drawn = (2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0) / a**0.5
                out.append(drawn.to(dtype))
        return out

    def __call__(self, parameters: Parameters, x: torch.Tensor, token: torch.Tensor) -> torch.Tensor:
        """Readings (B, R, outputs) of actions ``x`` (B, R, inputs) on views ``token`` (B, c)."""
        if self.split:
            code = _perceptron(parameters[:2 * self.split], token[:, None])
            x = torch.cat([x, code.expand(-1, x.shape[1], -1)], dim=2)
        return _perceptron(parameters[2 * self.split:], x)

    def loss(self, parameters: Parameters, batch: Batch) -> torch.Tensor:
        """Mean squared error of every task (B,); 0 for one without samples."""
        error = ((self(parameters, batch.x, batch.token) - batch.y) ** 2).mean(dim=2)
        return (error * batch.weight).sum(dim=1) / batch.weight.sum(dim=1).clamp_min(1.0)

    def gradient(self, parameters: Parameters, batch: Batch) -> Parameters:
        """Gradient of every task's loss with respect to its own parameters (each with a leading task axis)."""
        return self._pass(parameters, batch).gradient

    def curvature(self, parameters: Parameters, batch: Batch) -> Curvature:
        """The Hessian of every task's loss, as products with vectors."""
        return Curvature(self, parameters, self._pass(parameters, batch))

    def _pass(self, parameters: Parameters, batch: Batch) -> _Pass:
        own, rest = parameters[:2 * self.split], parameters[2 * self.split:]
        x, code = batch.x, None
        if self.split:
            code = _forward(own, batch.token[:, None])
            x = torch.cat([x, code[-1].expand(-1, x.shape[1], -1)], dim=2)
        layers = _forward(rest, x)
        count = batch.weight.sum(dim=1, keepdim=True).clamp_min(1.0)
        share = (2.0 / batch.y.shape[2]) * (batch.weight / count)[:, :, None]
        gradient, errors = _backward(rest, layers, share * (layers[-1] - batch.y))
        code_errors: Parameters = []
        if self.split:
            into = torch.bmm(errors[0], rest[0][:, batch.x.shape[2]:].transpose(1, 2)).sum(dim=1, keepdim=True)
            first, code_errors = _backward(own, code, into)
            gradient = first + gradient
        return _Pass(layers, errors, code or [], code_errors, share, batch.x.shape[2], gradient)


@dataclass(frozen=True)
class _Pass:
    """What a product with the Hessian needs of a forward and a backward pass."""

    layers: Parameters
    """Input of each layer, and the output (B, R, width)."""
    errors: Parameters
    """Gradient of the loss with respect to each layer's output before its ReLU."""
    code: Parameters
    """``layers`` of the token's perceptron, or empty."""
    code_errors: Parameters
    """``errors`` of the token's perceptron, or empty."""
    share: torch.Tensor
    """Second derivative of the loss by the network's output (B, R, 1)."""
    inputs: int
    """Number of inputs of an action."""
    gradient: Parameters
    """Of the loss with respect to the parameters."""


class Curvature:
    """The Hessian of the loss at some parameters; ``at @ v`` is its product with v, task by task. A ReLU has no
    curvature of its own."""

    def __init__(self, network: Network, parameters: Parameters, at: _Pass):
        self._split, self._at = 2 * network.split, at
        self._own, self._rest = parameters[:self._split], parameters[self._split:]

    def __matmul__(self, v: Parameters) -> Parameters:
        at, own, rest = self._at, v[:self._split], v[self._split:]
        change = None
        if self._split:
            moved = _forward_change(self._own, own, at.code, None)
            change = torch.cat([torch.zeros_like(at.layers[0][:, :, :at.inputs]),
                                moved[-1].expand(-1, at.layers[0].shape[1], -1)], dim=2)
        layers = _forward_change(self._rest, rest, at.layers, change)
        out, errors = _backward_change(self._rest, rest, at.layers, layers, at.errors, at.share * layers[-1])
        if self._split:
            into = (torch.bmm(errors[0], self._rest[0][:, at.inputs:].transpose(1, 2))
                    + torch.bmm(at.errors[0], rest[0][:, at.inputs:].transpose(1, 2)))
            out = _backward_change(self._own, own, at.code, moved, at.code_errors,
                                   into.sum(dim=1, keepdim=True))[0] + out
        return out


def _forward(parameters: Parameters, x: torch.Tensor) -> Parameters:
    """The input of every layer, and the output (each (B, R, width))."""
    out = [x]
    for i in range(0, len(parameters), 2):
        x = torch.baddbmm(parameters[i + 1], x, parameters[i])
        if i + 2 < len(parameters):
            x = x.clamp_min_(0.0)
        out.append(x)
    return out


def _through(change: torch.Tensor, layer: torch.Tensor) -> torch.Tensor:
    """``change`` where a ReLU's output ``layer`` is above 0, else 0, in one operation."""
    return torch.ops.aten.threshold_backward(change, layer, 0.0)


def _backward(parameters: Parameters, layers: Parameters, error: torch.Tensor) -> tuple[Parameters, Parameters]:
    """Gradient with respect to the parameters, and to every layer's output before its ReLU, from that of the last
    one."""
    gradient, errors = [torch.empty(0)] * len(parameters), [error]
    for i in range(len(parameters) - 2, -1, -2):
        x = layers[i // 2]
        gradient[i], gradient[i + 1] = torch.bmm(x.transpose(1, 2), error), error.sum(dim=1, keepdim=True)
        if i:
            error = _through(torch.bmm(error, parameters[i].transpose(1, 2)), x)
            errors.insert(0, error)
    return gradient, errors


def _forward_change(parameters: Parameters, v: Parameters, layers: Parameters,
                    change: torch.Tensor | None) -> Parameters:
    """Directional derivative of ``layers`` along ``v``; ``change``: that of the input, None for zero."""
    out = [torch.zeros_like(layers[0]) if change is None else change]
    for i in range(0, len(parameters), 2):
        after = torch.baddbmm(v[i + 1], layers[i // 2], v[i])
        if change is not None:
            after = torch.baddbmm(after, change, parameters[i])
        change = _through(after, layers[i // 2 + 1]) if i + 2 < len(parameters) else after
        out.append(change)
    return out


def _backward_change(parameters: Parameters, v: Parameters, layers: Parameters, moved: Parameters, errors: Parameters,
                     change: torch.Tensor) -> tuple[Parameters, Parameters]:
    """Directional derivative of the result of `_backward` along ``v``, from that of the last error, ``change``."""
    out, changes = [torch.empty(0)] * len(parameters), [change]
    for i in range(len(parameters) - 2, -1, -2):
        k = i // 2
        out[i] = torch.baddbmm(torch.bmm(layers[k].transpose(1, 2), change), moved[k].transpose(1, 2), errors[k])
        out[i + 1] = change.sum(dim=1, keepdim=True)
        if i:
            change = _through(torch.baddbmm(torch.bmm(change, parameters[i].transpose(1, 2)), errors[k],
                                            v[i].transpose(1, 2)), layers[k])
            changes.insert(0, change)
    return out, changes


def _perceptron(parameters: Parameters, x: torch.Tensor) -> torch.Tensor:
    for i in range(0, len(parameters), 2):
        x = x @ parameters[i] + parameters[i + 1]
        if i + 2 < len(parameters):
            x = torch.relu(x)
    return x


def _joined(parameters: Parameters) -> torch.Tensor:
    """All parameters of every task in one vector (B, P), on which few operations do what many do on a list."""
    return torch.cat([p.flatten(1) for p in parameters], dim=1)


def _parted(vectors: torch.Tensor, like: Parameters) -> Parameters:
    """Views of ``vectors`` (B, P) as parameters of the shapes of ``like``, whose task axis does not count."""
    parts = vectors.split([p[0].numel() for p in like], dim=1)
    return [part.reshape(len(vectors), *p.shape[1:]) for part, p in zip(parts, like)]


def adapt(network: Network, theta: Parameters, batch: Batch, *, rate: float, steps: int,
          regularisation: float) -> Parameters:
    """phi of every task: gradient descent from theta on the regularised support loss."""
    start = [p.detach()[None] for p in theta]
    anchor = _joined(start)
    phi = anchor.repeat(len(batch.x), 1)
    for _ in range(steps):
        gradient = _joined(network.gradient(_parted(phi, start), batch))
        phi = torch.lerp(phi, anchor, rate * regularisation).sub_(gradient, alpha=rate)
    return _parted(phi, start)


def implicit_gradient(network: Network, phi: Parameters, support: Batch, query: Batch, *, steps: int,
                      regularisation: float, damping: float = 0.0) -> Parameters:
    """Gradient of every task's query loss with respect to theta (each (B, ...)), by conjugate gradients.

    Args:
        network: from action to reading. phi: what every task adapted to. support, query: samples. steps: the most of
        them; with the papers' damping four reach a relative residual of 1e-10 in float64. regularisation: of the inner
        loop, lambda. damping: added to it.
    """
    hessian, divisor = network.curvature(phi, support), regularisation + damping
    residual = _joined(network.gradient(phi, query))
    direction, solution, size = residual.clone(), torch.zeros_like(residual), _dot(residual, residual)
    small_enough, tiny = _CG_TOLERANCE[size.dtype] ** 2 * size, torch.finfo(size.dtype).tiny
    for _ in range(steps):
        if (size <= small_enough).all():
            break
        image = direction + _joined(hessian @ _parted(direction, phi)) / divisor
        curvature = _dot(direction, image)
        # A task that is solved, or whose curvature is negative, keeps its solution.
        step = torch.where((curvature > 0.0) & (size > 0.0), size / curvature.clamp_min(tiny), 0.0)
        solution.add_(step * direction)
        residual.sub_(step * image)
        after = _dot(residual, residual)
        direction.mul_(after / size.clamp_min(tiny)).add_(residual)
        size = after
    return _parted(solution, phi)


def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a * b).sum(dim=1, keepdim=True)
