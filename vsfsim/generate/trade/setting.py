"""One way to simulate the touches of a scene, and the ways that a promise goes through."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

RATIO = 1.3
"""Of the edges of two meshes of a ladder."""
LOCAL = 0.5
"""Longest edge of the elements where a touch meets the object, over the radius of the contact, on level 0; on each
further level smaller by `RATIO`, see `vsfsim.generate.on_solids` [-]."""
STEPS = ((2, None), (1, None), (0, None), (0, 1), (-1, 2))
"""Settings that a touch of a promise goes through until it is exact enough: elements as the scene's own times `RATIO`
to such a power, and the level where it meets the object."""
LIMIT_TIER = "fem"
"""Of the meshes from which the limit of a touch is extrapolated; its law is that of every finer tier."""
MESHES = 3
"""Of the limit."""
ROUGH = 0.02
"""Accuracy from which the coarser limit will do, whose larger error counts against every touch [-]."""


@dataclass(frozen=True)
class Setting:
    """One way to simulate; None leaves what the scene, or its tier, says."""

    tier: str
    """Fidelity."""
    resolution: float
    """Edge of the elements [m]."""
    tolerance: float | None = None
    """Of the equilibrium, see `SolverOptions` [-]."""
    frames: int | None = None
    """Readings on the way in."""
    nodes: int | None = None
    """Of a bubble."""
    level: float | None = None
    """Of the elements where each touch meets the object, see `LOCAL`; None for elements of one size."""

    @property
    def key(self) -> str:
        """In words; also the name of the point in files."""
        words = [self.tier, f"{1e3 * self.resolution:.3g} mm"]
        if self.level is not None:
            words.append(f"{LOCAL / RATIO**self.level:.2g} of the contact")
        if self.tolerance is not None:
            words.append(f"tolerance {self.tolerance:.1e}")
        if self.frames is not None:
            words.append(f"{self.frames} frame{'s' * (self.frames > 1)}")
        if self.nodes is not None:
            words.append(f"{self.nodes} nodes")
        return ", ".join(words)

    def table(self) -> dict[str, Any]:
        """For JSON, and for the options of a recipe; what is None is left out."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    def steps(self) -> list[Setting]:
        """Of a scene whose own elements and nodes these are, see `STEPS`."""
        return [self._at(power, level) for power, level in STEPS]

    def ladder(self, asked: float = 0.0) -> list[Setting]:
        """Meshes of a limit of such a scene, coarsest first; the last two, or the first two, are the last of `STEPS`.
        For an accuracy ``asked`` [-] of `ROUGH` and more they begin one coarser, and cost a third."""
        powers = range(1, 1 - MESHES, -1) if asked >= ROUGH else range(0, -MESHES, -1)
        return [self._at(power, 1 - power) for power in powers]

    def _at(self, power: int, level: int | None) -> Setting:
        """Elements times `RATIO` to a power, and a bubble's edges with them."""
        return Setting(self.tier if level is None else LIMIT_TIER, self.resolution * RATIO**power, level=level,
                       nodes=None if self.nodes is None else round(self.nodes * RATIO ** (-2 * power)))
