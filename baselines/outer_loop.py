"""The outer loop of iMAML: steps of Adam on the parameters that every task starts from.

On a GPU a step on few samples is three thousand launches of some microseconds each, so it is recorded as a CUDA graph
and replayed (`vsfsim.vsf.graphed_step`). For that all its tasks are padded to one length, which changes no sum.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from vsfsim.baselines.implicit_maml import Batch, Network, Parameters, Table, adapt, implicit_gradient
from vsfsim.vsf.adam import Adam
from vsfsim.vsf.graphed_step import GraphedStep

_SMALL = 16_384
"""Samples of a step, with their padding, up to which a GPU waits for the launches and not for the arithmetic."""


@dataclass(frozen=True)
class Rates:
    """Of the inner and the outer loop; `Imaml` says what each is."""

    outer_rate: float
    inner_rate: float
    inner_steps: int
    regularisation: float
    cg_damping: float
    cg_steps: int


class OuterLoop:
    """Steps on ``theta``, each on some training objects.

    Args:
        network: from action to reading.
        theta: parameters, leaves that require gradients; changed in place.
        table: samples of all touches.
        rates: of both loops.
        longest: samples of the training object with most of them.
        device: torch device of ``theta`` and of the samples.
    """

    def __init__(self, network: Network, theta: Parameters, table: Table, rates: Rates, *, longest: int, device: str):
        self._network, self._theta, self._table, self._rates = network, theta, table, rates
        self._longest, self._device = longest, torch.device(device)
        self._optimiser = Adam(theta, rates.outer_rate, capturable=self._device.type == "cuda")
        self._recorded: dict[int, _Recorded] = {}

    def step(self, halves: Sequence[tuple[np.ndarray, np.ndarray]], token: torch.Tensor) -> None:
        """One step.

        Args:
            halves: of each training object the numbers of its support and of its query touches.
            token: vectors of their views (B, c), on the device.
        """
        count = len(halves)
        sets = [[h[k] for h in halves] for k in (0, 1)]
        if self._device.type != "cuda" or count * self._longest > _SMALL:
            self._move(*(self._table.batch(tasks, token) for tasks in sets))
            return
        if count not in self._recorded:
            self._recorded[count] = _Recorded(self, count, self._longest, token)
        self._recorded[count](*(self._table.rows(tasks, self._longest) for tasks in sets), token)

    def _move(self, support: Batch, query: Batch) -> torch.Tensor:
        """Loss of every task (B,) at what it adapted to, before the step."""
        r = self._rates
        phi = adapt(self._network, self._theta, support, rate=r.inner_rate, steps=r.inner_steps,
                    regularisation=r.regularisation)
        gradient, loss = implicit_gradient(self._network, phi, support, query, regularisation=r.regularisation,
                                           damping=r.cg_damping, cg_steps=r.cg_steps)
        for p, g in zip(self._theta, gradient):
            p.grad = g.mean(dim=0)
        self._optimiser.step()
        return loss


class _Recorded:
    """A step on ``count`` tasks of ``width`` samples, whose numbers and tokens are copied to one place."""

    def __init__(self, loop: OuterLoop, count: int, width: int, token: torch.Tensor):
        self._rows = [torch.zeros((count, width), dtype=torch.int64, device=token.device) for _ in range(2)]
        self._token = torch.empty_like(token)

        def step() -> torch.Tensor:
            support, query = (loop._table.gather(rows, self._token) for rows in self._rows)
            return loop._move(support, query)

        self._step = GraphedStep(step, device=str(token.device))

    def __call__(self, support: np.ndarray, query: np.ndarray, token: torch.Tensor) -> None:
        for rows, new in zip(self._rows, (support, query)):
            rows.copy_(torch.as_tensor(new))
        self._token.copy_(token)
        self._step()
