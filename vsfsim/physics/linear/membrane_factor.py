"""The rest stiffness of a membrane over a gas: a sparse factor, and the gas's coupling of all nodes by the
Sherman-Morrison formula.

    K = S + c g g^T,    K^-1 r = S^-1 r - S^-1 g (c g . S^-1 r) / (1 + c g . S^-1 g),    g = grad V,  c = -dp/dV

S is sparse: the elements, and the gas at constant pressure. It is positive definite before the limit point of
inflation.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict

import numpy as np
import scipy.sparse as sp
import torch

from vsfsim.physics.linear.rest_factor import _CHUNK, RestFactor

_KEPT = 4  # in this process, by content
_WHOLE = 8000  # nodes up to which the rows of all of them are kept for each that is pushed

_factors: OrderedDict[str, MembraneFactor] = OrderedDict()


class MembraneFactor(RestFactor):
    """As `RestFactor`, for S + c g g^T with the supports held; ``stiffness`` is S alone.

    Args:
        stiffness, free, surface_nodes, points: as `RestFactor`.
        gradient: g (3 n,) [m^2].
        rate: c [Pa/m^3], 0 for an open chamber.
    """

    coupling: tuple[np.ndarray, float]
    """g, supports not held (3 n,) [m^2], and c [Pa/m^3]."""

    def __init__(self, stiffness: sp.csr_matrix, free: np.ndarray, surface_nodes: np.ndarray, points: np.ndarray,
                 gradient: np.ndarray, rate: float):
        super().__init__(stiffness, free, surface_nodes, points)
        self.coupling = (gradient, rate)
        own = gradient * free
        answer = super().solve(own[:, None])[:, 0]
        self._own, self._answer = own, answer
        self._share = rate / (1.0 + rate * float(own @ answer))

    @classmethod
    def of(cls, stiffness: sp.csr_matrix, free: np.ndarray, surface_nodes: np.ndarray, points: np.ndarray,
           gradient: np.ndarray | None = None, rate: float = 0.0) -> MembraneFactor:
        """As `RestFactor.of`; arguments as the class."""
        assert gradient is not None
        digest = hashlib.sha256()
        for part in (stiffness.indptr, stiffness.indices, stiffness.data, free, np.asarray(surface_nodes), gradient,
                     np.array([rate])):
            digest.update(np.ascontiguousarray(part).tobytes())
        key = digest.hexdigest()
        if key not in _factors:
            _factors[key] = cls(stiffness, free, surface_nodes, points, gradient, rate)
            while len(_factors) > _KEPT:
                _factors.popitem(last=False)
        _factors.move_to_end(key)
        return _factors[key]

    def solve(self, right: np.ndarray) -> np.ndarray:
        """K^-1 ``right``, both (3 n, k), rows of held degrees of freedom must be 0."""
        return self._coupled(super().solve(right))

    def apply(self, right: np.ndarray) -> np.ndarray:
        """As `RestFactor.apply`."""
        return self._coupled(super().apply(right))

    def _coupled(self, out: np.ndarray) -> np.ndarray:
        return out - self._answer[:, None] * (self._share * (self._own @ out))

    def compliance(self, nodes: np.ndarray, pushed: np.ndarray) -> np.ndarray:
        """As `RestFactor.compliance`. All nodes of a membrane are its surface: of a fine one, only the rows asked for
        are kept, and not for other touches."""
        if self.size <= 3 * _WHOLE:
            return super().compliance(nodes, pushed)
        rows, columns = ((3 * np.asarray(n)[:, None] + np.arange(3)).ravel() for n in (nodes, pushed))
        out = np.empty((len(rows), len(columns)))
        for start in range(0, len(columns), _CHUNK):
            part = columns[start:start + _CHUNK]
            right = np.zeros((self.size, len(part)))
            right[part, np.arange(len(part))] = self.free[part]
            out[:, start:start + len(part)] = self.solve(right)[rows]
        return out

    def _inverse_on(self, device: str) -> torch.Tensor:
        answer = torch.as_tensor(self._answer, device=device)
        return super()._inverse_on(device).addr_(answer, answer, alpha=-self._share)
