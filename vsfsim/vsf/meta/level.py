"""How stiff, once it is known where: the level of a learned prior, from objects that it was not learned on.

Maximum likelihood on a few objects (SBML eq. 15) tells well *where* an object is stiff and badly *how* stiff it is: the
absolute residuals of the stiff objects decide the mean, and a network that extrapolates to a new material may miss its
level several times over. The papers prevent overfitting by early stopping, dropout and the initial variance (appendix
A); this module is ours and adds what a few objects can still tell:

1. Several networks, each stopped early on another part of the training objects. Together they are the prior, with the
   mean of their variances and the variance of their means.
2. Every training object is then predicted by the one network that took no step on it. With p its answer, q that of the
   naive prior (one mean for all particles, of the other objects) and z the readings,

       a, b = argmin  sum over objects |z - a p - b q|^2 / |z|^2,   a, b >= 0

   are the weights of networks and naive prior. Objects count alike, as in the score, so that a soft one is not a detail
   of a stiff one. Networks that know less than the naive prior lose their weight to it.
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
    """z (m,), in any unit that is common to the three."""
    network: np.ndarray
    """What the network's mean predicts (m,)."""
    naive: np.ndarray
    """What the mean of the other objects predicts (m,)."""


@dataclass(frozen=True)
class Level:
    """The weights of a blend, and what it does not know of an object's level."""

    network: float = 1.0
    """a, of the networks' means [-]."""
    naive: float = 0.0
    """b, of the naive mean [-]."""
    std: float = 0.0
    """Standard deviation of the factor common to an object [-]; 0 without such a component."""

    @classmethod
    def of(cls, objects: Sequence[Held]) -> Level:
        """Weights and spread that fit objects best.

        Raises:
            VsfError: no object has a reading that either mean predicts.
        """
        used = [one for one in objects if np.linalg.norm(one.readings) > 0.0
                and (np.abs(one.network).max(initial=0.0) > 0.0 or np.abs(one.naive).max(initial=0.0) > 0.0)]
        if not used:
            raise VsfError("vsf.level: no training object has readings that a touched particle explains; give a train "
                           "split whose touches meet the objects.")
        size = [np.linalg.norm(one.readings) for one in used]
        answers = np.concatenate([np.stack([one.network, one.naive], axis=1) / s for one, s in zip(used, size)])
        a, b = optimize.nnls(answers, np.concatenate([one.readings / s for one, s in zip(used, size)]))[0]
        factors = []
        for one in used:
            blend = a * one.network + b * one.naive
            if blend @ blend > 0.0:
                factors.append(float(blend @ one.readings) / float(blend @ blend))
        return cls(float(a), float(b), float(np.sqrt(np.mean((np.array(factors) - 1.0) ** 2))) if factors else 0.0)


def blended(priors: Sequence[GaussianPrior], level: Level, *, naive_mean: float, naive_var: float) -> GaussianPrior:
    """One prior of one object from those of several networks.

    Args:
        priors: with the same shared components.
        level: the weights, and the standard deviation of the common factor.
        naive_mean, naive_var: of the spring constants of the training objects [N/m], [(N/m)^2].
    """
    a, b = level.network, level.naive
    mean, var = _moments([p.mean for p in priors], [p.var for p in priors])
    shared_mean, shared_var = _moments([p.group_mean for p in priors], [p.group_var for p in priors])
    mean, var = a * mean + b * naive_mean, a**2 * var + b**2 * naive_var
    # A blend of weight 0, or one network's floor, must not make a prior without any variance.
    var = np.maximum(var, 1e-6 * naive_var)
    shared_mean, shared_var = a * shared_mean, np.maximum(a**2 * shared_var, 1e-6 * naive_var)
    out = GaussianPrior(mean, var, priors[0].membership, shared_mean, shared_var)
    if level.std == 0.0:
        return out
    column = sparse.csr_matrix(np.maximum(out.total_mean(), 0.0)[:, None])
    return GaussianPrior(mean, var, sparse.csr_matrix(sparse.hstack([out.membership, column])),
                         np.append(out.group_mean, 0.0), np.append(out.group_var, level.std**2))


def _moments(means: Sequence[np.ndarray], variances: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of a mixture in equal parts."""
    return np.mean(means, axis=0), np.mean(variances, axis=0) + np.var(means, axis=0)
