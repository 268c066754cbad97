"""Adam (Kingma and Ba 2015), for training loops of thousands of small steps.

    m = b1 m + (1 - b1) g,   v = b2 v + (1 - b2) g^2,   p -= rate (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

The same steps as `torch.optim.Adam` with its defaults, in a few calls for all parameters together. torch's own imports
its compiler on the first step, which takes seconds and needs packages that an estimator has no use for.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch

_MEAN, _SQUARE, _FLOOR = 0.9, 0.999, 1e-8


class Adam:
    """One optimiser over some parameters.

    Args:
        parameters: tensors with `requires_grad`; those without a gradient stay. rate: of learning.
        counted_there: the number of steps is kept on the parameters' device, so that a step may be recorded
        (`recorded`). The same steps but
            for rounding.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], *, rate: float, counted_there: bool = False):
        self.parameters, self.rate, self.steps = list(parameters), rate, 0
        # beta_1^t and beta_2^t
        self._powers = torch.ones(2, dtype=torch.float64, device=self.parameters[0].device) if counted_there else None
        self._factors = torch.tensor([_MEAN, _SQUARE], dtype=torch.float64,
                                     device=self.parameters[0].device) if counted_there else None
        self._mean = [torch.zeros_like(p) for p in self.parameters]
        self._square = [torch.zeros_like(p) for p in self.parameters]

    def clear(self) -> None:
        """Forget the gradients."""
        for p in self.parameters:
            p.grad = None

    @torch.no_grad()
    def along(self, gradients: Sequence[torch.Tensor]) -> None:
        """Move all parameters along given gradients, without a look at the host; wants `counted_there`."""
        assert self._powers is not None and self._factors is not None
        self._powers.mul_(self._factors)
        left = (1.0 - self._powers).to(self.parameters[0].dtype)
        torch._foreach_lerp_(self._mean, gradients, 1.0 - _MEAN)
        torch._foreach_mul_(self._square, _SQUARE)
        torch._foreach_addcmul_(self._square, gradients, gradients, 1.0 - _SQUARE)
        root = torch._foreach_sqrt(self._square)
        torch._foreach_mul_(root, left[1].rsqrt())
        torch._foreach_add_(root, _FLOOR)
        move = torch._foreach_div(self._mean, root)
        torch._foreach_mul_(move, -self.rate / left[0])
        torch._foreach_add_(self.parameters, move)

    @torch.no_grad()
    def step(self) -> None:
        """Move the parameters along their gradients."""
        self.steps += 1
        live = [k for k, p in enumerate(self.parameters) if p.grad is not None]
        if not live:
            return
        p, g, m, v = ([group[k] for k in live] for group in (self.parameters, [q.grad for q in self.parameters],
                                                             self._mean, self._square))
        torch._foreach_lerp_(m, g, 1.0 - _MEAN)
        torch._foreach_mul_(v, _SQUARE)
        torch._foreach_addcmul_(v, g, g, 1.0 - _SQUARE)
        root = torch._foreach_sqrt(v)
        torch._foreach_div_(root, (1.0 - _SQUARE**self.steps) ** 0.5)
        torch._foreach_add_(root, _FLOOR)
        torch._foreach_addcdiv_(p, m, root, -self.rate / (1.0 - _MEAN**self.steps))
