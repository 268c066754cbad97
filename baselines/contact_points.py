"""`contact-points`: what touches say without a stiffness (the contact-only baseline of Neural VSF section IV-C).

A known object is registered to the points where the force passed a limit. Asked for forces, it answers with those of the nearest touch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.baselines.locating import Locating, locate_contacts
from vsfsim.bench.method import Action, Reading, Specimen
from vsfsim.core.errors import MethodError
from vsfsim.core.shape import Sphere
from vsfsim.data.records import View


class ContactPoints:
    """Learns nothing from training objects.

    Args:
        share: of the support's largest force that makes a contact point [-]; one limit for all touches, as in the paper. seed: of the registration.
    """

    def __init__(self, *, share: float = 0.5, seed: int = 0):
        if not 0.0 < share < 1.0:
            raise MethodError(f"contact-points: share is {share!r}; it must lie between 0 and 1.")
        self.share, self.seed = share, seed

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Nothing to learn."""

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Keep the touches.

        Raises:
            MethodError: a reading marked valid is not finite.
        """
        self._support = list(support)
        for index, reading in enumerate(support):
            if not np.isfinite(reading.value[reading.valid]).all():
                raise MethodError(f"touch {index} of the support has a reading that is not finite in a frame marked valid.")

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of the nearest touch of the support, at the same way past its start; 0 without touches."""
        usable = [r for r in self._support if r.valid.any()]
        if not usable:
            return [np.zeros((len(action.time), action.size)) for action in touches]
        ends = np.stack([r.action.poses[np.argmax(_way(r.action)), :3, 3] for r in usable])
        out = []
        for action in touches:
            way = _way(action)
            near = usable[int(np.argmin(np.linalg.norm(ends - action.poses[np.argmax(way), :3, 3], axis=1)))]
            order = np.argsort(_way(near.action)[near.valid], kind="stable")
            known, value = _way(near.action)[near.valid][order], near.value[near.valid][order]
            out.append(np.stack([np.interp(way, known, value[:, k]) for k in range(action.size)], axis=1))
        return out

    def locate(self, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Object-to-world transform (4, 4) of an object of known shape."""
        return locate_contacts(vertices, triangles, self._contacts(), Locating(seed=self.seed))

    def _contacts(self) -> np.ndarray:
        """Points of the probe's front (k, 3) [m] in frames whose force passed the limit; with a surface, its vertices."""
        largest = max((float(np.abs(r.value[r.valid]).max()) for r in self._support if r.valid.any()), default=0.0)
        points = [np.zeros((0, 3))]
        for reading in self._support:
            if reading.surface is not None:
                size = np.linalg.norm(np.nan_to_num(reading.surface.force), axis=2)
                points.append(reading.surface.vertices[size > self.share * max(size.max(), 1e-12)])
                continue
            hit = np.flatnonzero(reading.valid & (np.abs(np.nan_to_num(reading.value)).max(axis=1) > self.share * largest)) if largest > 0.0 else []
            radius = reading.action.probe.radius if isinstance(reading.action.probe, Sphere) else 0.0
            points.append(reading.action.poses[hit, :3, 3] + radius * reading.action.axis)
        found = np.concatenate(points)
        # One point a millimetre: frames of one touch that stand still count once.
        return found if not len(found) else found[_thinned(found)]


def _way(action: Action) -> np.ndarray:
    """How far the probe has come along the press since frame 0 (T,) [m]."""
    return (action.poses[:, :3, 3] - action.poses[0, :3, 3]) @ action.axis


def _thinned(points: np.ndarray) -> np.ndarray:
    dropped = np.zeros(len(points), bool)
    for a, b in sorted(cKDTree(points).query_pairs(1e-3)):
        if not dropped[a]:
            dropped[b] = True
    return np.flatnonzero(~dropped)
