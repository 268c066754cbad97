"""One way to simulate the touches of a scene, and the ways that a sweep compares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vsfsim.core.errors import VsfsimError
from vsfsim.physics import tiers

RATIO = 1.3
"""Of the edges of two meshes of a ladder."""
LOCAL = 0.5
"""Longest edge of the elements where a touch meets the object, over the radius of the contact, on level 0; on each
further level smaller by `RATIO`, see `vsfsim.generate.trade.near` [-]."""
REFINED = ((1, 0), (0, 0), (-1, 0), (-2, 1))
"""Settings with small elements where each touch meets the object: those elsewhere as the scene's own times `RATIO` to
such a power, and the level there."""
LIMIT_TIER = "fem"
"""Of the meshes from which the limit of a touch is extrapolated; its law is that of every finer tier."""


AXES = {"mesh": "the scene has no mesh", "tolerance": "the scene has none",
        "frames": "the scene's path has corners", "nodes": "the scene has no [sensor] kind = \"bubble\"",
        "device": "this machine has no other device than the one that is used", "together": "the scene has none"}
"""What a sweep can vary, and why a scene may not have it."""


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
    level: int | None = None
    """Of the elements where each touch meets the object, see `LOCAL`; None for elements of one size."""
    device: str = "cpu"
    """Warp device."""

    @property
    def key(self) -> str:
        """In words; also the name of the point in files."""
        words = [self.tier or "bubble"]
        if self.resolution is not None:
            words.append(f"{1e3 * self.resolution:.3g} mm")
        if self.level is not None:
            words.append(f"{LOCAL / RATIO**self.level:.2g} of the contact")
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
                  "nodes": self.nodes, "contact": self.level}
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
        """The meshes of the limit, coarsest first, all finer than the scene's own where they are touched; a bubble's
        grow with the object's."""
        return [Setting(LIMIT_TIER if self.tier else None, self.resolution and self.resolution / RATIO**k,
                        nodes=self.nodes and round(self.nodes * RATIO ** (2 * k)),
                        level=k + 1 if self.tier else None, device=self.device)
                for k in range(meshes)]

    def axes(self) -> dict[str, list[Setting]]:
        """The points along each of `AXES` that the scene has, and the cheapest of all together."""
        base: dict[str, Any] = {"tier": self.tier, "resolution": self.resolution, "device": self.device}

        def sizes(tier: str | None) -> list[float | None]:
            levels = (-1, -2) if tier == LIMIT_TIER else (1, 0, -1)
            return [None] if self.resolution is None else [self.resolution * RATIO**level for level in levels]

        names: Sequence[str | None] = self.pressable or (None,)
        out = {"mesh": [Setting(tier, size, device=self.device) for tier in names for size in sizes(tier)]}
        if self.resolution is not None and LIMIT_TIER in self.pressable:
            out["mesh"] += [Setting(LIMIT_TIER, self.resolution * RATIO**power, level=level, device=self.device)
                            for power, level in REFINED]
        loose = 10.0 * tiers.TIERS[self.tier].tolerance if self.tier else 5e-3
        out["tolerance"] = [Setting(**base, tolerance=value) for value in (loose, loose / 100.0)]
        counts = [] if self.frames is None else sorted({max(1, self.frames // 2), 2 * self.frames} - {self.frames})
        if counts:
            out["frames"] = [Setting(**base, frames=count) for count in counts]
        if self.nodes is not None:
            out["nodes"] = [Setting(**base, nodes=count) for count in (self.nodes // 2, 2 * self.nodes)]
        coarse = {**base, "resolution": sizes(self.tier)[0]}
        out["together"] = [Setting(**coarse, tolerance=loose)]
        if self.frames is not None and counts[0] < self.frames:
            out["together"].append(Setting(**coarse, tolerance=loose, frames=counts[0]))
        return out

    def sweep(self, axes: Sequence[str] = (), devices: Sequence[str] = ()) -> list[Setting]:
        """The points, cheap ones first.

        Args:
            axes: only these; empty for all.
            devices: other Warp devices, along the axis "device".

        Raises:
            VsfsimError: the scene, or the machine, has no such axis.
        """
        found = self.axes()
        if devices:
            found["device"] = [Setting(self.tier, self.resolution, device=name) for name in devices]
        for name in axes:
            if name not in found:
                raise VsfsimError(f"--axis is '{name}', but {AXES[name]}. There are: {', '.join(found)}.")
        return [setting for name, own in found.items() if not axes or name in axes for setting in own]
