"""The rest-state stiffness, inverted once for an object: it serves every touch of it.

On the CPU it is a sparse Cholesky factor (`cholesky`) and, for few touches, the columns of the inverse under the patch.
On a GPU it is the dense inverse, so that one product (n x n x B) serves all touches at once where triangular solves
would be slow.
"""

from __future__ import annotations

import functools
import hashlib
from collections import OrderedDict
from collections.abc import Callable

import numpy as np
import scipy.sparse as sp
import torch
from filelock import FileLock

from vsfsim.physics.linear.cholesky import Cholesky, Order, blocks_of
from vsfsim.physics.runtime import kernel_cache

_CHUNK = 64  # right-hand sides solved at once: more gain nothing on a CPU and cost memory
_KEPT = 4  # factors kept in this process, by content
_FEW = 4  # touches; from five on, a batch of triangular solves is as fast as reading their columns
_SPARSE = 0.4  # share of a patch that is pushed up to which picking its columns is the faster way
DENSE = 80_000  # unknowns; the dense inverse needs twice n^2 doubles for a moment: 102 GB here

_factors: OrderedDict[str, RestFactor] = OrderedDict()

_COLUMNS_BYTES = 512e6  # for columns of the inverse, of the touches of one run, and half of what a factor keeps
_TRUST = 1e-3  # relative error in the energy norm up to which an inverse in single precision serves as an exact one


def forget_all() -> None:
    """Forget the factors that this process keeps, so that what follows has the bits of a new process: columns of an
    inverse differ in their last bits by which others were made beside them."""
    _factors.clear()


class RestFactor:
    """Linear elasticity of the object at rest, with its supports held, factorised.

    A gas behind a membrane couples all its nodes: K = S + c g g^T with g = grad V and c = -dp/dV. Then S alone is
    factorised, which is positive definite before the limit point of inflation, and (Sherman and Morrison 1950)

        K^-1 r = S^-1 r - S^-1 g (c g . S^-1 r) / (1 + c g . S^-1 g).

    Args:
        stiffness: of all blocks of the model at rest, supports not held (3 n, 3 n) [N/m]; S alone.
        free: 1 where a degree of freedom may move, 0 where it is held (3 n,).
        points: places of the nodes (n, 3) [m], which guide the elimination.
        coupling: g, supports not held (3 n,) [m^2], and c [Pa/m^3]; None without a gas.
    """

    size: int
    """Degrees of freedom, 3 n."""

    def __init__(self, stiffness: sp.csr_matrix, free: np.ndarray, points: np.ndarray,
                 coupling: tuple[np.ndarray, float] | None = None):
        self._points, self.coupling = points, coupling
        self.stiffness, self.free, self.size = stiffness, free, len(free)
        mask = sp.diags(free)
        self._held = (mask @ stiffness @ mask + sp.diags(1.0 - free)).tocsr()
        self._columns: dict[int, np.ndarray] = {}
        self._dense: dict[str, torch.Tensor] = {}
        self._on = ""

    @functools.cached_property
    def order(self) -> Order:
        """The order of elimination of this body's mesh."""
        return Order(self._blocks, self._points)

    @property
    def real(self) -> type:
        """Precision of the factor: single where that serves this body."""
        return self._solver.real

    @functools.cached_property
    def _blocks(self) -> sp.bsr_matrix:
        return blocks_of(self._held)

    @functools.cached_property
    def _solver(self) -> Cholesky:
        values = np.asarray(self._blocks.data, np.float64)
        out = Cholesky(self.order, values, np.float32)
        return out if self._trusts(out.solve) else Cholesky(self.order, values)

    @functools.cached_property
    def _gas(self) -> tuple[np.ndarray, np.ndarray, float]:
        """g with the supports held, S^-1 g, and the factor c / (1 + c g . S^-1 g)."""
        assert self.coupling is not None
        gradient, rate = self.coupling
        own = gradient * self.free
        answer = self._elastic(own[:, None])[:, 0]
        return own, answer, rate / (1.0 + rate * float(own @ answer))

    @classmethod
    def of(cls, stiffness: sp.csr_matrix, free: np.ndarray, points: np.ndarray,
           coupling: tuple[np.ndarray, float] | None = None) -> RestFactor:
        """The factor of this matrix, which is factorised at its first use: the one that this process made before, or a
        new one; arguments as the class."""
        digest = hashlib.sha256()
        for part in (stiffness.indptr, stiffness.indices, stiffness.data, free, points, *(coupling or ())):
            digest.update(np.ascontiguousarray(part).tobytes())
        key = digest.hexdigest()
        if key not in _factors:
            for other in _factors.values():
                other.forget()
            _factors[key] = cls(stiffness, free, points, coupling)
            while len(_factors) > _KEPT:
                _factors.popitem(last=False)
        _factors.move_to_end(key)
        return _factors[key]

    def _trusts(self, solve: Callable[[np.ndarray], np.ndarray]) -> bool:
        """Whether ``solve`` answers uniform forces along each axis, and random ones, to `_TRUST` in the energy norm of
        the matrix."""
        loads = np.hstack([np.tile(np.eye(3), (self.size // 3, 1)),
                           np.random.default_rng(0).normal(size=(self.size, 1))]) * self.free[:, None]
        x = solve(loads)
        miss = loads - self._held @ x
        # |e|_A^2 = e . A e with e = A^-1 miss, itself found by the factor; |x|_A^2 = x . b
        error, energy = np.einsum("ij,ij->j", solve(miss), miss), np.einsum("ij,ij->j", x, loads)
        return bool(np.isfinite(x).all() and (energy > 0.0).all() and (np.abs(error) <= _TRUST**2 * energy).all())

    def _elastic(self, right: np.ndarray) -> np.ndarray:
        out = self._solver.solve(right)
        return out + self._solver.solve(right - self._held @ out)

    def _coupled(self, out: np.ndarray) -> np.ndarray:
        if self.coupling is None:
            return out
        own, answer, share = self._gas
        return out - answer[:, None] * (share * (own @ out))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """K^-1 ``right``, both (3 n, k), rows of held degrees of freedom must be 0."""
        return self._coupled(self._elastic(right))

    def apply(self, right: np.ndarray) -> np.ndarray:
        """As `solve`, without the refinement, in less than half of the time."""
        return self._coupled(self._solver.solve(right))

    def softness(self, right: np.ndarray, device: str) -> np.ndarray:
        """r . K^-1 r of forces r, ``right`` (3 n, k) [N]: (k,) [J], by the `dense` inverse if the device has it."""
        # of displacements that are off by e this is r . K^-1 r less e . K e: the error is the square of the factor's
        if (there := self._dense.get(device)) is None:
            moved = self.solve(right)
            return ((2.0 * right - self.stiffness @ moved) * moved).sum(axis=0)
        forces = torch.as_tensor(right, device=device)
        came = (there @ forces.to(there.dtype)).to(forces.dtype)
        return ((2.0 * forces - self.stiffness_on(device) @ came) * came).sum(dim=0).cpu().numpy()

    def columns(self, nodes: np.ndarray) -> np.ndarray:
        """Displacements of the whole body per unit force on ``nodes`` (s,): (3 s, 3 n) [m/N], 0 where held. They are
        kept, since neighbouring touches share them."""
        missing = [i for i in nodes.tolist() if i not in self._columns]
        for start in range(0, len(missing), _CHUNK // 3):
            part = missing[start:start + _CHUNK // 3]
            dof = (3 * np.array(part)[:, None] + np.arange(3)).ravel()
            right = np.zeros((self.size, len(dof)))
            right[dof, np.arange(len(dof))] = self.free[dof]
            self._columns.update(zip(part, self.solve(right).T.reshape(-1, 3, self.size).copy(), strict=True))
        out = np.concatenate([np.zeros((0, self.size)), *(self._columns[i] for i in nodes.tolist())])
        while 24.0 * self.size * len(self._columns) > 2.0 * _COLUMNS_BYTES:
            del self._columns[next(iter(self._columns))]
        return out

    def forget(self) -> None:
        """Give back the memory of the columns; they are made again if they are asked for."""
        self._columns.clear()
        self._dense.clear()

    def dense(self, device: str) -> torch.Tensor:
        """The inverse (3 n, 3 n) [m/N] on a GPU, 0 where held; made once and kept until the next body. It has single
        precision, half of the memory and of the time, where that is accurate enough.

        The processes of a machine take turns: for a moment the matrix and its inverse are there, twice the memory that
        is kept.
        """
        if device in self._dense:
            return self._dense[device]
        mask, matrix = torch.as_tensor(self.free, device=device), self._held.tocoo()
        with FileLock(kernel_cache() / f"{device.replace(':', '')}.lock"):
            left = torch.zeros(matrix.shape, dtype=torch.float64, device=device).mT
            left[tuple(torch.as_tensor(at, device=device) for at in (matrix.row, matrix.col))] = torch.as_tensor(
                matrix.data, device=device)
            torch.linalg.cholesky(left, out=left)  # in place: it is symmetric, and stored column after column
            out = torch.cholesky_inverse(left)
            del left
            torch.cuda.empty_cache()  # for the other processes
        out.mul_(mask).mul_(mask[:, None])
        if self.coupling is not None:
            answer = torch.as_tensor(self._gas[1], device=device)
            out.addr_(answer, answer, alpha=-self._gas[2])
        short = out.to(torch.float32)
        self._dense[device] = out = short if self._trusts(lambda right: _times(short, right)) else out
        torch.cuda.empty_cache()
        return out

    def stiffness_on(self, device: str) -> torch.Tensor:
        """The rest stiffness, supports not held, as a sparse matrix on a GPU."""
        if self._on != device:
            k = self.stiffness.tocsr()
            self._moved, self._on = torch.sparse_csr_tensor(k.indptr, k.indices, k.data, k.shape, device=device), device
        return self._moved


def response(factor: RestFactor, dof: torch.Tensor, *, device: str) -> Response:
    """The response of a body to forces on given patches, to single precision: a preconditioner.

    Args:
        factor: the body's factor.
        dof: degrees of freedom of the patches (B, 3 s); -1 is padding.
        device: Warp device.
    """
    if device != "cpu" and factor.size <= DENSE:
        return Dense(factor.dense(device), dof)
    return Sparse(factor, dof, device)


def spread(dof: torch.Tensor, values: torch.Tensor, size: int) -> torch.Tensor:
    """Patch values (k, 3 s) in vectors of the whole body (size, k); dof (k, 3 s), with -1 for padding (values there
    must be 0)."""
    out = torch.zeros((size, len(dof)), dtype=values.dtype, device=values.device)
    return out.scatter_add_(0, dof.clamp(min=0).T, values.T)


def _times(inverse: torch.Tensor, right: np.ndarray) -> np.ndarray:
    """The inverse (3 n, 3 n) [m/N] on a GPU times forces (3 n, k) [N] on the host."""
    out = inverse @ torch.as_tensor(right, dtype=inverse.dtype, device=inverse.device)
    return out.to(torch.float64).cpu().numpy()


class Dense:
    """How the body at rest responds to forces, for the touches of one run: all of it on a GPU, without the host.

    Products with the dense inverse (3 n, 3 n) [m/N] on a GPU; forces on patches multiply only the columns of all
    patches, whose degrees of freedom are ``dof`` (B, 3 s), -1 at padding."""

    resident = True
    """Whether all is done on a GPU, without the host."""

    def __init__(self, inverse: torch.Tensor, dof: torch.Tensor):
        self._inverse, self._dof = inverse, dof
        together = torch.unique(dof[dof >= 0])
        self._columns = inverse[:, together].contiguous()
        place = torch.zeros(len(inverse), dtype=torch.int64, device=dof.device)
        place[together] = torch.arange(len(together), device=dof.device)
        self._place = torch.where(dof >= 0, place[dof.clamp(min=0)], 0)

    def between(self, touches: torch.Tensor, dof: torch.Tensor) -> torch.Tensor:
        """Compliance (k, m, m) [m/N] between the degrees of freedom ``dof`` (k, m) of the patches of ``touches`` (k,);
        0 where held and at padding."""
        at = self._dof[touches].gather(1, dof)
        mask, index = (at >= 0).to(torch.float64), at.clamp(min=0)
        table = self._inverse[index[:, :, None], index[:, None, :]].to(mask.dtype) * mask[:, :, None] * mask[:, None, :]
        return 0.5 * (table + table.mT)

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        """Displacements (3 n, k) [m] under forces (3 n, k) [N] that are 0 where held."""
        return (self._inverse @ right.to(self._inverse.dtype)).to(right.dtype)

    def patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Displacements (3 n, k) [m] under forces (k, 3 s) [N] on the patches of ``touches`` (k,)."""
        if not self._columns.shape[1]:  # no touch reaches anything
            return torch.zeros((len(self._inverse), len(touches)), dtype=force.dtype, device=force.device)
        pushed = self._columns.new_zeros((self._columns.shape[1], len(touches)))
        pushed.scatter_add_(0, self._place[touches].T, force.to(pushed.dtype).T)
        return (self._columns @ pushed).to(force.dtype)


class Sparse:
    """As `Dense`, by solves on the host; for few touches also the columns of the inverse under the nodes that are
    touched."""

    resident = False

    def __init__(self, factor: RestFactor, dof: torch.Tensor, device: str):
        self._factor, self._dof = factor, dof
        self._nodes = dof.cpu().numpy()[:, ::3] // 3  # -1 at padding
        batch, width = dof.shape
        few = batch <= _FEW and 8.0 * batch * width * factor.size <= _COLUMNS_BYTES
        real = torch.float64 if factor.real is np.float64 else torch.float32  # factorised here, before a frame's limit
        self._whole = torch.zeros((batch, width, factor.size), device=device, dtype=real) if few else None
        self._compliance = torch.zeros((batch, width, width), dtype=torch.float64, device=device)
        self._ready = np.zeros((batch, width // 3), bool)

    def _prepare(self, touches: torch.Tensor, dof: torch.Tensor) -> None:
        """Make what `between` and `patch` need for forces on ``dof`` (k, m)."""
        for b, row in zip(touches.tolist(), dof.cpu().numpy(), strict=True):
            own, asked = self._nodes[b], np.zeros_like(self._ready[b])
            asked[row // 3] = True
            asked &= ~self._ready[b] & (own >= 0)
            if not asked.any():
                continue
            self._ready[b] |= asked
            at, there = (torch.as_tensor((3 * np.flatnonzero(which)[:, None] + np.arange(3)).ravel())
                         for which in (asked, own >= 0))
            columns = torch.as_tensor(self._factor.columns(own[asked]))
            if self._whole is not None:
                self._whole[b, at] = columns.to(self._whole)
            self._compliance[b, at[:, None], there] = columns[:, self._dof[b, there].cpu()].to(self._compliance)

    def between(self, touches: torch.Tensor, dof: torch.Tensor) -> torch.Tensor:
        self._prepare(touches, dof)
        table = torch.stack([self._compliance[b].index_select(0, own).index_select(1, own)
                             for b, own in zip(touches.tolist(), dof, strict=True)])
        return 0.5 * (table + table.mT)

    def solve(self, right: torch.Tensor) -> torch.Tensor:
        return torch.as_tensor(self._factor.apply(right.detach().cpu().numpy()), device=right.device)

    def patch(self, touches: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        if self._whole is not None:
            return torch.stack([self._combine(self._whole[b], f) for b, f in zip(touches.tolist(), force, strict=True)],
                               dim=1).to(force.dtype)
        free = torch.as_tensor(self._factor.free, device=force.device)[:, None]
        return self.solve(spread(self._dof[touches], force, self._factor.size) * free)

    @staticmethod
    def _combine(columns: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        """Sum of the columns (3 s, 3 n) with the weights ``force`` (3 s,). Reading them is the cost: for a small
        contact only its own are read."""
        force = force.to(columns.dtype)
        used = force.nonzero()[:, 0]
        return force @ columns if len(used) > _SPARSE * len(force) else force[used] @ columns[used]


Response = Dense | Sparse
