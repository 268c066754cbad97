"""The outer loop of iMAML: steps of Adam on the parameters that every task starts from.

On a GPU a step on few samples is two thousand launches of some microseconds each, so it is recorded as CUDA graphs and
replayed (`vsfsim.vsf.graphed_step`). For that its tasks are padded to one of a few lengths, which changes no sum.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from vsfsim.baselines.implicit_maml import Batch, ImplicitGradient, Network, Parameters, Table, adapt
from vsfsim.vsf.adam import Adam
from vsfsim.vsf.graphed_step import GraphedLoop

_SMALL = 16_384
"""Samples of a step, with their padding, up to which a GPU waits for the launches and not for the arithmetic."""
_LENGTHS = 4
"""Lengths that a recorded task may have. A step is recorded for each pair of them that occurs; with one length half of
its arithmetic would be on padding."""


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
        self._recorded: dict[tuple[int, int, int], _Recorded] = {}

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
        support, query = (self._table.rows(tasks, math.ceil(self._longest / _LENGTHS)) for tasks in sets)
        shape = count, support.shape[1], query.shape[1]
        if shape not in self._recorded:
            self._recorded[shape] = _Recorded(self, *shape, token)
        self._recorded[shape](support, query, token)

    def _move(self, support: Batch, query: Batch) -> torch.Tensor:
        """Loss of every task (B,) at what it adapted to, before the step."""
        solving = self._begin(support, query)
        solving.solve(self._rates.cg_steps)
        return self._end(solving)

    def _begin(self, support: Batch, query: Batch) -> ImplicitGradient:
        r = self._rates
        phi = adapt(self._network, self._theta, support, rate=r.inner_rate, steps=r.inner_steps,
                    regularisation=r.regularisation)
        return ImplicitGradient(self._network, phi, support, query, regularisation=r.regularisation,
                                damping=r.cg_damping)

    def _end(self, solving: ImplicitGradient) -> torch.Tensor:
        for p, g in zip(self._theta, solving.gradient()):
            p.grad = g.mean(dim=0)
        self._optimiser.step()
        return solving.loss()


class _Recorded:
    """A step on ``count`` tasks of ``support`` and ``query`` samples, whose numbers and tokens are copied to one
    place."""

    def __init__(self, loop: OuterLoop, count: int, support: int, query: int, token: torch.Tensor):
        self._rows = [torch.zeros((count, width), dtype=torch.int64, device=token.device) for width in (support, query)]
        self._token = torch.empty_like(token)
        solving: list[ImplicitGradient] = []

        def begin() -> torch.Tensor:
            solving[:] = [loop._begin(*(loop._table.gather(rows, self._token) for rows in self._rows))]
            return solving[0].goes_on

        def turn() -> None:
            solving[0].turn()

        def end() -> torch.Tensor:
            return loop._end(solving[0])

        self._step = GraphedLoop(begin, turn, end, most=loop._rates.cg_steps, device=str(token.device))

    def __call__(self, support: np.ndarray, query: np.ndarray, token: torch.Tensor) -> None:
        for rows, new in zip(self._rows, (support, query)):
            rows.copy_(torch.as_tensor(new))
        self._token.copy_(token)
        self._step()
