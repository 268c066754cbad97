"""A factor of a part of a matrix that corrects a preconditioner of the whole where it is poor.

With B an approximation of the matrix, L the inverse of its part on some unknowns, 0 elsewhere, and P the inverse that
the preconditioner of the whole stands for, the corrected one is

    L + (1 - L B) P (1 - B L),

a symmetric multiplicative Schwarz method of two subdomains (Toselli and Widlund 2005, section 2.2). It is positive
definite for every symmetric B whose part is.
"""

import numpy as np
import scipy.sparse as sp

from vsfsim.core.errors import MeshError
from vsfsim.physics.runtime import muted

_INDEFINITE = "The tangent of a part of the body is not positive definite."
_EXACT = 1e-6  # relative residual up to which a factor counts as one


class LocalFactor:
    """The part of a matrix on some unknowns, factorised.

    Args:
        rows: the matrix's rows of these unknowns (l, 3 n).
        unknowns: their numbers (l,).
        touched: those of contact's stiffness that is in ``rows`` (t,).

    Raises:
        MeshError: the part is not positive definite.
    """

    def __init__(self, rows: sp.csr_matrix, unknowns: np.ndarray, touched: np.ndarray):
        import cholespy  # CHOLMOD; only a body that is solved needs it

        part = rows[:, unknowns].tocoo()
        self._unknowns, self._rows, self._columns = unknowns, rows, rows.T.tocsr()
        try:
            with muted(1):  # CHOLMOD prints a warning where the part is not positive definite
                self._solver = cholespy.CholeskySolverD(
                    len(unknowns), part.row.astype(np.int32), part.col.astype(np.int32), part.data.astype(np.float64),
                    cholespy.MatrixType.COO)
        except ValueError as e:
            raise MeshError(_INDEFINITE) from e
        self._touched = set(np.intersect1d(touched, unknowns).tolist())
        right = np.ones(len(unknowns))
        x = self._solve(right)
        if not (np.abs(part @ x - right).max() <= _EXACT and right @ x > 0.0):
            raise MeshError(_INDEFINITE)

    def holds(self, touched: np.ndarray) -> bool:
        """Whether contact's stiffness at the unknowns ``touched`` (t,) is in the factor."""
        return self._touched.issuperset(touched.tolist())

    def _solve(self, right: np.ndarray) -> np.ndarray:
        out = np.empty((len(right), 1))
        self._solver.solve(np.ascontiguousarray(right[:, None]), out)
        return out[:, 0]

    def before(self, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The part's own solution (l,) of forces ``right`` (3 n,), and the forces that it leaves to the whole
        (3 n,)."""
        own = self._solve(right[self._unknowns])
        return own, right - self._columns @ own

    def after(self, right: np.ndarray, own: np.ndarray, whole: np.ndarray) -> np.ndarray:
        """The solution (3 n,) of forces ``right`` (3 n,), from that of the part (l,) and the preconditioner's for what
        that left (3 n,)."""
        out = whole.copy()
        out[self._unknowns] += own
        out[self._unknowns] += self._solve(right[self._unknowns] - self._rows @ out)
        return out
