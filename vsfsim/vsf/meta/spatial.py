"""What neighbours share: a Gaussian process over the places of the particles, around a learned prior.

With h the prior's means, the springs of an object are

    K = h (1 + g),   cov(g, g') = common^2 + near^2 exp(-|x - x'|^2 / 2 reach^2)

and the readings of a touch are W K + W h t plus noise of one deviation, with t ~ N(0, touch^2) what no place explains.
All is linear and Gaussian, so that touches update K exactly, in a matrix of the size of the readings (Rasmussen and
Williams, Gaussian Processes for Machine Learning, 2006, chapter 2); K >= 0 is not enforced. The five hyper-parameters
maximise the marginal likelihood of all touches of objects that the prior was not learned on (chapter 5), each object
with the same weight. They take the place of an assumed noise, of the variance of an object's level and of independent
springs. This is ours; the papers' springs are independent (eq. 12).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize, sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.meta.composition import GaussianPrior

_CELL = 0.008
"""Particles in one cell of a grid of this width count as one place [m]."""
_BOUNDS = np.log([(1e-2, 1e1), (1e-2, 1e1), (3e-2, 0.3), (1e-2, 1e1), (1e-3, 1e1)])
"""Of the search, the noise in units of the readings' root mean square, the reach in metres. Less than the contact of
a ball of 30 mm fits the curves of single touches and says less of the next touch (docs/methods.md)."""
_STARTS = ((0.7, 0.5, 0.04, 0.1, 0.1), (0.7, 0.5, 0.08, 0.3, 0.1))
_FIRST, _STEPS = 10, 40
"""Steps from each start, and from the better of what they reach."""


@dataclass(frozen=True)
class Places:
    """Where the particles of an object are."""

    centres: np.ndarray
    """Of the cells (c, 3) [m]."""
    member: np.ndarray
    """Cell of each particle (n,) int."""

    @classmethod
    def of(cls, particles: np.ndarray) -> Places:
        """Cells of ``particles`` (n, 3) [m]; the centre of a cell is the mean of its particles."""
        count, of = np.unique(np.floor(particles / _CELL).astype(np.int64), axis=0, return_inverse=True)
        of = of.ravel()
        members = sparse.csr_matrix((np.ones(len(of)), (of, np.arange(len(of)))), shape=(len(count), len(of)))
        return cls((members @ particles) / np.asarray(members.sum(axis=1)), of)

    def pull(self, rows: sparse.csr_matrix, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells that ``rows`` (m, n) meet (u,), and what each of them adds where its springs have ``mean`` (m, u)."""
        n = len(self.member)
        members = sparse.csr_matrix((mean, (np.arange(n), self.member)), shape=(n, len(self.centres)))
        every = sparse.csc_matrix(rows @ members)
        used = np.flatnonzero(np.diff(every.indptr))
        return used, every[:, used].toarray()


@dataclass(frozen=True)
class Felt:
    """All touches of an object under a prior that was not learned on it."""

    readings: np.ndarray
    """z (m,) [unit]."""
    rows: sparse.csr_matrix
    """W (m, n)."""
    touch: np.ndarray
    """Number of the touch of each reading (m,) int."""
    places: Places
    """Of its particles."""
    prior: GaussianPrior
    """Of the springs; its means count."""


@dataclass(frozen=True)
class Spatial:
    """The five hyper-parameters."""

    common: float
    """Deviation of the factor of a whole object [-]."""
    near: float
    """Deviation of the factor that neighbours share [-]."""
    reach: float
    """Distance over which they do [m]."""
    touch: float
    """Deviation of the factor of a single touch [-]."""
    noise: float
    """Deviation of a reading, what the particles cannot say included [unit]."""

    @classmethod
    def of(cls, objects: Sequence[Felt]) -> Spatial:
        """The likeliest ones.

        Raises:
            VsfError: no object has a reading that the prior's mean predicts.
        """
        parts = [_Parts.of(one) for one in objects if len(one.readings)]
        unit = float(np.sqrt(np.mean([np.mean(one.readings**2) for one in objects if len(one.readings)] or [0.0])))
        if not (unit > 0.0 and any(part.common.any() for part in parts)):
            raise VsfError("vsf.spatial: no training object has readings that a touched particle explains; give a "
                           "train split whose touches meet the objects.")

        def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
            found = [part.misfit(logs, unit) for part in parts]
            return (float(np.mean([value for value, _ in found])), np.mean([slope for _, slope in found], axis=0))

        def searched(start: np.ndarray, steps: int) -> optimize.OptimizeResult:
            return optimize.minimize(loss, start, jac=True, method="L-BFGS-B", bounds=_BOUNDS,
                                     options={"maxiter": steps})

        best = searched(min((searched(np.log(start), _FIRST) for start in _STARTS), key=lambda one: one.fun).x, _STEPS)
        common, near, reach, touch, noise = (float(x) for x in np.exp(best.x))
        return cls(common, near, reach, touch, noise * unit)

    def covariance(self, prior: GaussianPrior, places: Places, one: sparse.csr_matrix,
                   other: sparse.csr_matrix) -> np.ndarray:
        """Of two sets of readings without their noise, rows (q, n) and (m, n): (q, m) [unit^2]."""
        mean = np.maximum(prior.mean, 0.0)
        (a, left), (b, right) = places.pull(one, mean), places.pull(other, mean)
        near = _alike(places.centres[a], places.centres[b], self.reach)[0]
        return np.outer(one @ mean, other @ mean) * self.common**2 + self.near**2 * (left @ near @ right.T)


@dataclass(frozen=True)
class Smoothed:
    """The springs of an object after touches, exactly."""

    mean: np.ndarray
    """Of each spring, of any sign (n,) [N/m]."""
    _spatial: Spatial
    _prior: GaussianPrior
    _places: Places
    _rows: sparse.csr_matrix
    _factor: np.ndarray | None

    @classmethod
    def after(cls, spatial: Spatial, prior: GaussianPrior, places: Places, rows: sparse.csr_matrix,
              readings: np.ndarray, touch: np.ndarray) -> Smoothed:
        """Condition on ``readings`` (m,) with ``rows`` (m, n), each of the number ``touch`` (m,)."""
        h = np.maximum(prior.mean, 0.0)
        if not len(readings):
            return cls(h, spatial, prior, places, rows, None)
        table = spatial.covariance(prior, places, rows, rows)
        table += spatial.touch**2 * _of_touches(rows @ h, touch) + spatial.noise**2 * np.eye(len(table))
        factor = linalg.cholesky(table, lower=True)
        weight = linalg.cho_solve((factor, True), readings - rows @ h)
        used, pull = places.pull(rows, h)
        near = _alike(places.centres, places.centres[used], spatial.reach)[0] @ (pull.T @ weight)
        factor_of = spatial.common**2 * float((rows @ h) @ weight) + spatial.near**2 * near[places.member]
        return cls(h * (1.0 + factor_of), spatial, prior, places, rows, factor)

    def reading_std(self, rows: sparse.csr_matrix) -> np.ndarray:
        """Of readings to come, rows (q, n), without their own noise (q,) [unit]."""
        s, h, own = self._spatial, np.maximum(self._prior.mean, 0.0), sparse.csr_matrix(rows)
        used, pull = self._places.pull(own, h)
        at = self._places.centres[used]
        near = np.einsum("ij,ij->i", pull @ _alike(at, at, s.reach)[0], pull)
        before = (s.common**2 + s.touch**2) * (own @ h) ** 2 + s.near**2 * near
        return self._left(before, lambda: s.covariance(self._prior, self._places, own, self._rows))

    def spring_std(self) -> np.ndarray:
        """Of each spring (n,) [N/m]."""
        s, h = self._spatial, np.maximum(self._prior.mean, 0.0)

        def between() -> np.ndarray:
            used, pull = self._places.pull(self._rows, h)
            near = _alike(self._places.centres, self._places.centres[used], s.reach)[0] @ pull.T
            return h[:, None] * (s.common**2 * (self._rows @ h) + s.near**2 * near[self._places.member])

        return self._left(h**2 * (s.common**2 + s.near**2), between)

    def _left(self, before: np.ndarray, between) -> np.ndarray:
        """Deviations where the prior has the variances ``before`` (q,) and ``between`` gives the covariances with the
        readings made (q, m)."""
        if self._factor is None:
            return np.sqrt(before)
        white = linalg.solve_triangular(self._factor, between().T, lower=True)
        return np.sqrt(np.maximum(before - np.einsum("ij,ij->j", white, white), 1e-14 * before))


@dataclass(frozen=True)
class _Parts:
    """What the likelihood of an object is made of."""

    error: np.ndarray
    """z - W h (m,)."""
    common: np.ndarray
    """W h (m,)."""
    touches: np.ndarray
    """The products of W h within each touch (m, m)."""
    pull: np.ndarray
    """Of the cells (m, u)."""
    centres: np.ndarray
    """(u, 3) [m]."""

    @classmethod
    def of(cls, one: Felt) -> _Parts:
        h = np.maximum(one.prior.mean, 0.0)
        used, pull = one.places.pull(one.rows, h)
        said = one.rows @ h
        return cls(one.readings - said, said, _of_touches(said, one.touch), pull, one.places.centres[used])

    def misfit(self, logs: np.ndarray, unit: float) -> tuple[float, np.ndarray]:
        """Minus the logarithm of the likelihood of a reading, without its constant, and its slope by ``logs`` (5,)."""
        common, near, reach, touch, noise = np.exp(logs) * [1.0, 1.0, 1.0, 1.0, unit]
        alike, squared = _alike(self.centres, self.centres, reach)
        parts = [common**2 * np.outer(self.common, self.common), near**2 * (self.pull @ alike @ self.pull.T),
                 near**2 * (self.pull @ (alike * squared) @ self.pull.T),
                 touch**2 * self.touches, noise**2 * np.eye(len(self.error))]
        factor = linalg.cholesky(parts[0] + parts[1] + parts[3] + parts[4], lower=True)
        inverse = linalg.cho_solve((factor, True), np.eye(len(self.error)))
        weight = inverse @ self.error
        value = 0.5 * self.error @ weight + np.log(np.diag(factor)).sum()
        # d part / d log is twice the part, but for the reach, whose part is the derivative already
        slope = [(1.0 if k == 2 else 2.0) * 0.5 * (np.sum(inverse * part) - weight @ part @ weight)
                 for k, part in enumerate(parts)]
        return float(value) / len(self.error), np.array(slope) / len(self.error)


def _of_touches(values: np.ndarray, touch: np.ndarray) -> np.ndarray:
    """Products of ``values`` (m,) of the same touch, 0 elsewhere (m, m)."""
    return np.outer(values, values) * (touch[:, None] == touch)


def _alike(a: np.ndarray, b: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Correlations of places (n, 3) and (m, 3) [m], and the squares of their distances over the reach (n, m) [-]."""
    squared = (np.sum(a**2, axis=1)[:, None] + np.sum(b**2, axis=1) - 2.0 * a @ b.T).clip(0.0) / reach**2
    return np.exp(-0.5 * squared), squared
