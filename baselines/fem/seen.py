"""`fem-map-seen`: a solid from the view alone, whose moduli the simulator's own solver fits to the touches.

The solid is what the camera shows (`seen_solid`), filled; a hollow object becomes a softer full one. log E of its
elements is a level, a slope with the height and a smooth field (`smooth_basis`). Each is Gaussian; the training
objects, fitted one by one, tell means and deviations. A touch is predicted by pressing the fitted solid. Every fit
is Gauss and Newton's method with derivatives through the equilibria (`vsfsim.physics.inverse`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.baselines.fem.seen_solid import seen_solid
from vsfsim.baselines.surface_touches import single_number
from vsfsim.baselines.visible_cloud import LearnedArrays
from vsfsim.bench.method import Action, Estimate, Reading, Specimen, check_support
from vsfsim.core.errors import MethodError
from vsfsim.core.solid import Solid
from vsfsim.data.records import View
from vsfsim.physics import tiers
from vsfsim.physics.inverse.modulus_fit import Noise, Press, Prior, fit_modulus, press, smooth_basis
from vsfsim.physics.linear.rest_factor import forget_all
from vsfsim.physics.model import Model, build_model

_POISSON_RATIO = 0.3
_LEVEL, _LEVEL_STD, _SLOPE_STD, _FIELD_STD = np.log(1e5), 1.5, 1.0, 0.7  # before anything is learned
_LEAST = 0.2  # deviation of level and slope that the training objects leave at least [-]
_FOOT = 5e-4  # height of the nodes that the ground holds [m]
_TIER = "fem-coarse"


@dataclass(frozen=True)
class _Object:
    """A solid with what its moduli may be."""

    solid: Solid
    basis: np.ndarray
    """Level, slope and smooth field (m, 2 + c), the field with deviation 1."""

    def model(self, modulus: np.ndarray) -> Model:
        return build_model(self.solid, modulus, poisson_ratio=_POISSON_RATIO, fixed="bottom", bottom_tolerance=_FOOT,
                           where="fem-map-seen")


class FemMapSeen(LearnedArrays):
    """The simulator on a solid from the view.

    Args:
        size: of the solid's tetrahedra [m].
        reach: over which log E is alike [m].
        share: what the model is off by, over a reading [-].
        floor: noise of the readings [N].
        steps: of a fit, at most.
        objects, presses: that are learned from, at most.
    """

    _name = "fem-map-seen"

    def __init__(self, *, size: float = 0.014, reach: float = 0.04, share: float = 0.15, floor: float = 0.2,
                 steps: int = 4, objects: int = 6, presses: int = 8):
        for name, value in {"size": size, "reach": reach, "share": share, "floor": floor}.items():
            if not value > 0.0:
                raise MethodError(f"fem-map-seen: {name} is {value!r}; it must be positive.")
        self.size, self.reach, self.steps, self.objects, self.presses = size, reach, steps, objects, presses
        self._noise = Noise(floor, share)

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Fit training objects one by one for the means and deviations of the moduli.

        Raises:
            MethodError: there is no training object with touches, or a reading has more than one number.
        """
        self._learned = {"mean": np.array([_LEVEL, 0.0]), "field": np.array(_FIELD_STD),
                         "covariance": np.diag([_LEVEL_STD, _SLOPE_STD]) ** 2}
        found, spread, fields = [], [], []
        for specimen in [s for s in specimens if s.touches][:self.objects]:
            self._adapt(specimen.view, specimen.touches[:self.presses])
            found.append(self._theta[:2])
            spread.append(self._covariance[:2, :2])
            fields.append(self._theta[2:] ** 2 + np.diag(self._covariance)[2:])
        if not found:
            raise MethodError(f"fem-map-seen: none of the {len(specimens)} training objects has a touch.")
        mean, away = np.mean(found, axis=0), np.array(found) - np.mean(found, axis=0)
        covariance = away.T @ away / len(found) + np.mean(spread, axis=0) + _LEAST**2 * np.eye(2)
        scale = _FIELD_STD * float(np.sqrt(np.mean(np.concatenate(fields))))
        self._learned = {"mean": mean, "covariance": covariance, "field": np.array(scale)}

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Fit the moduli of the solid in the view to the support."""
        check_support(support)
        self._adapt(view, support)

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, 1) of touches not made yet."""
        single_number("fem-map-seen", touches)
        if not touches:
            return []
        forget_all()
        model = self._object.model(self._prior.modulus(self._theta))
        presses = [_press(action, np.full(len(action.poses), np.nan)) for action in touches]
        forces, _, _ = press(model, presses, tiers.options(_TIER))
        return [_filled(force)[:, None] for force in forces]

    def stiffness(self, points: np.ndarray) -> Estimate:
        """Young's modulus of the element nearest to each of the ``points`` (k, 3) [m]: (k,) [Pa]."""
        solid = self._object.solid
        _, near = cKDTree(solid.vertices[solid.tets].mean(axis=1)).query(points)
        rows = self._prior.basis[near]
        mean = np.exp(rows @ self._theta)
        return Estimate(mean, mean * np.sqrt(np.einsum("ka,ab,kb->k", rows, self._covariance, rows).clip(min=0.0)))

    def _adapt(self, view: View, support: Sequence[Reading]) -> None:
        single_number("fem-map-seen", (one.action for one in support))
        forget_all()
        solid = seen_solid(view, self.size)
        places = solid.vertices[solid.tets].mean(axis=1)
        height = (places[:, 2] - places[:, 2].min()) / max(float(np.ptp(places[:, 2])), 1e-9) - 0.5
        level = np.stack([np.ones(len(places)), height], axis=1)
        self._object = _Object(solid, np.concatenate([level, smooth_basis(places, reach=self.reach, std=1.0)], axis=1))
        size = self._object.basis.shape[1]
        covariance, scale = np.eye(size), np.ones(size)
        covariance[:2, :2], scale[2:] = self._learned["covariance"], float(self._learned["field"])
        self._prior = Prior(self._object.basis * scale, np.concatenate([self._learned["mean"], np.zeros(size - 2)]),
                            covariance)
        presses = [_press(one.action, np.where(one.valid, one.value[:, 0], np.nan)) for one in support]
        self._theta, self._covariance = fit_modulus(self._object.model, self._prior, presses, tiers.options(_TIER),
                                                    self._noise, steps=self.steps)


def _press(action: Action, force: np.ndarray) -> Press:
    return Press(action.poses, action.axis, force, action.probe, action.mount_stiffness)


def _filled(force: np.ndarray) -> np.ndarray:
    """Forces (T,) [N], those of frames without an equilibrium between their neighbours', 0 where there are none."""
    good, frames = np.isfinite(force), np.arange(len(force))
    return np.interp(frames, frames[good], force[good]) if good.any() else np.zeros(len(force))
