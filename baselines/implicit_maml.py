"""Implicit MAML (Rajeswaran et al. 2019) for many small regression tasks at once.

Meta-parameters theta are where every task starts. A task adapts by gradient descent on its regularised loss

    phi(theta) = argmin_phi  L_support(phi) + lambda/2 |phi - theta|^2

and the gradient of its query loss with respect to theta is, by the implicit function theorem and without unrolling the descent,

    dL_query/dtheta = (I + H / lambda)^-1 grad L_query(phi),   H = Hessian of L_support at phi

solved by a few steps of conjugate gradients. The Hessian is divided by lambda + damping, as the authors' code does: far from the inner minimum
it need not be positive, and damping keeps the system so. All tasks of an outer step are one batch: their parameters carry a
leading task axis.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import torch

Parameters = list[torch.Tensor]


@dataclass(frozen=True)
class Batch:
    """Samples of B tasks, padded to the same number R. x: (B, R, inputs). token: of the task (B, c), c may be 0. y: (B, R, outputs).
    weight: 1 for a sample, 0 for padding (B, R)."""

    x: torch.Tensor
    token: torch.Tensor
    y: torch.Tensor
    weight: torch.Tensor


class Network:
    """A perceptron from action (and view) to reading. Parameters are lists of tensors, with or without a leading task axis.

    inputs, outputs: sizes. token: size of the view's vector, 0 for no vision. hidden: widths. encoder: widths of the token's own
    perceptron, whose output stands beside the action.
    """

    def __init__(self, inputs: int, outputs: int, *, token: int, hidden: Sequence[int], encoder: Sequence[int]):
        self.shapes: list[tuple[int, int]] = []
        self.encoder = [token, *encoder] if token else []
        widths = [inputs + (encoder[-1] if token else 0), *hidden, outputs]
        for sizes in (self.encoder, widths):
            self.shapes += list(itertools.pairwise(sizes))
        self.split = max(len(self.encoder) - 1, 0)

    def start(self, generator: torch.Generator) -> Parameters:
        """Initial parameters, uniform within 1 / sqrt(fan in)."""
        out: Parameters = []
        for a, b in self.shapes:
            for shape in ((a, b), (1, b)):
                out.append((2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 1.0) / a**0.5)
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


def _perceptron(parameters: Parameters, x: torch.Tensor) -> torch.Tensor:
    for i in range(0, len(parameters), 2):
        x = x @ parameters[i] + parameters[i + 1]
        if i + 2 < len(parameters):
            x = torch.relu(x)
    return x


def spread(theta: Parameters, tasks: int) -> Parameters:
    """The same parameters for every task, with a task axis."""
    return [p.detach().expand(tasks, *p.shape).clone() for p in theta]


def adapt(network: Network, theta: Parameters, batch: Batch, *, rate: float, steps: int, regularisation: float) -> Parameters:
    """phi of every task: gradient descent from theta on the regularised support loss."""
    count = len(batch.x)
    phi = spread(theta, count)
    if float(batch.weight.sum()) == 0.0:
        return phi
    anchor = [p.detach() for p in theta]
    for _ in range(steps):
        for p in phi:
            p.requires_grad_(True)
        gradient = torch.autograd.grad(network.loss(phi, batch).sum(), phi)
        phi = [(p - rate * (g + regularisation * (p - a))).detach() for p, g, a in zip(phi, gradient, anchor)]
    return phi


def implicit_gradient(network: Network, phi: Parameters, support: Batch, query: Batch, *, regularisation: float, damping: float = 0.0,
                      cg_steps: int = 10) -> tuple[Parameters, torch.Tensor]:
    """Gradient of every task's query loss with respect to theta (each (B, ...)), and those losses (B,)."""
    phi = [p.detach().requires_grad_(True) for p in phi]
    loss = network.loss(phi, query)
    right = torch.autograd.grad(loss.sum(), phi)
    inner = torch.autograd.grad(network.loss(phi, support).sum(), phi, create_graph=True)

    def apply(v: Parameters) -> Parameters:
        product = torch.autograd.grad(sum((g * d).sum() for g, d in zip(inner, v)), phi, retain_graph=True, allow_unused=True)
        return [d + (torch.zeros_like(d) if h is None else h) / (regularisation + damping) for d, h in zip(v, product)]

    return _conjugate_gradients(apply, list(right), cg_steps), loss.detach()


def _conjugate_gradients(apply, right: Parameters, steps: int) -> Parameters:
    """Solve A x = right for every task by itself."""
    def dot(a: Parameters, b: Parameters) -> torch.Tensor:
        return sum((x * y).flatten(1).sum(dim=1) for x, y in zip(a, b))

    def along(scale: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        return scale.reshape(-1, *[1] * (d.dim() - 1)) * d

    x = [torch.zeros_like(r) for r in right]
    residual, direction = [r.clone() for r in right], [r.clone() for r in right]
    size = dot(residual, residual)
    for _ in range(steps):
        image = apply(direction)
        curvature = dot(direction, image)
        # A task that is solved, or whose curvature turned negative, stays where it is.
        step = torch.where((curvature > 0.0) & (size > 0.0), size / curvature.clamp_min(1e-300), torch.zeros_like(size))
        x = [a + along(step, d) for a, d in zip(x, direction)]
        residual = [r - along(step, i) for r, i in zip(residual, image)]
        after = dot(residual, residual)
        turn = after / size.clamp_min(1e-300)
        direction = [r + along(turn, d) for r, d in zip(residual, direction)]
        size = after
    return x
