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

import torch
import warp as wp

from vsfsim.physics import clock

Operator = Callable[[torch.Tensor, torch.Tensor | None], torch.Tensor]
_COMPACT = 0.7  # share of running columns under which the others are dropped from the tensors
_FEW = 0.4  # the same on a GPU, where a graph is made again then
_BLOCK = 4  # repetitions between two looks of the host
_last: dict[torch.device, torch.cuda.CUDAGraph] = {}  # its memory serves the next one


def column_dots(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Dot product of every column (k,)."""
    return (a * b).sum(dim=0)


def conjugate_gradients(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor,
          iterations: int, deadline: float = float("inf"), resident: bool = False,
          ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Solve A x = ``right`` from x = 0, the residual measured by its length.

    Args:
        multiply, precondition: A p and M^-1 r on tensors (3 n, j); their second argument names the columns of ``right``
            (j,), or is None for all.
        right: right-hand sides (3 n, k).
        tolerance: relative residual of each column (k,).
        iterations: limit.
        deadline: `clock.now` after which no iteration begins and the preconditioner is not used again [s]; x is
            then what was reached, a direction of descent all the same.
        resident: whether the products are made on a GPU alone: their iterations are then repeated as a graph.

    Returns:
        x (3 n, k), iterations of each column (k,), and which met negative curvature (k,) bool: such a column keeps its
        last x, or the first direction.
    """
    which: torch.Tensor | None = None
    out, taken = torch.zeros_like(right), torch.zeros(right.shape[1], dtype=torch.int64, device=right.device)
    bent = torch.zeros_like(taken, dtype=torch.bool)
    # of the columns that are left: x, the iterations, and which met negative curvature
    x, steps, curved = torch.zeros_like(right), torch.zeros_like(taken), torch.zeros_like(bent)
    r = right.clone()
    p = precondition(r, None).clone()
    rz = column_dots(r, p)
    least = tolerance**2 * column_dots(r, r).clamp(min=1e-300)
    running, none = rz > 0.0, rz.new_zeros(())

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

    def iterate() -> None:
        descend()
        turn()

    done = 0
    while done < iterations:
        if done and clock.now() > deadline:
            break
        descend()
        if done == 0:
            x += p * curved
        done += 1
        if done == iterations or not running.any() or clock.now() > deadline:
            break
        turn()
        if resident:
            done += repeat(iterate, running, most=iterations - done, few=int(_FEW * len(running)),
                                  deadline=deadline)
        left = int(running.sum())
        if left < _COMPACT * len(running):
            where = slice(None) if which is None else which
            out[:, where], taken[where], bent[where] = x, steps, curved
            keep = running.nonzero()[:, 0]
            which = keep if which is None else which[keep]
            x, r, p = x[:, keep], r[:, keep], p[:, keep]
            rz, least, steps, curved, running = (t[keep] for t in (rz, least, steps, curved, running))
    where = slice(None) if which is None else which
    out[:, where], taken[where], bent[where] = x, steps, curved
    return out, taken, bent


def gmres(multiply: Operator, precondition: Operator, right: torch.Tensor, *, tolerance: torch.Tensor, iterations: int,
          deadline: float = float("inf")) -> tuple[torch.Tensor, torch.Tensor]:
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
    collects = gc.isenabled()
    gc.disable()  # an array of Warp that is freed meanwhile would end the capture
    with torch.cuda.stream(side), wp.ScopedStream(wp.stream_from_torch(side), sync_enter=False):
        graph.capture_begin(pool=_last[device].pool() if device in _last else None, capture_error_mode="thread_local")
        try:
            step()
        finally:
            graph.capture_end()
            if collects:
                gc.enable()
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
