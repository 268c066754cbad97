"""How wide: the standard deviations of predicted readings, from objects that a prior was not learned on.

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
from scipy import optimize

from vsfsim.core.errors import VsfError

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
