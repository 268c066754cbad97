"""The condensed contact problem of two deformable surfaces: both bodies answer the contact as at rest, and only the
patches are unknown.

As in `condensed`, u = u0 + A q and q = f(u) - f0 on the patch. A membrane is slack across its surface: between the
nodes that hold it, it dives through the object, and Newton's method with a line search crawls. So every iteration takes
the gaps as they are linearised at u and solves for the forces with their signs, a linear complementarity problem
(`complementarity`),

    0 <= lambda  _|_  g + J (u' - u) + lambda / w >= 0,     u' = u0 + A (J^T lambda + t - S (u' - u) - f0)

with t and S the tangential forces and stiffness of the points that friction holds; a few such iterations find the
forces of the curved surfaces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from vsfsim.physics.contact import complementarity
from vsfsim.physics.contact.pair_links import times

if TYPE_CHECKING:
    from vsfsim.physics.contact.pair import PairTouching

_MOST = 8  # iterations: what has not converged then goes round in a circle of facets
# of the displacement, at the most: what is left of a gap must be small beside the penetration, which is a thousandth of
# it
_TIGHT = 1e-5
_STALLED = 0.5  # an error that shrinks by less is as small as the facets let it be
_CLOSE = 0.2  # of the margin of a step: nearer nodes are asked whether they touch


def solve(touching: PairTouching, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
    """As `condensed.solve`."""
    compliance = touching.compliance
    q = torch.zeros_like(base)
    u = base.clone()
    best, error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    asked = None
    for step in range(min(iterations, _MOST)):
        touching.evaluate(columns, u)
        miss = compliance.respond(columns, touching.nodal(columns) - pushed - q)
        off = miss.abs().amax(dim=1) / u.abs().amax(dim=1).clamp(min=1e-9)
        better, stuck = off < error, off > _STALLED * error
        best = torch.where(better[:, None], q, best)
        error = torch.where(better, off, error)
        if bool(((error < _TIGHT) | (stuck & (error < tolerance))).all()):
            break
        asked = touching.near(columns, _CLOSE, asked)
        normal, gap, give, held = touching.meeting(columns, asked)
        # rubber mostly sticks: begin with all of it stuck, since from far past its anchor a point would seem to slip
        # for ever
        drag, across = touching.tangential(columns, stuck=step == 0)
        change = base - u + compliance.respond(columns, drag - pushed)
        force = drag - pushed
        if across is not None:
            # points that stick give way like springs: Woodbury's formula for A' = (A^-1 + S)^-1
            inside = across.answers(compliance, columns)
            inner = across.gram(inside)
            inner.diagonal(dim1=1, dim2=2).add_(1.0)
            inner = torch.linalg.cholesky(0.5 * (inner + inner.mT))
            change = change - _sum(inside, torch.cholesky_solve(across.jump(change)[:, :, None], inner)[:, :, 0])
        if normal is not None:
            answer = normal.answers(compliance, columns)
            matrix = normal.gram(answer)
            if across is not None:
                mixed = across.gram(answer)  # (k, rows across, p)
                held_back = torch.cholesky_solve(mixed, inner)
                matrix = matrix - mixed.mT @ held_back
            matrix = 0.5 * (matrix + matrix.mT)
            matrix.diagonal(dim1=1, dim2=2).add_(give)
            answered = complementarity.solve(matrix, gap + normal.jump(change), held)
            change = change + _sum(answer, answered)
            if across is not None:
                change = change - _sum(inside, times(held_back, answered))
            force = force + normal.push(answered)
        q = force if across is None else force - across.push(across.jump(change))
        u = u + change
    return best, error


def _sum(rows: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
    """Displacements (k, 3 s) under forces (k, r) along rows whose answers are (k, r, s, 3)."""
    return times(rows.flatten(2).mT, force)
