"""How stiff, once it is known where: the level of a learned prior, from objects that it was not learned on.

Maximum likelihood on a few objects (SBML eq. 15) tells well *where* an object is stiff and badly *how* stiff it is: the
absolute residuals of the stiff objects decide the mean, and a network that extrapolates to a new material may miss its
level several times over. The papers prevent overfitting by early stopping, dropout and the initial variance (appendix
A); this module is ours and adds what a few objects can still tell:

1. Several networks, each stopped early on another part of the training objects. Together they are the prior, with the
   mean of their variances and the variance of their means.
2. Every training object is then predicted by the one network that took no step on it. With p its answer, r that of its
   *pattern* (its mean scaled so that it averages the naive mean near the visible surface), q that of the naive prior
   (one mean for all particles, of the other objects) and z the readings,

       a, b, c = argmin  sum over objects |z - a p - b r - c q|^2 / |z|^2,   a, b, c >= 0

   are the weights of the means. Standard deviations are weighted by the same numbers over their sum, because a lower
   level does not make single springs better known. Objects count alike, as in the score, so that a soft one is not a
   detail of a stiff one. Networks whose level says less than the naive one's leave it to the naive prior and keep their
   pattern, and networks that know nothing lose their weight.
3. What is left of the level differs from object to object: with m the answer of the blend, its factor is
   s = (m, z) / (m, m). One component common to all particles, with the blend's means as its members and the variance of
   s as its variance, lets one touch correct the whole object. It is the homogeneous component of section 4.5 with a
   multiple of the mean in place of a constant.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import optimize, sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.meta.composition import GaussianPrior


@dataclass(frozen=True)
class Held:
    """An object that a network did not learn from, as all touches of it together."""

    readings: np.ndarray
    """z (m,), in any unit that is common to the answers."""
    answers: np.ndarray
    """What the network's mean, its pattern at the naive level and the naive mean predict (m, 3)."""


@dataclass(frozen=True)
class Level:
    """The weights of a blend, and what it does not know of an object's level."""

    network: float = 1.0
    """a, of the networks' means [-]."""
    pattern: float = 0.0
    """b, of their patterns at the naive level [-]."""
    naive: float = 0.0
    """c, of the naive mean [-]."""
    std: float = 0.0
    """Standard deviation of the factor common to an object [-]; 0 without such a component."""

    @classmethod
    def of(cls, objects: Sequence[Held]) -> Level:
        """Weights and spread that fit objects best.

        Raises:
            VsfError: no object has a reading that a mean predicts.
        """
        used = [one for one in objects if np.linalg.norm(one.readings) > 0.0 and np.abs(one.answers).max(initial=0.0)]
        if not used:
            raise VsfError("vsf.level: no training object has readings that a touched particle explains; give a train "
                           "split whose touches meet the objects.")
        size = [np.linalg.norm(one.readings) for one in used]
        weights = optimize.nnls(np.concatenate([one.answers / s for one, s in zip(used, size)]),
                                np.concatenate([one.readings / s for one, s in zip(used, size)]))[0]
        blends = [(one.answers @ weights, one.readings) for one in used]
        factors = [float(m @ z) / float(m @ m) for m, z in blends if m @ m > 0.0]
        a, b, c = (float(w) for w in weights)
        return cls(a, b, c, float(np.sqrt(np.mean((np.array(factors) - 1.0) ** 2))))


def pattern_scale(mean: np.ndarray, near: np.ndarray, level: float) -> float:
    """Factor by which ``mean`` (n,) averages ``level`` over the particles ``near`` (n,) bool; 1 where it is not
    positive there."""
    average = float(mean[near].mean()) if near.any() else 0.0
    return level / average if average > 0.0 else 1.0


def blended(priors: Sequence[GaussianPrior], level: Level, near: np.ndarray, *, naive_mean: float,
            naive_var: float) -> GaussianPrior:
    """One prior of one object from those of several networks.

    Args:
        priors: with the same shared components.
        level: the weights, and the standard deviation of the common factor.
        near: particles near the visible surface (n,) bool, on which patterns are compared.
        naive_mean, naive_var: of the spring constants of the training objects [N/m], [(N/m)^2].
    """
    a, b, c = level.network, level.pattern, level.naive
    scales = [pattern_scale(p.total_mean(), near, naive_mean) for p in priors]
    weights = ((a, [1.0] * len(priors)), (b, scales))
    mean, var = _mixed([(p.mean, p.var) for p in priors], weights)
    shared_mean, shared_var = _mixed([(p.group_mean, p.group_var) for p in priors], weights)
    total = a + b + c
    if total > 0.0:
        var, shared_var = (var + c**2 * naive_var) / total**2, shared_var / total**2
    # A blend of weight 0, or one network's floor, must not make a prior without any variance.
    least = 1e-6 * naive_var
    out = GaussianPrior(mean + c * naive_mean, np.maximum(var, least), priors[0].membership, shared_mean,
                        np.maximum(shared_var, least))
    if level.std == 0.0:
        return out
    column = sparse.csr_matrix(np.maximum(out.total_mean(), 0.0)[:, None])
    return GaussianPrior(out.mean, out.var, sparse.csr_matrix(sparse.hstack([out.membership, column])),
                         np.append(out.group_mean, 0.0), np.append(out.group_var, level.std**2))


def _mixed(parts: Sequence[tuple[np.ndarray, np.ndarray]],
           weights: Sequence[tuple[float, Sequence[float]]]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of a weighted sum of mixtures of ``parts`` (means and variances), each mixture of the parts
    times its own factors; the mixtures err together."""
    mean, std = np.zeros_like(parts[0][0]), np.zeros_like(parts[0][1])
    for weight, factors in weights:
        means = [k * m for k, (m, _) in zip(factors, parts, strict=True)]
        spreads = [k**2 * v for k, (_, v) in zip(factors, parts, strict=True)]
        mean = mean + weight * np.mean(means, axis=0)
        std = std + weight * np.sqrt(np.mean(spreads, axis=0) + np.var(means, axis=0))
    return mean, std**2
