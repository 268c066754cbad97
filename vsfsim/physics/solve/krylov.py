"""Krylov methods for several touches at once, vectors (3 n, k), one column a touch.

The matrix is the object's tangent plus the contact block of each touch; the preconditioner is the rest-state inverse
with the contact block added exactly (Woodbury):

    (K0 + S C S^T)^-1 = K0^-1 (1 - S T S^T K0^-1),   T = (C^-1 + A)^-1,   A = S^T K0^-1 S

with S the patch's degrees of freedom and A its compliance. Columns stop together; one that has converged takes zero
steps. On a GPU iterations are repeated as a CUDA graph: launching their kernels one by one takes longer than they run.
"""

from __future__ import annotations

import functools
import gc
from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from vsfsim.physics import clock

Operator = Callable[[torch.Tensor, torch.Tensor | None], torch.Tensor]
_COMPACT = 0.7  # share of running columns under which the others are dropped from the tensors
_BLOCK = 2  # iterations of a graph between two looks of the host
_last: dict[torch.device, torch.cuda.CUDAGraph] = {}  # its memory serves the next one


class Room:
    """Where work is done. If it ``stays``, as on a GPU, its tensors have the same places whenever it is done again, and
    a graph repeats it: launching its kernels one by one takes longer than they run."""

    def __init__(self, *, stays: bool = False):
        self.stays = stays
        self._tensors: dict[str, torch.Tensor] = {}
        self._works: dict[str, tuple[torch.cuda.CUDAGraph, Callable[[], Any], Any]] = {}

    def new(self, name: str, like: torch.Tensor, **more: Any) -> torch.Tensor:
        """A tensor of this ``name``, zeros at first."""
        if name not in self._tensors or not self.stays:
            self._tensors[name] = torch.zeros_like(like, **more)
        return self._tensors[name]

    def take(self, name: str, value: torch.Tensor) -> torch.Tensor:
        """``value`` in the place of this ``name``."""
        return self.new(name, value).copy_(value) if self.stays else value

    def keep(self, values: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
        """`take` of some."""
        return {name: self.take(name, value) for name, value in values.items()}

    def run(self, name: str, work: Callable[[], Any]) -> Any:
        """Do the ``work`` of this ``name`` and return what it does. It asks the GPU for nothing, and leaves all that it
        changes or returns in tensors that stay; what it reads besides lives as long as it does."""
        if name in self._works:
            graph, _, found = self._works[name]
            graph.replay()
            return found
        found = work()
        if not self.stays:
            return found
        device = next(iter(self._tensors.values())).device
        graph, side = torch.cuda.CUDAGraph(), _side(device)
        side.wait_stream(torch.cuda.current_stream(device))
        collects = gc.isenabled()
        gc.disable()  # an array of Warp that is freed meanwhile would end the capture
        with torch.cuda.stream(side), wp.ScopedStream(wp.stream_from_torch(side), sync_enter=False):
            graph.capture_begin(pool=_last[device].pool() if device in _last else None,
                                capture_error_mode="thread_local")
            try:
                work()
            finally:
                graph.capture_end()
                if collects:
                    gc.enable()
        _last[device] = graph
        self._works[name] = graph, work, found
        return found


def column_dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Dot product of every column (k,)."""
    return (a * b).sum(dim=0)


def conjugate_gradients(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor,
          iterations: int, deadline: float, room: Room) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solve A x = ``right`` from x = 0, the residual measured by its length.

    Args:
        multiply, precondition: A p and M^-1 r on tensors (3 n, j); their second argument names the columns of ``right``
            (j,), or is None for all.
        right: right-hand sides (3 n, k).
        tolerance: relative residual of each column (k,).
        iterations: limit.
        deadline: `clock.now` after which no iteration begins and the preconditioner is not used again [s]; x is
            then what was reached, a direction of descent all the same.
        room: where it is done. In one that stays all columns go on together, and the results are in it.

    Returns:
        x (3 n, k), iterations of each column (k,), and which met negative curvature (k,) bool: such a column keeps its
        last x, or the first direction.
    """
    which = None
    right, tolerance = room.take("right", right), room.take("tolerance", tolerance)
    # of the columns that are left: x, the iterations, and which met negative curvature
    x, r, p = (room.new(name, right) for name in "xrp")
    rz, least = (room.new(name, tolerance) for name in ("rz", "least"))
    steps = room.new("steps", tolerance, dtype=torch.int64)
    curved, running = (room.new(name, tolerance, dtype=torch.bool) for name in ("curved", "running"))
    out, taken, bent, none = x, steps, curved, rz.new_zeros(())

    # all in place, so that a GPU can repeat it
    def descend() -> None:
        ap = multiply(p, which)
        pap = column_dots(p, ap)
        falls = running & (pap > 0.0)
        curved.logical_or_(running ^ falls)
        steps.add_(running)
        alpha = torch.where(falls, rz / pap, none)
        x.add_(alpha * p)
        r.sub_(alpha * ap)
        running.copy_(falls & (column_dots(r, r) > least))

    def turn() -> None:
        z = precondition(r, which)
        fresh = column_dots(r, z)
        p.mul_(torch.where(running, fresh / rz, none)).add_(z)
        rz.copy_(torch.where(running, fresh, rz))

    def begin() -> None:
        for found in (x, steps, curved):
            found.zero_()
        r.copy_(right)
        p.copy_(precondition(r, None))
        rz.copy_(column_dots(r, p))
        least.copy_(tolerance**2 * column_dots(r, r).clamp(min=1e-300))
        running.copy_(rz > 0.0)
        descend()
        x.add_(p * curved)

    def iterate() -> None:
        turn()
        descend()

    room.run("begin", begin)
    done = 1
    while done < iterations and bool(running.any()) and clock.now() <= deadline:
        if room.stays:
            for _ in range(min(_BLOCK, iterations - done)):
                room.run("iterate", iterate)
            done += _BLOCK
            continue
        turn()
        if int(running.sum()) < _COMPACT * len(running):
            if which is not None:
                out[:, which], taken[which], bent[which] = x, steps, curved
            keep = running.nonzero()[:, 0]
            which = keep if which is None else which[keep]
            x, r, p = x[:, keep], r[:, keep], p[:, keep]
            rz, least, steps, curved, running = (t[keep] for t in (rz, least, steps, curved, running))
        descend()
        done += 1
    if which is not None:
        out[:, which], taken[which], bent[which] = x, steps, curved
    return out, taken, bent


def gmres(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor, iterations: int,
          deadline: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Solve A x = ``right`` from x = 0 by generalised minimal residuals (Saad and Schultz 1986), preconditioned from
    the right, for matrices that are not symmetric: min |b - A M^-1 y| over the Krylov space of A M^-1, x = M^-1 y.
    Arguments as `conjugate_gradients`.

    Returns:
        x (3 n, k) and iterations of each column (k,).
    """
    size = column_dots(right, right).sqrt().clamp(min=1e-300)
    basis, searched = [right / size], []
    k = right.shape[1]
    upper = torch.zeros((k, iterations + 1, iterations), dtype=torch.float64, device=right.device)
    steps = torch.zeros(k, dtype=torch.int64, device=right.device)
    running = torch.ones(k, dtype=torch.bool, device=right.device)
    y = upper[:, :0, :1]  # of no vector of the basis
    for j in range(iterations):
        if j and clock.now() > deadline:
            break
        steps += running
        searched.append(precondition(basis[j], None))
        w = multiply(searched[j], None)
        for i, v in 2 * list(enumerate(basis)):  # twice is enough (Kahan)
            h = column_dots(v, w)
            upper[:, i, j] += h
            w = w - h * v
        upper[:, j + 1, j] = length = column_dots(w, w).sqrt()
        basis.append(w / length.clamp(min=1e-300))
        own, goal = upper[:, :j + 2, :j + 1], size[:, None, None] * torch.eye(j + 2, 1).to(size)
        q, r = torch.linalg.qr(own)
        new = torch.linalg.solve_triangular(r, q.mT @ goal, upper=True)
        left = (own @ new - goal)[:, :, 0].norm(dim=1)
        y = torch.where(running[:, None, None], new, torch.nn.functional.pad(y, (0, 0, 0, 1)))
        running = running & (left > tolerance * size)
        if not bool(running.any()):
            break
    out = torch.zeros_like(right)
    for i, z in enumerate(searched[:y.shape[1]]):
        out += z * y[:, i, 0]
    return out, steps


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
