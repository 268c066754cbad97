"""Iterations on a GPU as a CUDA graph: launching their kernels one by one takes longer than they run."""

from __future__ import annotations

import functools
from collections.abc import Callable

import torch
import warp as wp

from vsfsim.physics import clock

_BLOCK = 4  # repetitions between two looks of the host
_last: dict[torch.device, torch.cuda.CUDAGraph] = {}  # its memory serves the next one


def repeat(step: Callable[[], None], running: torch.Tensor, *, most: int, few: int, deadline: float) -> int:
    """Repeat ``step`` while more than ``few`` of ``running`` (k,) bool are true, ``most`` times at most and not after
    the ``deadline`` of `clock.now`; up to three times more often than needed, since the host looks now and then.

    Args:
        step: leaves all that it changes where it is, including ``running``, and asks the GPU for nothing. It has been
            made once before, so that what it needs is there.
        running, most, few, deadline: see above.

    Returns:
        How often it was repeated.
    """
    device = running.device
    if int(running.sum()) <= few:
        return 0
    graph, side = torch.cuda.CUDAGraph(), _side(device)
    side.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(side), wp.ScopedStream(wp.stream_from_torch(side), sync_enter=False):
        graph.capture_begin(pool=_last[device].pool() if device in _last else None, capture_error_mode="thread_local")
        try:
            step()
        finally:
            graph.capture_end()
    _last[device] = graph
    for done in range(0, most, _BLOCK):
        if clock.now() > deadline or int(running.sum()) <= few:
            return done
        for _ in range(min(_BLOCK, most - done)):
            graph.replay()
    return most


@functools.cache
def _side(device: torch.device) -> torch.cuda.Stream:
    """The stream of captures; products on it have made their workspaces, which cannot be captured."""
    side = torch.cuda.Stream(device)
    with torch.cuda.stream(side):
        for real in (torch.float32, torch.float64):
            some = torch.ones((2, 8, 8), dtype=real, device=device)
            (some @ some)[0] @ some[0]
    side.synchronize()
    return side
