"""The composition structure of an object and the Gaussian prior on it (SBML section 3.2, eq. 4, 10-12, appendix C.5).

The stiffnesses of the particles are a superposition of components, theta = B phi with independent Gaussian phi:

    HE   one component a particle (heterogeneous)
    HO   one component for all particles (homogeneous)
    SEG  one component a segment; segments are clusters of similar features, 10 of them

so that theta ~ N(mean + G g, diag(var) + G diag(group_var) G^T), with the columns of G the members of the shared
components.
B = [I, G] is sparse with two ones a row at most, and no n x n matrix is ever formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from vsfsim.core.errors import VsfError, did_you_mean

STRUCTURES = ("HE", "HE+HO", "HE+SEG")
SEGMENTS = 10
"""Segments of HE+SEG (SBML appendix C.5)."""

_ITERATIONS, _RESTARTS = 60, 2
# Features a mixture sees at most: the leading principal components; more would be noise to a clustering.
_COMPONENTS = 12
# Particles on which the mixture is fitted; all of them are then assigned.
_SAMPLE = 4000
# A segment narrower than this fraction of the whole along some direction has collapsed onto single particles.
_FLOOR = 1e-3


@dataclass(frozen=True)
class Composition:
    """Which particles share a component.

    membership: G, one column a shared component, ones for its particles (n, s) sparse; s = 0 for HE.
    features: visual features of the shared components, the mean of their particles' (s, F).
    """

    membership: sparse.csr_matrix
    features: np.ndarray

    @classmethod
    def of(cls, structure: str, features: np.ndarray, *, segments: int = SEGMENTS, seed: int = 0) -> Composition:
        """Components of one object.

        Args:
            structure: one of `STRUCTURES`.
            features: normalised features of the particles (n, F).
            segments: how many clusters at most, for HE+SEG.
            seed: of the clustering.

        Raises:
            VsfError: an unknown structure, no particle, or no segment.
        """
        n = len(features)
        if structure not in STRUCTURES:
            raise VsfError(f"vsf.composition: structure is '{structure}'. {did_you_mean(structure, STRUCTURES)}")
        if n == 0 or segments < 1:
            raise VsfError(f"vsf.composition: {n} particles and {segments} segments; both must be at least 1.")
        if structure == "HE":
            return cls(sparse.csr_matrix((n, 0)), np.zeros((0, features.shape[1]), features.dtype))
        label = np.zeros(n, int) if structure == "HE+HO" else segment(features, segments, seed=seed)
        count = int(label.max()) + 1
        membership = sparse.csr_matrix((np.ones(n), (np.arange(n), label)), shape=(n, count))
        share = np.asarray(membership.sum(axis=0)).ravel()
        return cls(membership, (membership.T @ features) / share[:, None])


@dataclass(frozen=True)
class GaussianPrior:
    """N(mean + G group_mean, diag(var) + G diag(group_var) G^T) on the stiffnesses of one object.

    mean, var: of the heterogeneous components (n,) [N/m], [(N/m)^2], var > 0. membership: G (n, s).
    group_mean, group_var: of the shared components (s,) [N/m], [(N/m)^2], group_var > 0.
    """

    mean: np.ndarray
    var: np.ndarray
    membership: sparse.csr_matrix
    group_mean: np.ndarray
    group_var: np.ndarray

    @classmethod
    def plain(cls, mean: np.ndarray | float, var: np.ndarray | float, particles: int) -> GaussianPrior:
        """Independent particles: no shared component."""
        size = (particles,)
        return cls(np.broadcast_to(np.asarray(mean, float), size), np.broadcast_to(np.asarray(var, float), size),
                   sparse.csr_matrix((particles, 0)), np.zeros(0), np.zeros(0))

    def total_mean(self) -> np.ndarray:
        """Mean of the stiffnesses B mu (n,) [N/m]; may be negative."""
        return self.mean + self.membership @ self.group_mean

    def total_std(self) -> np.ndarray:
        """Their standard deviations (n,) [N/m]."""
        return np.sqrt(self.var + self.membership.multiply(self.membership) @ self.group_var)


def segment(features: np.ndarray, count: int, *, seed: int = 0) -> np.ndarray:
    """Clusters of similar features: labels (n,) int, 0 .. at most count - 1, each one used.

    A Gaussian mixture with full covariances by expectation maximisation (Dempster, Laird and Rubin 1977), on the
    leading principal components, started by k-means++; the best of a few starts. Same input and seed, same labels.

    Args:
        features: (n, F), finite. count: clusters at most. seed: of the starts, >= 0.
    """
    values = np.asarray(features, np.float64)
    values = values - values.mean(axis=0)
    size, axes = np.linalg.eigh(values.T @ values)
    keep = max(1, min(_COMPONENTS, int(np.count_nonzero(size > 1e-12 * max(size[-1], 1e-300)))))
    values = values @ axes[:, ::-1][:, :keep]
    count = min(count, len(np.unique(values, axis=0)))
    if count <= 1:
        return np.zeros(len(values), int)
    floor = _FLOOR * float(values.var(axis=0).mean()) + 1e-12
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    sample = values if len(values) <= _SAMPLE else values[np.sort(rng.choice(len(values), _SAMPLE, replace=False))]
    best: tuple = ()
    best_fit = -np.inf
    for _ in range(_RESTARTS):
        mixture, fit = _expectation_maximisation(sample, count, floor, rng)
        if fit > best_fit:
            best, best_fit = mixture, fit
    label = np.argmax(_log_joint(values, *best), axis=1)
    return np.unique(label, return_inverse=True)[1]


def _expectation_maximisation(values: np.ndarray, count: int, floor: float,
                              rng: np.random.Generator) -> tuple[tuple, float]:
    nearest = _kmeans(values, count, rng)
    share = np.eye(count)[nearest]
    before = -np.inf
    for _ in range(_ITERATIONS):
        weight = share.sum(axis=0) + 1e-9
        mean = share.T @ values / weight[:, None]
        covariance = np.stack([((values - m).T * s) @ (values - m) / w for m, s, w in zip(mean, share.T, weight)])
        # A tenth of what all clusters share keeps a covariance of a handful of particles honest.
        pooled = np.einsum("k,kij->ij", weight / weight.sum(), covariance)
        factor = np.linalg.cholesky(0.9 * covariance + 0.1 * pooled + floor * np.eye(values.shape[1]))
        mixture = (np.log(weight / weight.sum()), mean, factor)
        joint = _log_joint(values, *mixture)
        top = joint.max(axis=1, keepdims=True)
        total = top[:, 0] + np.log(np.exp(joint - top).sum(axis=1))
        share = np.exp(joint - total[:, None])
        fit = float(total.mean())
        if fit - before < 1e-5:
            break
        before = fit
    return mixture, fit


def _log_joint(values: np.ndarray, log_weight: np.ndarray, mean: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """log of weight times density (n, k), without the constant."""
    out = np.empty((len(values), len(mean)))
    for k in range(len(mean)):
        white = (values - mean[k]) @ np.linalg.inv(factor[k]).T
        out[:, k] = log_weight[k] - 0.5 * np.einsum("ij,ij->i", white, white) - np.log(np.diag(factor[k])).sum()
    return out


def _kmeans(values: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Labels (n,) of k-means from a k-means++ start (Arthur and Vassilvitskii 2007)."""
    centres = values[rng.integers(len(values))][None]
    for _ in range(count - 1):
        away = ((values[:, None] - centres[None]) ** 2).sum(axis=2).min(axis=1)
        total = away.sum()
        pick = rng.choice(len(values), p=away / total) if total > 0.0 else rng.integers(len(values))
        centres = np.concatenate([centres, values[pick][None]])
    for _ in range(20):
        label = ((values[:, None] - centres[None]) ** 2).sum(axis=2).argmin(axis=1)
        moved = np.stack([values[label == k].mean(axis=0) if (label == k).any() else centres[k] for k in range(count)])
        if np.allclose(moved, centres):
            break
        centres = moved
    return label
