"""The stiffness of the points in contact, inverted together with the compliance of the body at rest."""

from __future__ import annotations

from dataclasses import dataclass

import scipy.sparse as sp
import torch

_MANY = 24
"""Parts of faces in contact from which on a CPU the contact stiffness is assembled from those parts, as a sparse
matrix, and brackets are factorised: of a cylinder that stands with friction on 750 points a block takes a third of the
time, and the stiffness a tenth."""


@dataclass(frozen=True)
class SparseStiffness:
    """The stiffness C of k patches on a CPU, as an operator: ``stiffness @ v`` for v (k, 3 s, 1)."""

    matrices: list[sp.csr_matrix]
    """Of each touch (3 s, 3 s) [N/m]."""

    @classmethod
    def of(cls, local: torch.Tensor, shapes: torch.Tensor, stiff: torch.Tensor, free: torch.Tensor) -> SparseStiffness:
        """From the parts of faces of k touches.

        Args:
            local: their nodes (k, f, 6).
            shapes: shape values of their points (k, f, 6 points, 6 nodes).
            stiff: stiffness of the points (k, 6 f, 3, 3) [N/m].
            free: 1 where a degree of freedom may move (k, 3 s).
        """
        out = []
        for nodes, values, own, loose in zip(local, shapes, stiff.view(*local.shape, 9), free, strict=True):
            on = (own != 0.0).flatten(1).any(dim=1).nonzero()[:, 0]
            nodes, values, own = nodes[on].long(), values[on], own[on]
            pairs = (values[:, :, :, None] * values[:, :, None, :]).flatten(2).mT @ own  # (a, 36 pairs of nodes, 9)
            at = (3 * nodes[:, :, None] + torch.arange(3)).view(-1, 6, 1, 3, 1).expand(-1, 6, 6, 3, 3)
            values = pairs.view(-1, 6, 6, 3, 3) * loose[at] * loose[at.permute(0, 2, 1, 4, 3)]
            own = sp.csr_matrix((values.flatten().numpy(), (at.flatten().numpy(),
                                 at.permute(0, 2, 1, 4, 3).flatten().numpy())), shape=(len(loose), len(loose)))
            own.eliminate_zeros()  # under a plane across an axis, two thirds
            out.append(own)
        return cls(out)

    def __getitem__(self, which: torch.Tensor) -> SparseStiffness:
        return SparseStiffness([self.matrices[b] for b in which.nonzero()[:, 0].tolist()] if which.dtype == torch.bool
                               else [self.matrices[b] for b in which.tolist()])

    def __setitem__(self, which: torch.Tensor, other: SparseStiffness | torch.Tensor) -> None:
        """``other`` may be dense (j, 3 s, 3 s): few touches of a batch can have few points in contact."""
        at = which.nonzero()[:, 0] if which.dtype == torch.bool else which
        matrices = other.matrices if isinstance(other, SparseStiffness) else [sp.csr_matrix(c.numpy()) for c in other]
        for b, matrix in zip(at.tolist(), matrices, strict=True):
            self.matrices[b] = matrix

    def __matmul__(self, v: torch.Tensor) -> torch.Tensor:
        return _stacked([torch.as_tensor(c @ x.numpy()) for c, x in zip(self.matrices, v, strict=True)])


def many(inside: torch.Tensor) -> bool:
    """Whether so many parts of faces are in contact on a CPU, by their points (k, 6 f) bool, that `SparseStiffness` is
    faster than rows."""
    return inside.device.type == "cpu" and int(inside.view(len(inside), -1, 6).any(dim=2).sum(dim=1).amax()) >= _MANY


@dataclass(frozen=True)
class ContactBlock:
    """The contact stiffness C = R^T R of k touches, inverted together with the compliance A of the body.

    ``apply`` returns T v with T = (C^-1 + A)^-1 = R^T (1 + R A R^T)^-1 R (Woodbury): the contact forces under
    displacements v of the patches, when the body responds as at rest. Where the rows outnumber the degrees of freedom,
    T is formed as C (1 + A C)^-1 instead.
    """

    dof: torch.Tensor
    """Degrees of freedom that touch (k, m)."""
    rows: torch.Tensor
    """R (k, r, m) [sqrt(N/m)], or C (k, m, m) [N/m] if `joined`."""
    inner: torch.Tensor
    """Cholesky factor of 1 + R A R^T (k, r, r); if `joined`, (1 + A C)^-1 (k, m, m), or its LU factor with `pivots`."""
    width: int
    """Degrees of freedom of a patch, 3 s."""
    joined: bool = False
    pivots: torch.Tensor | None = None
    """Pivots of the LU factor (k, m): a third of the work of the inverse where many nodes touch."""

    @classmethod
    def of(cls, rows: torch.Tensor, compliance: torch.Tensor, series: torch.Tensor | None = None, *,
           nodes: bool = False) -> ContactBlock:
        """From the rows R (k, m, 3 s) [sqrt(N/m)] and the compliance (k, 3 s, 3 s) [m/N] of the patches.

        ``series``: g (k, 3 s), if the compliance g g^T of a spring is in series with that of the body [sqrt(m/N)].
        ``nodes``: take all degrees of freedom of a node that touches. With friction those that touch change whenever a
        point begins to slip, and so would the rounding.
        """
        dof = _used((rows != 0.0).any(dim=1), nodes)
        rows = rows.gather(2, dof[:, None, :].expand(-1, rows.shape[1], -1))
        own = _between(compliance, dof, series)
        if rows.shape[1] > rows.shape[2]:
            # more rows than degrees of freedom: their product R^T R says the same
            stiff = rows.mT @ rows
            return cls(dof, stiff, torch.linalg.inv(_bracket(own, stiff)), compliance.shape[2], joined=True)
        inner = rows @ own @ rows.mT
        inner.diagonal(dim1=1, dim2=2).add_(1.0)
        return cls(dof, rows, torch.linalg.cholesky(inner), compliance.shape[2])

    @classmethod
    def joined_of(cls, nodes: torch.Tensor, stiffness: torch.Tensor, compliance: torch.Tensor,
                  series: torch.Tensor | None = None) -> ContactBlock:
        """From the stiffness C (k, 3 u, 3 u) [N/m] of some ``nodes`` (k, u) of the patches and the compliance of the
        patches (k, 3 s, 3 s) [m/N]; ``series``: see `of`."""
        dof = _dof(nodes)
        factors, pivots = torch.linalg.lu_factor(_bracket(_between(compliance, dof, series), stiffness))
        return cls(dof, stiffness, factors, compliance.shape[2], joined=True, pivots=pivots)

    @classmethod
    def sparse_of(cls, stiffness: SparseStiffness, compliance: torch.Tensor, series: torch.Tensor | None = None, *,
                  nodes: bool = False, real: torch.dtype = torch.float64) -> ContactBlock:
        """From the stiffness C of k patches, which need not be symmetric, and their compliance (k, 3 s, 3 s) [m/N];
        ``series`` and ``nodes`` as for `of`. ``real``: precision; the single one takes half of the time."""
        used = torch.zeros(compliance.shape[:2], dtype=torch.bool)
        for b, c in enumerate(stiffness.matrices):
            used[b, torch.as_tensor(c.indices).long()] = True
        dof = _used(used, nodes)
        own, stiff, bracket = _between(compliance, dof, series, real), [], []
        for c, a, at in zip(stiffness.matrices, own, dof.numpy(), strict=True):
            few = c[at][:, at].astype(a.numpy().dtype)
            stiff.append(torch.as_tensor(few.toarray()))
            bracket.append(torch.as_tensor(few.T @ a.numpy()).T)  # A C = (C^T A)^T: A is symmetric
        inner = _stacked(bracket)
        inner.diagonal(dim1=1, dim2=2).add_(1.0)
        factors, pivots = torch.linalg.lu_factor(inner)
        return cls(dof, _stacked(stiff), factors, compliance.shape[2], joined=True, pivots=pivots)

    def pick(self, which: torch.Tensor) -> ContactBlock:
        """That of some of the touches (j,)."""
        return ContactBlock(self.dof[which], self.rows[which], self.inner[which], self.width, self.joined,
                            None if self.pivots is None else self.pivots[which])

    def apply(self, v: torch.Tensor) -> torch.Tensor:
        """T v for displacements v (k, 3 s) [m] -> forces (k, 3 s) [N]."""
        own = v.gather(1, self.dof)[:, :, None].to(self.rows.dtype)
        if self.pivots is not None:
            force = self.rows @ torch.linalg.lu_solve(self.inner, self.pivots, own)
        elif self.joined:
            force = self.rows @ (self.inner @ own)
        else:
            force = self.rows.mT @ torch.cholesky_solve(self.rows @ own, self.inner)
        out = torch.zeros((len(v), self.width), dtype=v.dtype, device=v.device)
        return out.scatter_(1, self.dof, force[:, :, 0].to(v.dtype))


def _stacked(parts: list[torch.Tensor]) -> torch.Tensor:
    """As `torch.stack`, without a copy of a single one."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def gram(rows: torch.Tensor) -> torch.Tensor:
    """R^T R (k, 3 s, 3 s) of rows R (k, r, 3 s), most of whose columns are 0."""
    dof = _used((rows != 0.0).any(dim=1))
    own = rows.gather(2, dof[:, None, :].expand(-1, rows.shape[1], -1))
    out = rows.new_zeros(len(rows), rows.shape[2], rows.shape[2])
    out[torch.arange(len(rows), device=rows.device)[:, None, None], dof[:, :, None], dof[:, None, :]] = own.mT @ own
    return out


def _bracket(own: torch.Tensor, stiff: torch.Tensor) -> torch.Tensor:
    """1 + A C (k, m, m)."""
    inner = own @ stiff
    inner.diagonal(dim1=1, dim2=2).add_(1.0)
    return inner


def _used(touched: torch.Tensor, nodes: bool = False) -> torch.Tensor:
    """Indices (k, m) of the degrees of freedom that are ``touched`` (k, 3 s) bool, or of those of ``nodes`` that have
    any touched, padded to the largest number. Under a plane across an axis the first are a third of the second."""
    if nodes:
        touched = touched.view(len(touched), -1, 3).any(dim=2, keepdim=True).expand(-1, -1, 3).flatten(1)
    most = max(1, int(touched.sum(dim=1).amax()))
    return torch.sort(touched.to(torch.int8), dim=1, descending=True, stable=True)[1][:, :most]


def _dof(nodes: torch.Tensor) -> torch.Tensor:
    """Degrees of freedom (k, 3 u) of nodes (k, u)."""
    return (3 * nodes[:, :, None] + torch.arange(3, device=nodes.device)).flatten(1)


def _between(matrix: torch.Tensor, dof: torch.Tensor, series: torch.Tensor | None,
             real: torch.dtype = torch.float64) -> torch.Tensor:
    """Rows and columns ``dof`` (k, m) of a matrix (k, 3 s, 3 s) and of g g^T, g (k, 3 s) the ``series``: (k, m, m), in
    the precision ``real``."""
    if len(matrix) == 1:
        out = matrix[0].index_select(0, dof[0]).to(real).index_select(1, dof[0])[None]
    else:
        touch = torch.arange(len(matrix), device=matrix.device)[:, None, None]
        out = matrix[touch, dof[:, :, None], dof[:, None, :]].to(real)
    if series is None:
        return out
    g = series.gather(1, dof).to(real)
    return out + g[:, :, None] * g[:, None, :]


def assemble(points: torch.Tensor, columns: torch.Tensor, active: torch.Tensor, stiff: torch.Tensor,
             free: torch.Tensor) -> torch.Tensor:
    """Sum over points q of N_q^T stiff_q N_q (k, 3 s, 3 s) [N/m], N_q 0 where a degree of freedom is not ``free``
    (k, 3 s); the other arguments as for `rows_of`, the stiffness (B, q, 3, 3) [N/m]."""
    shapes, which = _picked(points, columns, active)
    k, q, s = shapes.shape
    right = (stiff[which][:, :, :, :, None] * shapes[:, :, None, None, :]).reshape(k, q, 9 * s)
    out = (shapes.mT @ right).view(k, s, 3, 3, s).permute(0, 1, 2, 4, 3).reshape(k, 3 * s, 3 * s)
    return out * free[:, :, None] * free[:, None, :]


def _picked(points: torch.Tensor, columns: torch.Tensor,
            active: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """Shape values (k, a, s) of the active points, 0 at padding up to the largest number a, and their places in
    ``points``."""
    most = max(1, int(active.sum(dim=1).amax()))
    on, order = torch.sort(active.to(torch.int8), dim=1, descending=True, stable=True)
    which = columns[:, None], order[:, :most]
    return points[which] * on[:, :most, None], which


def rows_of(points: torch.Tensor, columns: torch.Tensor, active: torch.Tensor, roots: torch.Tensor) -> torch.Tensor:
    """Rows (k, a r, 3 s) of the points that are active.

    Args:
        points: shape values of the points of all touches (B, q, s).
        columns: touches (k,).
        active: which of their points (k, q) bool.
        roots: of the stiffness of the points (B, q, r, 3) [sqrt(N/m)].
    """
    shapes, which = _picked(points, columns, active)
    k, a, s = shapes.shape
    return (roots[which][:, :, :, None, :] * shapes[:, :, None, :, None]).reshape(k, a * roots.shape[2], 3 * s)
