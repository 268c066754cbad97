"""A step of a training loop, recorded once and replayed: on a GPU a step of a small network is a hundred launches of
some microseconds each, and the launching costs more than the work. A CUDA graph launches them as one.

The step must take all that changes from tensors that stay where they are (a counter on the device, buffers that are
refilled in place) and ask the host for nothing.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

_ORDINARY = 3
"""Steps made in the ordinary way first: libraries allocate their workspace then, which cannot be recorded."""


class Recorded:
    """``step`` () -> tensor, called again and again.

    On a CPU it is called. On a GPU it is called `_ORDINARY` times, recorded, and replayed from then on; the tensor it
    returns is then one and the same, with the latest values.
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
        if self.calls <= _ORDINARY:
            return self._aside()
        if self._graph is None:
            self._graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(self._graph):
                self._out = self.step()
        self._graph.replay()
        return self._out

    def _aside(self) -> torch.Tensor:
        # Recording happens on a stream of its own; so must the steps that warm the allocator for it.
        here, aside = torch.cuda.current_stream(self.device), torch.cuda.Stream(self.device)
        aside.wait_stream(here)
        with torch.cuda.stream(aside):
            out = self.step()
        here.wait_stream(aside)
        return out
