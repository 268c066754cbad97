"""`surface-gp-farthest` and `surface-gp-variance`: the process of `surface-gp`, which chooses the touches that it is
given in a task whose support is chosen. `surface-gp` itself is given touches at random there.

`farthest` takes the touch farthest from those made (farthest-point traversal, Gonzalez, Clustering to minimize the
maximum intercluster distance, 1985); `variance` the one whose readings have the greatest variance under the process
(uncertainty sampling; MacKay, Information-based objective functions for active data selection, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.baselines.surface_gp import SurfaceGp
from vsfsim.bench.method import Action, Reading
from vsfsim.data.records import View


class FarthestTouches(SurfaceGp):
    """Touches far from one another; the first is the first that is offered, which is at random."""

    def choose(self, view: View, so_far: Sequence[Reading], offered: Sequence[Action]) -> int:
        """Index of the offered touch whose end is farthest from the ends of all touches made."""
        if not so_far:
            return 0
        made = np.stack([_end(reading.action) for reading in so_far])
        away = np.linalg.norm(np.stack([_end(action) for action in offered])[:, None] - made, axis=2)
        return int(np.argmax(away.min(axis=1)))


class UncertainTouches(SurfaceGp):
    """Touches whose readings the process knows least."""

    def choose(self, view: View, so_far: Sequence[Reading], offered: Sequence[Action]) -> int:
        """Index of the offered touch with the greatest mean variance of its readings, after `adapt` to ``so_far``."""
        return int(np.argmax([np.mean(np.square(std)) for std in self.predict_std(offered)]))


def _end(action: Action) -> np.ndarray:
    """Where the probe goes farthest along the press (3,) [m]."""
    return action.poses[np.argmax(action.poses[:, :3, 3] @ action.axis), :3, 3]
