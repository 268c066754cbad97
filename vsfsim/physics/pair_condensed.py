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

from vsfsim.physics import complementarity

if TYPE_CHECKING:
    from vsfsim.physics.pair import PairTouching

_MOST = 8  # iterations: what has not converged then goes round in a circle of facets
_TIGHT = 1e-2  # of the tolerance: what is left of a gap must be small beside the penetration, not beside the displacement
_CLOSE = 0.2  # of the margin of a step: nearer nodes are asked whether they touch


def solve(touching: PairTouching, columns: torch.Tensor, base: torch.Tensor, pushed: torch.Tensor, *, iterations: int,
          tolerance: float) -> tuple[torch.Tensor, torch.Tensor]:
    """As `condensed.solve`."""
    compliance = touching.compliance[columns]
    q = torch.zeros_like(base)
    u = base.clone()
    best, error = q.clone(), torch.full((len(columns),), float("inf"), dtype=torch.float64, device=base.device)
    asked = None
    for _ in range(min(iterations, _MOST)):
        touching.evaluate(columns, u)
        nodal = touching.nodal(columns)
        miss = _times(compliance, nodal - pushed - q)
        size = miss.abs().amax(dim=1) / u.abs().amax(dim=1).clamp(min=1e-9)
        better = size < error
        best = torch.where(better[:, None], q, best)
        error = torch.where(better, size, error)
        if bool((error < _TIGHT * tolerance).all()):
            break
        asked = touching.near(columns, _CLOSE, asked)
        rows, gap, give, held = touching.normal_rows(columns, asked)
        drag, across = touching.tangential(columns)
        answer = compliance @ rows.mT  # displacements per unit of each normal force
        offset = base - u + _times(compliance, drag - pushed)
        matrix = rows @ answer
        if across is not None:
            # points that stick give way like springs: Woodbury's formula for A' = (A^-1 + S)^-1
            inside = across @ compliance
            inner = inside @ across.mT
            inner.diagonal(dim1=1, dim2=2).add_(1.0)
            inner = torch.linalg.cholesky(inner)
            mixed = across @ answer
            matrix = matrix - mixed.mT @ torch.cholesky_solve(mixed, inner)
            offset = offset - _times(inside.mT, torch.cholesky_solve(_times(across, offset)[:, :, None], inner)[:, :, 0])
        matrix.diagonal(dim1=1, dim2=2).add_(give)
        force = complementarity.solve(matrix, gap + _times(rows, offset), held)
        change = offset + _times(answer, force)
        if across is not None:
            more = _times(answer, force)
            change = offset + more - _times(inside.mT, torch.cholesky_solve(_times(across, more)[:, :, None], inner)[:, :, 0])
        q = _times(rows.mT, force) + drag - pushed
        if across is not None:
            q = q - _times(across.mT, _times(across, change))
        u = u + change
    return best, error


def _times(matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    return (matrix @ vector[:, :, None])[:, :, 0]
