"""`contact-points`: pose from contacts alone, without a stiffness (the contact-only baseline of Neural VSF section
IV-C).

A known object's outline is fitted to the points where the force exceeded a limit. Forces are predicted as those of the
nearest touch.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.baselines.known_object import STEP, PoseSearch, locate
from vsfsim.baselines.visible_cloud import visible_cloud
from vsfsim.bench.method import Action, Reading, Specimen, check_support
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.core.errors import MethodError
from vsfsim.core.shape import Sphere
from vsfsim.data.records import View

_NEIGHBOURS = 8  # visible points beside a vertex, of which the first that is met counts


class ContactPoints:
    """Learns nothing from training objects.

    Args:
        share: fraction of the support's largest force above which a point counts as a contact [-]; one limit for all
            touches, as in the paper.
        seed: of the search.
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
        self._view, self._support = view, list(support)
        check_support(support)

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of the nearest touch of the support at the same distance past its start; 0 without any."""
        usable = [r for r in self._support if r.valid.any()]
        if not usable:
            return [np.zeros((len(action.time), action.size)) for action in touches]
        ends = np.stack([r.action.poses[np.argmax(_progress(r.action)), :3, 3] for r in usable])
        out = []
        for action in touches:
            along = _progress(action)
            near = usable[int(np.argmin(np.linalg.norm(ends - action.poses[np.argmax(along), :3, 3], axis=1)))]
            order = np.argsort(_progress(near.action)[near.valid], kind="stable")
            known, value = _progress(near.action)[near.valid][order], near.value[near.valid][order]
            out.append(np.stack([np.interp(along, known, value[:, k]) for k in range(action.size)], axis=1))
        return out

    def locate(self, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Object-to-world transform (4, 4) of an object of known shape, its outline fitted to the contact points.

        Raises:
            MethodError: the readings are not forces, or the view shows no object.
        """
        forces = [name for name, row in OBSERVATIONS.items() if row.unit == "N"]
        other = next((r.action.observation for r in self._support
                        if r.surface is None and r.action.observation not in forces), None)
        if other is not None:
            raise MethodError(f"contact-points: a contact is where the force passes a limit, and the readings are "
                              f"'{other}'; it knows {', '.join(forces)}, or a sensor's surface.")
        points, size = self._contacts()
        hard = size > self.share * size.max(initial=0.0)
        # Only contact or no contact is used, as in the paper.
        return locate(vertices, triangles, points, hard.astype(float), self._view, PoseSearch(seed=self.seed))

    def _contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the probe's front ended (k, 3) [m] and the largest force there (k,); with a surface, those of its
        vertices that met the object or came near it, and theirs: of the rest of a dome nothing is known."""
        points, size = [np.zeros((0, 3))], [np.zeros(0)]
        cloud = visible_cloud(self._view)
        for reading in (r for r in self._support if r.valid.any()):
            if reading.surface is not None:
                force = np.linalg.norm(np.nan_to_num(reading.surface.force), axis=2)
                last = int(np.argmax(force.sum(axis=1)))
                vertices = reading.surface.vertices[last]
                near = _came_near(vertices, cloud, reading.action.axis)
                points.append(vertices[near])
                size.append(force[last][near])
                continue
            value = np.where(reading.valid, np.abs(np.nan_to_num(reading.value)).max(axis=1), 0.0)
            last = int(np.argmax(value))
            radius = reading.action.probe.radius if isinstance(reading.action.probe, Sphere) else 0.0
            points.append(reading.action.poses[last:last + 1, :3, 3] + radius * reading.action.axis)
            size.append(value[last:last + 1])
        return np.concatenate(points), np.concatenate(size)


def _came_near(vertices: np.ndarray, cloud: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Which vertices (n, 3) [m] of a sensor are past the surface that was seen (m, 3) [m], or less than `STEP` before
    it, along the press ``axis`` (3,): (n,) bool."""
    across = np.linalg.svd(axis[None])[2][1:]
    away, index = cKDTree(cloud @ across.T).query(vertices @ across.T, k=min(_NEIGHBOURS, len(cloud)))
    away, index = away.reshape(len(vertices), -1), index.reshape(len(vertices), -1)
    met = np.where(away < 2.0 * STEP, (cloud @ axis)[index], np.inf).min(axis=1)
    return np.isfinite(vertices).all(axis=1) & (vertices @ axis > met - STEP)


def _progress(action: Action) -> np.ndarray:
    """Distance of the probe along the press since frame 0 (T,) [m]."""
    return (action.poses[:, :3, 3] - action.poses[0, :3, 3]) @ action.axis

