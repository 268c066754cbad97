"""The condensed contact problem of two deformable surfaces: both bodies answer the contact as at rest, and only the patches are unknown.

As in `condensed`, u = u0 + A q and q = f(u) - f0 on the patch. A membrane is slack across its surface: between the nodes that hold it, it dives through
the object, and Newton's method with a line search crawls. So every iteration takes the gaps as they are linearised at u and
solves for the forces with their signs, a linear complementarity problem (`complementarity`),

    0 <= lambda  _|_  g + J (u' - u) + lambda / w >= 0,     u' = u0 + A (J^T lambda + t - S (u' - u) - f0)

with t and S the tangential forces and stiffness of the points that friction holds; a few such iterations find the forces of the curved surfaces.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from vsfsim.physics import complementarity, pair_links

if TYPE_CHECKING:
    from vsfsim.physics.pair import PairTouching

_MOST = 8  # iterations: what has not converged then goes round in a circle of facets
_TIGHT = 1e-2  # of the tolerance: what is left of a gap must be small beside the penetration, not beside the displacement
_STALLED = 0.5  # an error that shrinks by less is as small as the facets let it be
_CLOSE = 0.2  # of the margin of a step: nearer nodes are asked whether they touch


def solve(touching: PairTouching, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
    """As `condensed.solve`."""
    compliance = touching.compliance.pick(columns)
    size = base.shape[1]
    q = torch.zeros_like(base)
    u = base.clone()
    best, error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    asked = None
    for step in range(min(iterations, _MOST)):
        touching.evaluate(columns, u)
        miss = touching.respond(columns, touching.nodal(columns) - pushed - q)
        off = miss.abs().amax(dim=1) / u.abs().amax(dim=1).clamp(min=1e-9)
        better, stuck = off < error, off > _STALLED * error
        best = torch.where(better[:, None], q, best)
        error = torch.where(better, off, error)
        if bool(((error < _TIGHT * tolerance) | (stuck & (error < tolerance))).all()):
            break
        asked = touching.near(columns, _CLOSE, asked)
        normal, gap, give, held = touching.meeting(columns, asked)
        # rubber mostly sticks: begin with all of it stuck, since from far past its anchor a point would seem to slip for ever
        drag, across = touching.tangential(columns, stuck=step == 0)
        change = base - u + touching.respond(columns, drag - pushed)
        force = torch.zeros_like(base)
        if normal:
            answer = pair_links.answers(normal, compliance)
            matrix = pair_links.gram(normal, answer)
        if across:
            # points that stick give way like springs: Woodbury's formula for A' = (A^-1 + S)^-1
            inside = pair_links.answers(across, compliance)
            inner = pair_links.gram(across, inside)
            inner.diagonal(dim1=1, dim2=2).add_(1.0)
            inner = torch.linalg.cholesky(0.5 * (inner + inner.mT))
            change = change - _times(inside.mT, torch.cholesky_solve(pair_links.jump(across, change)[:, :, None], inner)[:, :, 0])
            if normal:
                mixed = pair_links.gram(across, answer)  # (k, rows across, p)
                held_back = torch.cholesky_solve(mixed, inner)
                matrix = matrix - mixed.mT @ held_back
                answer = answer - held_back.mT @ inside
        if normal:
            matrix = 0.5 * (matrix + matrix.mT)
            matrix.diagonal(dim1=1, dim2=2).add_(give)
            answered = complementarity.solve(matrix, gap + pair_links.jump(normal, change), held)
            change = change + _times(answer.mT, answered)
            force = pair_links.push(normal, answered, size)
        q = force + drag - pushed
        if across:
            q = q - pair_links.push(across, pair_links.jump(across, change), size)
        u = u + change
    return best, error


def _times(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    return (matrix @ vector[:, :, None])[:, :, 0]
