"""A step of a training loop as a CUDA graph, captured once and replayed.

On a GPU a step of a small network is a hundred kernel launches of some microseconds each, and launching costs more than
the work. A CUDA graph launches them as one. The step must read everything that changes from tensors that keep their
addresses (a counter on the device, buffers that are refilled in place) and must not synchronise with the host.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

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
        self._graph: torch.cuda.CUDAGraph | None = None
        self._out: torch.Tensor | None = None

    def __call__(self) -> torch.Tensor:
        """Make one step."""
        self.calls += 1
        if self.device.type != "cuda":
            return self.step()
        with torch.cuda.device(self.device):
            if self.calls <= _WARM_UP:
                return self._warm_up()
            if self._graph is None:
                self._graph = torch.cuda.CUDAGraph()
                # torch keeps one stream for captures, on the first device that was captured on
                with torch.cuda.graph(self._graph, stream=torch.cuda.Stream(self.device)):
                    self._out = self.step()
            self._graph.replay()
        return self._out

    def _warm_up(self) -> torch.Tensor:
        # The capture runs on a stream of its own; so must the steps that fill the allocator's pool for it.
        current, side = torch.cuda.current_stream(self.device), torch.cuda.Stream(self.device)
        side.wait_stream(current)
        with torch.cuda.stream(side):
            out = self.step()
        current.wait_stream(side)
        return out
