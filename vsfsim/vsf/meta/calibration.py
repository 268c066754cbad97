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

What touches tell of other places: `Shares`, in place of the third step. The springs of an object deviate from the
blend's means by a number common to all, by numbers that neighbours share, and each by itself,

    K = mean + common u 1 + near u B phi + springs sqrt(var) epsilon,   phi, epsilon ~ N(0, 1)

with u the naive mean and B the averages of knots a reach apart. These are components of section 3.2 whose members
overlap, and eq. 16 holds for them. The three deviations and the noise of a reading maximise the likelihood of eq. 15
over the objects that the networks did not learn from, each with the same weight.

How wide: the standard deviations of predicted readings, from objects that a prior was not learned on.

In eq. 15 and 16 of SBML the noise of a reading stands for all that the particle model gets wrong in a whole touch; it
weighs touches against the prior. It says little of the error of a single frame: one that moves no particle is predicted
to the sensor's noise, and all frames of a touch err together. So the variance of a reading has a form of its own, which
is ours,

    v = free^2                                             if the frame moves no particle
    v = free^2 + contact^2 + (share p)^2 + (springs s)^2   else

with p the predicted reading and s the standard deviation that the posterior of the springs gives it. The four factors
maximise the likelihood of the readings of objects that the prior was not learned on, before any touch and after half of
their touches. Objects count alike. Means do not change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg, optimize, sparse

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


@dataclass(frozen=True)
class Felt:
    """All touches of an object under a prior that was not learned on it: its covariance by parts."""

    error: np.ndarray
    """Readings minus those of the prior's mean (m,) [N]."""
    parts: np.ndarray
    """Covariances of the readings (3, m, m) [N^2] for deviations of 1: the springs', the common and the near one."""

    @classmethod
    def of(cls, rows: sparse.csr_matrix, readings: np.ndarray, prior: GaussianPrior, knots: sparse.csr_matrix,
           unit: float) -> Felt:
        """From W (m, n), z (m,), a prior without shared components, B (n, s) and u [N/m]."""
        near, own = (unit * (rows @ knots)).toarray(), unit * np.asarray(rows.sum(axis=1))
        springs = (rows @ sparse.diags_array(prior.var) @ rows.T).toarray()
        return cls(readings - rows @ prior.total_mean(), np.stack([springs, own @ own.T, near @ near.T]))


@dataclass(frozen=True)
class Shares:
    """How springs deviate from a learned prior, and the noise of a reading."""

    springs: float
    """Factor of the prior's own standard deviations [-]."""
    common: float
    """Deviation of the part common to an object, over the naive mean [-]."""
    near: float
    """Of the part that neighbours share, likewise [-]."""
    noise: float
    """Standard deviation of a reading, with what the particles cannot say [N]."""

    @classmethod
    def of(cls, objects: Sequence[Felt]) -> Shares:
        """The likeliest.

        Raises:
            VsfError: no object has a reading that a touched particle explains.
        """
        used = [one for one in objects if one.parts[1].any()]
        if not used:
            raise VsfError("vsf.shares: no training object has readings that a touched particle explains; give a train "
                           "split whose touches meet the objects.")
        unit = float(np.sqrt(np.mean([np.mean(one.error**2) for one in used])))

        def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
            factors, total, slope = np.exp(2.0 * logs) * [1.0, 1.0, 1.0, unit**2], 0.0, np.zeros(4)
            for one in used:
                inner = np.tensordot(factors[:3], one.parts, 1) + factors[3] * np.eye(len(one.error))
                factor, inverse = linalg.cholesky(inner, lower=True), np.linalg.inv(inner)
                white = inverse @ one.error
                each = np.append(np.tensordot(one.parts, inverse - np.outer(white, white), 2),
                                 np.trace(inverse) - white @ white)
                count = len(used) * len(one.error)
                total += (0.5 * one.error @ white + np.log(factor.diagonal()).sum()) / count
                slope += factors * each / count
            return total, slope

        found = optimize.minimize(loss, np.log([1.0, 0.7, 1.0, 0.3]), jac=True, method="L-BFGS-B",
                                  bounds=[tuple(np.log(_RANGE))] * 4)
        springs, common, near, noise = (float(x) for x in np.exp(found.x))
        return cls(springs, common, near, noise * unit)

    def prior(self, prior: GaussianPrior, knots: sparse.csr_matrix, unit: float) -> GaussianPrior:
        """That of one object around the means of ``prior``, which has no shared components, with B (n, s) and u
        [N/m]."""
        members = sparse.csr_matrix(sparse.hstack([np.ones((len(prior.mean), 1)), knots]))
        std = unit * np.append(self.common, np.full(knots.shape[1], self.near))
        return GaussianPrior(prior.mean, self.springs**2 * prior.var, members, np.zeros(len(std)), std**2)


_RANGE = (1e-3, 1e2)
"""Bounds of the factors: of the first two in units of the root mean square error [-]."""


@dataclass(frozen=True)
class Missed:
    """Readings of one object that its prior and its support did not know."""

    error: np.ndarray
    """Measured minus predicted (m,) [unit of the reading]."""
    predicted: np.ndarray
    """(m,) [unit]."""
    spring_std: np.ndarray
    """Standard deviations that the springs' posterior gives them (m,) [unit]; 0 where no particle is moved."""


@dataclass(frozen=True)
class Width:
    """The four factors."""

    free: float
    """Standard deviation of a reading whose frame moves no particle [unit]."""
    contact: float
    """What is added where particles are moved [unit]."""
    share: float
    """Of the predicted reading [-]."""
    springs: float
    """Factor of the springs' standard deviation [-]."""

    @classmethod
    def of(cls, objects: Sequence[Missed]) -> Width:
        """The factors under which the errors of these objects are most likely.

        Raises:
            VsfError: there is no reading, or none is missed.
        """
        used = [one for one in objects if len(one.error)]
        error = np.concatenate([np.zeros(0), *(one.error for one in used)])
        unit = float(np.sqrt(np.mean(error**2))) if len(error) else 0.0
        if not unit > 0.0:
            raise VsfError("vsf.width: no reading of a training object is missed, so that no width can be found; give "
                           "measured readings.")
        parts = np.concatenate([_parts(one.predicted, one.spring_std) * [unit**2, unit**2, 1.0, 1.0] for one in used])
        weight = np.concatenate([np.full(len(one.error), 1.0 / len(one.error)) for one in used]) / len(used)

        def loss(logs: np.ndarray) -> tuple[float, np.ndarray]:
            factors = np.exp(logs)
            var = parts @ factors
            fit = error**2 / var
            return float(weight @ (np.log(var / unit**2) + fit)), ((weight * (1.0 - fit) / var) @ parts) * factors

        bounds = [tuple(2.0 * np.log(_RANGE))] * 4
        # From several starts, because the likelihood of variances need not have one maximum.
        found = [optimize.minimize(loss, 2.0 * np.log(start), jac=True, method="L-BFGS-B", bounds=bounds)
                 for start in ((0.3, 0.3, 0.3, 1.0), (0.1, 0.3, 1.0, 0.1), (0.03, 0.03, 0.1, 3.0))]
        free, contact, share, springs = (float(x) for x in np.exp(0.5 * min(found, key=lambda one: one.fun).x))
        return cls(free * unit, contact * unit, share, springs)

    def std(self, predicted: np.ndarray, spring_std: np.ndarray) -> np.ndarray:
        """Standard deviations of readings [unit].

        Args:
            predicted: readings of any shape [unit]. spring_std: as of `Missed`, of the same shape [unit].
        """
        factors = np.array([self.free, self.contact, self.share, self.springs])
        return np.sqrt(_parts(predicted, spring_std) @ factors**2)


def _parts(predicted: np.ndarray, spring_std: np.ndarray) -> np.ndarray:
    """What the squares of the factors are multiplied by, along a new last axis of 4."""
    moved = spring_std > 0.0
    return np.stack([np.ones(predicted.shape), moved, np.where(moved, predicted**2, 0.0), spring_std**2], axis=-1)
