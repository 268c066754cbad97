"""Adam (Kingma and Ba 2015) by torch's functional form, with the same bits as `torch.optim.Adam`.

The first optimiser object of a process imports torch's compiler, 800 modules and two to four seconds that nothing here
uses. Every training has a process of its own, and every trial of a method that fits in `adapt` is a fork that would
import it again.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch.optim.adam import adam


class Adam:
    """The optimiser of parameters with their `grad`.

    Args:
        parameters: leaves that require gradients, changed in place by `step`.
        rate: learning rate [-].
        capturable: count the steps on the parameters' device, so that a CUDA graph may hold a step.
    """

    def __init__(self, parameters: Iterable[torch.Tensor], rate: float, *, capturable: bool = False):
        self.parameters, self.rate, self.capturable = list(parameters), rate, capturable
        self._mean = [torch.zeros_like(p) for p in self.parameters]
        self._square = [torch.zeros_like(p) for p in self.parameters]
        self._steps = [torch.zeros((), dtype=torch.float32, device=p.device if capturable else "cpu")
                       for p in self.parameters]

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for p in self.parameters:
            p.grad = None

    @torch.no_grad()
    def step(self) -> None:
        """One step along the gradients, which every parameter must have."""
        adam(self.parameters, [p.grad for p in self.parameters], self._mean, self._square, [], self._steps,
             foreach=True, capturable=self.capturable, amsgrad=False, beta1=0.9, beta2=0.999, lr=self.rate,
             weight_decay=0.0, eps=1e-8, maximize=False)
