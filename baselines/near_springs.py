"""`near-springs`: a spring under each touched place; a touch is predicted from those near it. No paper: the simplest
method that a newcomer would write, and the example of docs/tutorial.md.

A touch i at the place x_i is a spring k_i = sum F d / sum d^2 over its frames (F force, d depth past the visible
surface). The training objects' touches together give the spring k_0. The force of a touch at x and depth d is that of
the weighted mean

    k(x) = (c k_0 + sum_i w_i sum F d) / (c + sum_i w_i sum d^2),   w_i = exp(-|x - x_i|^2 / 2 reach^2).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.baselines.converted import converted
from vsfsim.baselines.surface_touches import SurfaceView, single_number
from vsfsim.baselines.visible_cloud import LearnedArrays
from vsfsim.bench.method import Action, Estimate, Reading, Specimen, check_support
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View


@converted
class NearSprings(LearnedArrays):
    """Springs under the surface.

    Args:
        reach: of a touch [m].
        trust: c, the weight of the training objects [m^2].
    """

    _name = "near-springs"

    def __init__(self, *, reach: float = 0.02, trust: float = 1e-4):
        if not (reach > 0.0 and trust > 0.0):
            raise MethodError(f"near-springs: reach is {reach!r} m and trust {trust!r} m^2; both must be positive.")
        self.reach, self.trust = reach, trust

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Estimate k_0 [N/m].

        Raises:
            MethodError: no training touch passes the visible surface, or a reading has more than one number.
        """
        sums = np.zeros(2)
        for specimen in specimens:
            single_number("near-springs", (r.action for r in specimen.touches))
            view = SurfaceView(specimen.view)
            sums += sum((self._sums(view, reading)[1:] for reading in specimen.touches), np.zeros(2))
        if sums[1] == 0.0:
            raise MethodError(f"near-springs: no touch of the {len(specimens)} training objects passes the visible "
                              f"surface. Give touches that meet the objects.")
        self._learned = {"prior": sums[0] / sums[1]}

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Keep the springs of the support."""
        check_support(support)
        self._prior = float(self._learned["prior"])
        self._view = SurfaceView(view)
        rows = [self._sums(self._view, reading) for reading in support]
        self._place = np.array([row[0] for row in rows]).reshape(-1, 3)
        self._sum = np.array([row[1:] for row in rows]).reshape(-1, 2)

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, 1) of touches not made yet."""
        single_number("near-springs", touches)
        contacts = [self._view.contact(action) for action in touches]
        return [self._springs(c.place[None])[0] * c.depth[:, None] for c in contacts]

    def stiffness(self, points: np.ndarray) -> Estimate:
        """k at ``points`` (k, 3) [m]: (k,) [N/m]. The standard deviation falls with the weight of the touches."""
        mean = np.maximum(self._springs(points), 0.0)
        return Estimate(mean, mean * np.sqrt(self.trust / self._weights(points)[1]))

    def _springs(self, points: np.ndarray) -> np.ndarray:
        above, below = self._weights(points)
        return above / below

    def _weights(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        away = np.linalg.norm(points[:, None] - self._place[None], axis=2)
        weight = np.exp(-0.5 * (away / self.reach) ** 2)
        return self.trust * self._prior + weight @ self._sum[:, 0], self.trust + weight @ self._sum[:, 1]

    def _sums(self, view: SurfaceView, reading: Reading) -> tuple[np.ndarray, float, float]:
        """Place (3,) [m] of a touch, and the sums of F d [N m] and of d^2 [m^2] over its valid frames."""
        contact = view.contact(reading.action)
        depth, force = contact.depth[reading.valid], reading.value[reading.valid, 0]
        return contact.place, float(depth @ force), float(depth @ depth)
