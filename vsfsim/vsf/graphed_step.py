"""A step of a training loop as CUDA graphs, captured once and replayed.

On a GPU a step of a small network is a hundred kernel launches of some microseconds each, and launching costs more than
the work. A CUDA graph launches them as one. The step must read everything that changes from tensors that keep their
addresses (a counter on the device, buffers that are refilled in place) and must not synchronise with the host. A step
that asks its own numbers how long to go on is three graphs, between which the host looks (`GraphedLoop`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch

T = TypeVar("T")

_WARM_UP = 3
"""Steps before the capture: libraries allocate their workspace in them, which cannot be captured."""


class GraphedStep:
    """``step`` () -> tensor, called repeatedly.

    On a CPU it is called. On a GPU it is called `_WARM_UP` times, captured, and replayed from then on; it then returns
    one tensor, which each replay overwrites.
    """

    def __init__(self, step: Callable[[], torch.Tensor], *, device: str):
        self.step, self.device = step, torch.device(device)
        self.calls = 0
        self._graphs: list[torch.cuda.CUDAGraph] = []
        self._out: torch.Tensor | None = None

    def __call__(self) -> torch.Tensor:
        """Make one step."""
        self.calls += 1
        if self.device.type != "cuda":
            return self.step()
        with torch.cuda.device(self.device):
            if self.calls <= _WARM_UP:
                return _warm_up(self.step, self.device)
            if not self._graphs:
                self._capture()
            self._replay()
        return self._out

    def _capture(self) -> None:
        graph, self._out = _captured(self.step, torch.cuda.Stream(self.device))
        self._graphs = [graph]

    def _replay(self) -> None:
        self._graphs[0].replay()


class GraphedLoop(GraphedStep):
    """A step of three parts: ``begin`` once, ``turn`` again and again, ``end`` once. Each is a graph.

    Args:
        begin: returns a tensor () bool that says whether a ``turn`` is needed.
        turn: changes that tensor in place, and others that ``begin`` has made.
        end: returns the step's result.
        most: calls of ``turn`` in a step.
        device: torch device.
    """

    def __init__(self, begin: Callable[[], torch.Tensor], turn: Callable[[], None], end: Callable[[], torch.Tensor], *,
                 most: int, device: str):
        super().__init__(lambda: self._run(begin, turn, end), device=device)
        self._parts = begin, turn, end
        self.most = most
        self._goes_on: torch.Tensor | None = None

    def _run(self, begin: Callable[[], torch.Tensor], turn: Callable[[], None], end: Callable[[], T]) -> T:
        goes_on = begin()
        for _ in range(self.most):
            if not goes_on:
                break
            turn()
        return end()

    def _capture(self) -> None:
        begin, turn, end = self._parts
        # One stream, since gradients are taken on the stream where their operands were made. One pool of memory: what a
        # part leaves to the next stays where it is as long as it is referred to.
        stream = torch.cuda.Stream(self.device)
        first, self._goes_on = _captured(begin, stream)
        again, _ = _captured(turn, stream, first)
        last, self._out = _captured(end, stream, first)
        self._graphs = [first, again, last]

    def _replay(self) -> None:
        first, again, last = self._graphs

        def begin() -> torch.Tensor:
            first.replay()
            return self._goes_on

        self._run(begin, again.replay, last.replay)


def _captured(step: Callable[[], T], stream: torch.cuda.Stream,
                 beside: torch.cuda.CUDAGraph | None = None) -> tuple[torch.cuda.CUDAGraph, T]:
    """The graph of a step, not replayed yet, and what it returns.

    Args:
        step: to be captured. stream: of the step's device (torch's own for captures is on the first device that was
        captured on). beside: a graph whose memory it shares.
    """
    graph = torch.cuda.CUDAGraph()
    pool = None if beside is None else beside.pool()
    with torch.cuda.graph(graph, pool=pool, stream=stream):
        out = step()
    return graph, out


def _warm_up(step: Callable[[], T], device: torch.device) -> T:
    # The capture runs on a stream of its own; so must the steps that fill the allocator's pool for it.
    current, side = torch.cuda.current_stream(device), torch.cuda.Stream(device)
    side.wait_stream(current)
    with torch.cuda.stream(side):
        out = step()
    current.wait_stream(side)
    return out
