"""The condensed contact problem of two deformable surfaces: both bodies respond to contact as at rest, and only the
patches are unknown.

As in `condensed`, u = u0 + A q and q = f(u) - f0 on the patch. A membrane is slack across its surface: between the
nodes that hold it, it passes through the object, and Newton's method with a line search converges slowly. So every
iteration linearises the gaps at u and solves for the forces with their signs, a linear complementarity problem
(`complementarity`),

    0 <= lambda  _|_  g + J (u' - u) + lambda / w >= 0,     u' = u0 + A (J^T lambda + t - S (u' - u) - f0)

with t and S the tangential forces and stiffness of the points with friction; a few such iterations find the forces of
the curved surfaces.
"""

from __future__ import annotations

from typing import Any

import torch

from vsfsim.physics import clock
from vsfsim.physics.contact.pair import complementarity
from vsfsim.physics.contact.pair.links import times

_MOST_ITERATIONS = 8  # what has not converged by then cycles over facets
_TIGHT = 1e-5  # tolerance at most: a gap's error must be small beside the penetration, a thousandth of the displacement
_STALLED = 0.5  # an error that shrinks by less than this factor is as small as the facets allow
_CLOSE = 0.2  # of the margin of a step: nodes nearer than this are unknowns of the problem


def solve(contact: Any, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
    """As `condensed.solve`, for a `PairContact`."""
    compliance = contact.compliance
    q = torch.zeros_like(base)
    u = base.clone()
    best, error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    close = None
    for step in range(min(iterations, _MOST_ITERATIONS)):
        if step and clock.now() > contact.deadline:
            break
        contact.evaluate(columns, u)
        miss = compliance.respond(columns, contact.nodal(columns) - pushed - q)
        off = miss.abs().amax(dim=1) / u.abs().amax(dim=1).clamp(min=1e-9)
        better, stuck = off < error, off > _STALLED * error
        best = torch.where(better[:, None], q, best)
        error = torch.where(better, off, error)
        if bool(((error < _TIGHT) | (stuck & (error < tolerance))).all()):
            break
        close = contact.close_nodes(columns, _CLOSE, close)
        normal, gap, give, held = contact.gaps_of(columns, close)
        # rubber mostly sticks: begin with every point stuck, since one far from its anchor would be taken to slip
        drag, across = contact.tangential(columns, stuck=step == 0)
        change = base - u + compliance.respond(columns, drag - pushed)
        force = drag - pushed
        if across is not None:
            # stuck points are springs: Woodbury's formula for A' = (A^-1 + S)^-1
            inside = across.responses(compliance, columns)
            inner = across.gram(inside)
            inner.diagonal(dim1=1, dim2=2).add_(1.0)
            inner = torch.linalg.cholesky(0.5 * (inner + inner.mT))
            change = change - times(inside.mT, torch.cholesky_solve(across.jump(change)[:, :, None], inner)[:, :, 0])
        if normal is not None:
            answer = normal.responses(compliance, columns)
            matrix = normal.gram(answer)
            if across is not None:
                mixed = across.gram(answer)  # (k, rows across, p)
                held_back = torch.cholesky_solve(mixed, inner)
                matrix = matrix - mixed.mT @ held_back
            matrix = 0.5 * (matrix + matrix.mT)
            matrix.diagonal(dim1=1, dim2=2).add_(give)
            answered = complementarity.solve(matrix, gap + normal.jump(change), held)
            change = change + times(answer.mT, answered)
            if across is not None:
                change = change - times(inside.mT, times(held_back, answered))
            force = force + normal.push(answered)
        q = force if across is None else force - across.push(across.jump(change))
        u = u + change
    return best, error
