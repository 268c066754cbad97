"""What the methods on a surface share: contacts of touches with the visible cloud, and their forces as coefficients of
two functions of the depth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from vsfsim.baselines.visible_cloud import visible_cloud
from vsfsim.bench.method import Action, Reading
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View
from vsfsim.vsf.surface_contact import SurfaceContact, surface_contact

DEPTH = 0.01
"""Depth at which both functions are 1 [m]: that of an ordinary touch."""


class SurfaceView:
    """A view, and the contacts of touches with its visible cloud, each computed once."""

    def __init__(self, view: View):
        self.view, self.cloud = view, visible_cloud(view)
        low, high = self.cloud.min(axis=0), self.cloud.max(axis=0)
        self.foot, self.size = np.array([*(0.5 * (low + high))[:2], low[2]]), float(np.max(high - low))
        self._known: dict[bytes, SurfaceContact] = {}

    def contact(self, action: Action) -> SurfaceContact:
        """Where the probe of a touch meets the cloud."""
        key = repr(action.probe).encode() + action.poses.tobytes()
        if key not in self._known:
            self._known[key] = surface_contact(self.cloud, action.poses, action.probe)
        return self._known[key]


@dataclass(frozen=True)
class Projected:
    """The readings of a touch, projected on the functions of the depth (`functions`): y = R w + noise, all that a
    Gaussian likelihood needs of them."""

    contact: SurfaceContact
    """Where, and how deep."""
    factor: np.ndarray
    """R (2, 2): the triangular factor of the functions at the valid frames [-]."""
    value: np.ndarray
    """y (2,) [N]."""
    rest: float
    """Sum of squares of what the functions cannot explain [N^2]."""
    frames: int
    """Valid frames."""


def functions(depth: np.ndarray) -> np.ndarray:
    """d and d^2, each over its value at `DEPTH` (T, 2) [-]: an elastic surface hardens as the contact grows."""
    return np.stack([depth / DEPTH, (depth / DEPTH) ** 2], axis=1)


def projected(view: SurfaceView, reading: Reading) -> Projected:
    """The valid frames of a reading of one number."""
    contact = view.contact(reading.action)
    force = reading.value[reading.valid, 0]
    rows = np.concatenate([functions(contact.depth[reading.valid]), np.zeros((2, 2))])  # two rows at least
    q, factor = np.linalg.qr(rows)
    value = q[:len(force)].T @ force
    return Projected(contact, factor, value, max(float(force @ force - value @ value), 0.0), len(force))


def single_number(method: str, actions: Iterable[Action]) -> None:
    """Refuse readings of several numbers.

    Raises:
        MethodError: a reading has more than one number.
    """
    for action in actions:
        if action.size != 1:
            raise MethodError(f"{method}: a reading of '{action.observation}' has {action.size} numbers; this method "
                              f"predicts one number a frame, as of 'normal-force'.")
