"""The Cholesky factor of the rest-state stiffness: paid once for an object, it serves every touch of it."""

from __future__ import annotations

import time

import numpy as np
import scipy.sparse as sp

_CHUNK = 64  # right-hand sides solved at once: more gain nothing on a CPU and cost memory


class RestFactor:
    """Linear elasticity of the object at rest, with its supports held, factorised.

    size: degrees of freedom, 3 n. seconds: what the factorisation took [s].
    stiffness: the rest stiffness, supports not held (3 n, 3 n) [N/m].

    Args:
        stiffness: of all blocks of the model at rest, supports not held (3 n, 3 n) [N/m].
        free: 1 where a degree of freedom may move, 0 where it is held (3 n,).
        surface_nodes: nodes (s,) that `compliance` may be asked for.
    """

    def __init__(self, stiffness: sp.csr_matrix, free: np.ndarray, surface_nodes: np.ndarray):
        import cholespy  # CHOLMOD; only a body that is solved needs it

        began = time.perf_counter()
        self.stiffness = stiffness
        mask = sp.diags(free)
        k = (mask @ stiffness @ mask + sp.diags(1.0 - free)).tocoo()
        self.size = k.shape[0]
        # the factor stays in double: single precision loses the soft parts of a body with stiff inclusions
        self._solver = cholespy.CholeskySolverD(
            self.size, k.row.astype(np.int32), k.col.astype(np.int32), k.data.astype(np.float64), cholespy.MatrixType.COO)
        self._surface = np.asarray(surface_nodes)
        self._row_of = np.full(self.size // 3, -1)
        self._row_of[self._surface] = np.arange(len(self._surface))
        self._columns: dict[int, np.ndarray] = {}
        self.seconds = time.perf_counter() - began

    def solve(self, right: np.ndarray) -> np.ndarray:
        """K^-1 ``right``, both (3 n, k), rows of held degrees of freedom must be 0."""
        right = np.ascontiguousarray(right, dtype=np.float64)
        out = np.empty_like(right)
        for start in range(0, right.shape[1], _CHUNK):
            part = np.ascontiguousarray(right[:, start:start + _CHUNK])
            result = np.empty_like(part)
            self._solver.solve(part, result)
            out[:, start:start + _CHUNK] = result
        return out

    def compliance(self, nodes: np.ndarray) -> np.ndarray:
        """Displacement of ``nodes`` (s,) on the surface per unit force on them, (3 s, 3 s) [m/N].

        Columns are solved once per node and kept: neighbouring touches share them.
        """
        missing = [int(i) for i in nodes if int(i) not in self._columns]
        for start in range(0, len(missing), _CHUNK // 3):
            part = missing[start:start + _CHUNK // 3]
            right = np.zeros((self.size, 3 * len(part)))
            for j, i in enumerate(part):
                right[[3 * i, 3 * i + 1, 3 * i + 2], [3 * j, 3 * j + 1, 3 * j + 2]] = 1.0
            answer = self.solve(right).reshape(-1, 3, 3 * len(part))[self._surface]
            for j, i in enumerate(part):
                self._columns[i] = np.ascontiguousarray(answer[:, :, 3 * j:3 * j + 3])
        rows = self._row_of[nodes]
        out = np.empty((len(nodes), 3, len(nodes), 3))
        for j, i in enumerate(nodes):
            out[:, :, j, :] = self._columns[int(i)][rows]
        out = out.reshape(3 * len(nodes), 3 * len(nodes))
        return 0.5 * (out + out.T)
