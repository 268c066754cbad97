"""The result of `vsfsim press`, the same for every effector: the effector fills it, `vsfsim.press` prints, draws and
saves it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


@dataclass(frozen=True)
class PressRequest:
    """The options of `vsfsim press` that an effector needs."""

    seed: int = 0
    """Seed of the scene's distributions and of all random streams (0 or more)."""
    tier: str | None = None
    """Fidelity, or None for the scene's own."""
    device: str = "cpu"
    """Warp device."""
    precision: str = "float64"
    """Precision of the solver, "float32" or "float64"."""
    cache: Path | None = None
    """Folder of meshes that were made before, or None for the user's own cache."""
    keep: bool = False
    """Whether every frame's state is kept, for a picture or a file."""
    progress: Callable[[int, int, str], None] | None = None
    """Called with (done, in all, what)."""


@dataclass(frozen=True)
class Column:
    """One column of the printed table: a quantity in every frame."""

    heading: str
    """Name and unit, as printed, padded to the column's width."""
    values: np.ndarray
    """One value a frame (T,), in the unit of the heading."""
    form: str
    """Format specification of a value, e.g. "10.4f"."""


@dataclass(frozen=True)
class PressResult:
    """One press of T frames."""

    values: Mapping[str, Any]
    """What ``--json`` prints, by key: arrays (T, ...), numbers and texts. ``depth`` (T,) [m], ``force`` (T, 3) [N] and
    ``converged`` (T,) are always there."""
    columns: tuple[Column, ...]
    """The printed table."""
    words: tuple[str, ...]
    """Lines printed below the table: convergence, model, times."""
    notes: tuple[str, ...]
    """What was assumed, repaired or decided."""
    arrays: Mapping[str, tuple[np.ndarray, str]] = field(default_factory=dict)
    """What ``--save`` writes, by key: the array, and its shape and unit in words; empty if no state was kept."""

    @property
    def converged(self) -> np.ndarray:
        """Whether each frame is an equilibrium within the solver's tolerance (T,)."""
        return np.asarray(self.values["converged"])
