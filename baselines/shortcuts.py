"""What answers without looking at everything: the probes of `vsfsim lab audit`. None is a row of a leaderboard.

A task asks for the stiffness of an object from what is seen and felt. It has a shortcut if a method does well that

- knows nothing of the object ("constant": the mean curve of the training touches over the share of the path),
- sees only the action ("action": ridge regression of the curve on place, direction, length and spring of the press),
- sees only the picture ("view": the same on size, place and colour of the object), or
- feels only ("touch": the mean curve times one factor an object, which its support touches tell).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.baselines.visible_cloud import LearnedArrays, visible_cloud
from vsfsim.bench.method import Action, Reading, Specimen, check_support
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View

KINDS = ("constant", "action", "view", "touch")
_PLACES = 24  # of the path at which a curve is learned


class Shortcut(LearnedArrays):
    """A ridge regression of the curve of a touch.

    Args:
        sees: one of `KINDS`.
        ridge: weight of the squared coefficients, over the number of training touches [-].
    """

    _name = "shortcut"

    def __init__(self, *, sees: str = "constant", ridge: float = 0.1):
        if sees not in KINDS or not ridge > 0.0:
            raise MethodError(f"shortcut: sees is {sees!r} and ridge {ridge!r}; sees is one of {', '.join(KINDS)}, and "
                              f"ridge is positive.")
        self.sees, self.ridge = sees, ridge

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Regress the curves of all training touches.

        Raises:
            MethodError: there is no training touch.
        """
        known = [(self._features(s.view, r.action), _curve(r)) for s in specimens for r in s.touches if r.valid.any()]
        if not known:
            raise MethodError(f"shortcut: {len(specimens)} training objects have no touch with a valid frame.")
        x, y = np.stack([a for a, _ in known]), np.stack([b for _, b in known])
        middle, scale = x.mean(axis=0), np.maximum(x.std(axis=0), 1e-9)
        mean = y.mean(axis=0)
        z = (x - middle) / scale
        slope = np.linalg.solve(z.T @ z + self.ridge * len(z) * np.eye(z.shape[1]),
                                z.T @ (y - mean).reshape(len(y), -1))
        self._learned = {"middle": middle, "scale": scale, "mean": mean, "slope": slope.reshape(-1, *mean.shape)}

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Keep the view; "touch" fits its factor, as if one touch had said that it is 1."""
        check_support(support)
        self._view, self._factor, mean = view, 1.0, self._learned["mean"]
        if self.sees == "touch":
            size = float((mean**2).sum())
            above = size + sum(float((_curve(r) * mean).sum()) for r in support if r.valid.any())
            below = size * (1 + sum(bool(r.valid.any()) for r in support))
            self._factor = above / below if below > 0.0 else 1.0

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of touches not made yet."""
        out = []
        for action in touches:
            z = (self._features(self._view, action) - self._learned["middle"]) / self._learned["scale"]
            curve = self._factor * (self._learned["mean"] + np.tensordot(z, self._learned["slope"], axes=1))
            if curve.shape[1] != action.size:
                raise MethodError(f"shortcut learned readings of {curve.shape[1]} numbers; '{action.observation}' has "
                                  f"{action.size}.")
            at, places = _share(len(action.time)), _share(_PLACES)
            out.append(np.stack([np.interp(at, places, column) for column in curve.T], axis=1))
        return out

    def _features(self, view: View, action: Action) -> np.ndarray:
        if self.sees == "action":
            first, last = action.poses[0, :3, 3], action.poses[-1, :3, 3]
            return np.array([*last, *action.axis, np.linalg.norm(last - first), action.mount_stiffness or 0.0])
        if self.sees == "view":
            cloud = visible_cloud(view)
            low, high = cloud.min(axis=0), cloud.max(axis=0)
            return np.array([*(high - low), *cloud.mean(axis=0), *view.rgb[view.mask].mean(axis=0), view.mask.mean()])
        return np.zeros(0)


def _share(count: int) -> np.ndarray:
    return np.linspace(0.0, 1.0, count)


def _curve(reading: Reading) -> np.ndarray:
    """The valid frames of a reading at `_PLACES` of its path (p, d)."""
    at = _share(len(reading.valid))[reading.valid]
    return np.stack([np.interp(_share(_PLACES), at, column) for column in reading.value[reading.valid].T], axis=1)
