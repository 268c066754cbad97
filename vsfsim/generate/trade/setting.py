"""One way to simulate the touches of a scene, and the ways that a sweep compares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vsfsim.physics import tiers

RATIO = 1.3
"""Of the edges of two meshes of a ladder."""
LIMIT_TIER = "fem"
"""Of the meshes from which the limit of a touch is extrapolated; its law is that of every finer tier."""


@dataclass(frozen=True)
class Setting:
    """One way to simulate; None leaves what the scene, or its tier, says."""

    tier: str | None
    """Fidelity; None for a scene without an object."""
    resolution: float | None = None
    """Edge of the elements [m]."""
    tolerance: float | None = None
    """Of the equilibrium, see `SolverOptions` [-]."""
    frames: int | None = None
    """Readings on the way in."""
    nodes: int | None = None
    """Of a bubble."""
    device: str = "cpu"
    """Warp device."""

    @property
    def key(self) -> str:
        """In words; also the name of the point in files."""
        words = [self.tier or "bubble"]
        if self.resolution is not None:
            words.append(f"{1e3 * self.resolution:.3g} mm")
        if self.tolerance is not None:
            words.append(f"tolerance {self.tolerance:.1e}")
        if self.frames is not None:
            words.append(f"{self.frames} frame{'s' * (self.frames > 1)}")
        if self.nodes is not None:
            words.append(f"{self.nodes} nodes")
        return ", ".join([*words, *([] if self.device == "cpu" else [self.device])])

    def options(self) -> dict[str, Any]:
        """What a recipe says of it besides the tier, see `vsfsim.generate.job.Job.scene`."""
        values = {"resolution": self.resolution, "tolerance": self.tolerance, "frames": self.frames,
                  "nodes": self.nodes}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class Ground:
    """What a scene says of itself, where the sweep begins."""

    tier: str | None
    """Its tier, at least ``fem-coarse``; None without an object."""
    resolution: float | None
    """Edge of its elements [m]; None without an object."""
    frames: int | None
    """Readings on the way in; None for a path with corners."""
    nodes: int | None
    """Of its bubble, or None."""
    pressable: tuple[str, ...]
    """Tiers that its effector can touch."""
    device: str = "cpu"
    """Warp device."""

    def ladder(self, meshes: int = 3) -> list[Setting]:
        """The meshes of the limit, coarsest first; a bubble's grow with the object's."""
        return [Setting(LIMIT_TIER if self.tier else None, self.resolution and self.resolution * RATIO ** (1 - k),
                        nodes=self.nodes and round(self.nodes * RATIO ** (2 * k)), device=self.device)
                for k in range(meshes)]

    def sweep(self) -> list[Setting]:
        """The points, cheap ones first: tiers by element size, then tolerance, frames and nodes alone, then together.
        """
        def sizes(tier: str | None) -> list[float | None]:
            levels = (-1, -2) if tier == LIMIT_TIER else (1, 0, -1)
            return [None] if self.resolution is None else [self.resolution * RATIO**level for level in levels]

        names: Sequence[str | None] = self.pressable or (None,)
        out = [Setting(tier, size, device=self.device) for tier in names for size in sizes(tier)]
        base: dict[str, Any] = {"tier": self.tier, "resolution": self.resolution, "device": self.device}
        loose = 10.0 * tiers.TIERS[self.tier].tolerance if self.tier else 5e-3
        counts = [] if self.frames is None else sorted({max(1, self.frames // 2), 2 * self.frames} - {self.frames})
        out += [Setting(**base, tolerance=value) for value in (loose, loose / 100.0)]
        out += [Setting(**base, frames=count) for count in counts]
        if self.nodes is not None:
            out += [Setting(**base, nodes=count) for count in (self.nodes // 2, 2 * self.nodes)]
        coarse = {**base, "resolution": sizes(self.tier)[0]}
        out.append(Setting(**coarse, tolerance=loose))
        if self.frames is not None and counts[0] < self.frames:
            out.append(Setting(**coarse, tolerance=loose, frames=counts[0]))
        return out


def finer(resolution: float) -> float:
    """The edge one level finer [m]."""
    return resolution / RATIO


