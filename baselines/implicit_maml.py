"""Implicit MAML (Rajeswaran et al. 2019) for many small regression tasks at once.

Meta-parameters theta are where every task starts. A task adapts by gradient descent on its regularised loss

    phi(theta) = argmin_phi  L_support(phi) + lambda/2 |phi - theta|^2

and the gradient of its query loss with respect to theta is, by the implicit function theorem and without unrolling the
descent,

    dL_query/dtheta = (I + H / lambda)^-1 grad L_query(phi),   H = Hessian of L_support at phi

which is solved by a few steps of conjugate gradients. The Hessian is divided by lambda + damping, as in the authors'
code: far from the inner minimum it need not be positive definite, and damping keeps the system positive definite. All
tasks of an outer step are one batch: their parameters are the rows of a matrix (B, P).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch.nn import functional

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
    """A perceptron from action (and view) to reading, whose P parameters are one vector.

    Args:
        inputs, outputs: sizes.
        token: size of the view's vector, 0 for no vision.
        hidden: widths.
        encoder: widths of the token's own perceptron, whose output is appended to the action.
    """

    def __init__(self, inputs: int, outputs: int, *, token: int, hidden: Sequence[int], encoder: Sequence[int]):
        own = [token, *encoder] if token else []
        widths = [inputs + (encoder[-1] if token else 0), *hidden, outputs]
        self.shapes = [*itertools.pairwise(own), *itertools.pairwise(widths)]
        self.split = max(len(own) - 1, 0)

    def start(self, generator: torch.Generator, *, dtype: torch.dtype = torch.float64) -> torch.Tensor:
        """Initial parameters (P,), uniform within 1 / sqrt(fan in); the draws do not depend on ``dtype``."""
        drawn = [(2.0 * torch.rand(count, generator=generator, dtype=torch.float64) - 1.0) / a**0.5
                 for a, b in self.shapes for count in (a * b, b)]
        return torch.cat(drawn).to(dtype)

    def __call__(self, phi: torch.Tensor, x: torch.Tensor, token: torch.Tensor) -> torch.Tensor:
        """Readings (B, R, outputs) of actions ``x`` (B, R, inputs) on views ``token`` (B, c), by ``phi`` (B, P)."""
        parts = iter(phi.split([count for a, b in self.shapes for count in (a * b, b)], dim=1))
        layers = [(next(parts).unflatten(1, shape), next(parts)[:, None]) for shape in self.shapes]
        if self.split:
            code = _perceptron(layers[:self.split], token[:, None])
            x = torch.cat([x, code.expand(-1, x.shape[1], -1)], dim=2)
        return _perceptron(layers[self.split:], x)

    def loss(self, phi: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Mean squared error of every task (B,); 0 for one without samples."""
        error = ((self(phi, batch.x, batch.token) - batch.y) ** 2).mean(dim=2)
        return (error * batch.weight).sum(dim=1) / batch.weight.sum(dim=1).clamp_min(1.0)

    def gradient(self, phi: torch.Tensor, batch: Batch) -> torch.Tensor:
        """Gradient of every task's loss with respect to its own parameters (B, P)."""
        at = phi.detach().requires_grad_(True)
        return torch.autograd.grad(self.loss(at, batch).sum(), at)[0]

    def curvature(self, phi: torch.Tensor, batch: Batch) -> Callable[[torch.Tensor], torch.Tensor]:
        """The product of every task's Hessian with its own vector, (B, P) to (B, P)."""
        at = phi.detach().requires_grad_(True)
        (slope,) = torch.autograd.grad(self.loss(at, batch).sum(), at, create_graph=True)
        return lambda v: torch.autograd.grad(slope, at, v, retain_graph=True)[0]


def _perceptron(layers: Sequence[tuple[torch.Tensor, torch.Tensor]], x: torch.Tensor) -> torch.Tensor:
    for number, (weight, bias) in enumerate(layers):
        x = torch.baddbmm(bias, x, weight)
        if number + 1 < len(layers):
            x = functional.relu(x)
    return x


def adapt(network: Network, theta: torch.Tensor, batch: Batch, *, rate: float, steps: int,
          regularisation: float) -> torch.Tensor:
    """phi of every task (B, P): gradient descent from theta (P,) on the regularised support loss."""
    anchor = theta.detach()[None]
    phi = anchor.repeat(len(batch.x), 1)
    for _ in range(steps):
        gradient = network.gradient(phi, batch)
        phi = torch.lerp(phi, anchor, rate * regularisation).sub_(gradient, alpha=rate)
    return phi


def implicit_gradient(network: Network, phi: torch.Tensor, support: Batch, query: Batch, *, steps: int,
                      regularisation: float, damping: float = 0.0) -> torch.Tensor:
    """Gradient of every task's query loss with respect to theta (B, P), by conjugate gradients.

    Args:
        network: from action to reading. phi: what every task adapted to. support, query: samples. steps: the most of
        them; with the papers' damping four reach a relative residual of 1e-10 in float64. regularisation: of the inner
        loop, lambda. damping: added to it.
    """
    hessian, divisor = network.curvature(phi, support), regularisation + damping
    residual = network.gradient(phi, query)
    direction, solution, size = residual.clone(), torch.zeros_like(residual), _dot(residual, residual)
    small_enough, tiny = _CG_TOLERANCE[size.dtype] ** 2 * size, torch.finfo(size.dtype).tiny
    for _ in range(steps):
        if (size <= small_enough).all():
            break
        image = direction + hessian(direction) / divisor
        curvature = _dot(direction, image)
        # A task that is solved, or whose curvature is negative, keeps its solution.
        step = torch.where((curvature > 0.0) & (size > 0.0), size / curvature.clamp_min(tiny), 0.0)
        solution.add_(step * direction)
        residual.sub_(step * image)
        after = _dot(residual, residual)
        direction.mul_(after / size.clamp_min(tiny)).add_(residual)
        size = after
    return solution


def _dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    return (a * b).sum(dim=1, keepdim=True)
