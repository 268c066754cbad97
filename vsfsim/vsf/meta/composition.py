"""The composition structure of an object and the Gaussian prior on it (SBML section 3.2, eq. 4, 10-12, appendix C.5).

The stiffnesses of the particles are a superposition of components, theta = B phi with independent Gaussian phi:

    HE   one component a particle (heterogeneous)
    HO   one component for all particles (homogeneous)
    SEG  one component a segment; segments are clusters of similar features, 10 of them

so that theta ~ N(mean + G g, diag(var) + G diag(group_var) G^T), with the columns of G the members of the shared
components. B = [I, G] is sparse with at most two ones in a row, and no n x n matrix is formed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from vsfsim.core.errors import VsfError, one_of

STRUCTURES = ("HE", "HE+HO", "HE+SEG")
SEGMENTS = 10
"""Segments of HE+SEG (SBML appendix C.5)."""

_COMPONENTS = 12
"""The most principal components that a mixture is fitted to; further ones would add noise."""
_SAMPLE = 4000
"""The most particles that a mixture is fitted to; all particles are then assigned."""
_FLOOR = 1e-3
"""Added to the variances of a segment, as a fraction of the mean variance: it keeps a segment from collapsing onto
a few particles."""


@dataclass(frozen=True)
class Composition:
    """Which particles share a component."""

    membership: sparse.csr_matrix
    """G, one column for each shared component, with ones for its particles (n, s) sparse; s = 0 for HE."""
    features: np.ndarray
    """Visual features of the shared components, the means of their particles' (s, F)."""

    @classmethod
    def of(cls, structure: str, features: np.ndarray, *, segments: int = SEGMENTS, seed: int = 0) -> Composition:
        """Components of one object.

        Args:
            structure: one of `STRUCTURES`.
            features: normalised features of the particles (n, F).
            segments: the most segments, for HE+SEG.
            seed: of the clustering.

        Raises:
            VsfError: an unknown structure, no particle, or no segment.
        """
        n = len(features)
        one_of(structure, STRUCTURES, "vsf.composition: structure", VsfError)
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
    """N(mean + G group_mean, diag(var) + G diag(group_var) G^T) on the stiffnesses of one object."""

    mean: np.ndarray
    """Means of the heterogeneous components (n,) [N/m]."""
    var: np.ndarray
    """Their variances, > 0, or all 0 where only the shared components vary (n,) [(N/m)^2]."""
    membership: sparse.csr_matrix
    """G of `Composition` (n, s)."""
    group_mean: np.ndarray
    """Means of the shared components (s,) [N/m]."""
    group_var: np.ndarray
    """Their variances, > 0 (s,) [(N/m)^2]."""

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

    A Gaussian mixture with full covariances on the leading principal components; the better of two fits. The same
    input and seed give the same labels.

    Args:
        features: (n, F), finite.
        count: the most clusters.
        seed: of the starts, >= 0.
    """
    # Only HE+SEG needs scikit-learn, whose import takes a second.
    from sklearn.decomposition import PCA
    from sklearn.mixture import GaussianMixture

    values = np.asarray(features, np.float64)
    count = min(count, len(np.unique(values, axis=0)))
    if count <= 1:
        return np.zeros(len(values), int)
    values = PCA(min(_COMPONENTS, *values.shape), svd_solver="full").fit_transform(values)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    sample = values if len(values) <= _SAMPLE else values[np.sort(rng.choice(len(values), _SAMPLE, replace=False))]
    floor = _FLOOR * float(values.var(axis=0).mean()) + 1e-12
    mixture = GaussianMixture(count, reg_covar=floor, n_init=2, random_state=seed).fit(sample)
    return np.unique(mixture.predict(values), return_inverse=True)[1]
