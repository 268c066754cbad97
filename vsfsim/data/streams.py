"""The random streams of a dataset: each object, view and touch has its own, so that none depends on how many others
there are."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Stream(IntEnum):
    """First key of a dataset's random streams, whose keys are (kind, object, view, touch)."""

    SCENE = 0
    """The scene's distributions, of an object."""
    BODY = 1
    """What a family of objects draws, of an object."""
    AIM = 2
    """The target of a touch."""
    DEPTH = 3
    """The depth camera's noise, of a view."""
    AUDIT = 4
    """Which touches are audited, of a view."""


def stream(seed: int, *key: int) -> np.random.SeedSequence:
    """The random stream ``key`` = (kind, object, view, touch) of a dataset; `Stream` lists the kinds."""
    return np.random.SeedSequence(seed, spawn_key=tuple(int(k) for k in key))
