"""What is made of the touches of a scene under one setting, and what it costs."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from vsfsim.core.system.process_memory import held_memory, peak_memory
from vsfsim.generate.trade.curve import Curve
from vsfsim.generate.trade.setting import LIMIT_TIER, Ground, Setting
from vsfsim.physics import tiers
from vsfsim.physics.convergence import Limit, curve_limit

WHOLE = 0.75
"""Share of the frames of a touch that must have an equilibrium on all meshes of its limit [-]."""


@dataclass(frozen=True)
class Run:
    """The touches under one setting."""

    curves: tuple[Curve, ...]
    """One a touch."""
    once: float
    """CPU time of what is made once an object: meshes and factors [s]."""
    cpu: float
    """CPU time of all touches, without that [s]."""
    wall: float
    """The same on the clock [s]."""
    memory: float
    """Largest memory that the process held meanwhile [MiB]."""
    frames: int
    """Frames that were solved, the way back too."""
    edge: tuple[float, ...] = field(default=())
    """Of the elements that matter to each touch [m]."""

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return {**dataclasses.asdict(self), "curves": [c.table() for c in self.curves], "edge": list(self.edge)}

    @classmethod
    def read(cls, table: dict[str, Any]) -> Run:
        """As `table` gave it."""
        return cls(**{**table, "curves": tuple(Curve.read(c) for c in table["curves"]), "edge": tuple(table["edge"])})


class Touched(Protocol):
    """Touches of a scene that can be made again."""

    ground: Ground
    count: int
    """Touches."""
    what: str
    """The touches in words."""

    def run(self, setting: Setting) -> Run:
        """All touches.

        Raises:
            VsfsimError: the setting cannot be built.
        """
        ...

    def near(self, number: int, setting: Setting) -> Run:
        """Touch ``number`` alone, on a mesh of its own that is finer where it is touched."""
        ...


class Meter:
    """CPU time, time on the clock and the largest memory since its start."""

    def __init__(self) -> None:
        held_memory(reset=True)
        self.restart()

    def restart(self) -> None:
        """The times count from here."""
        self._cpu, self._wall = time.process_time(), time.perf_counter()

    def read(self) -> tuple[float, float, float]:
        """CPU time [s], time on the clock [s], largest memory [MiB]."""
        return time.process_time() - self._cpu, time.perf_counter() - self._wall, peak_memory()


def together(parts: Sequence[Run]) -> Run:
    """The runs of several objects as one."""
    return Run(tuple(c for p in parts for c in p.curves), sum(p.once for p in parts), sum(p.cpu for p in parts),
               sum(p.wall for p in parts), max(p.memory for p in parts), sum(p.frames for p in parts),
               tuple(h for p in parts for h in p.edge))


def limits(ladder: Sequence[Run]) -> tuple[dict[str, Limit], np.ndarray]:
    """The limit of every reading of a touch, and its depths over the deepest (T,) [-].

    Frames that have no equilibrium on one of the meshes are left out if there are few; else no limit is known.

    Args:
        ladder: the touch alone on each mesh, coarsest first, with frames at the same depths.
    """
    curves = [run.curves[0] for run in ladder]
    found = {name: np.stack([c.readings[name] for c in curves]) for name in curves[0].readings}
    on = np.all([c.converged for c in curves], axis=0)
    few = on.mean() >= WHOLE and on[-1]
    nothing = not np.any(found["force"])
    for name, values in found.items():
        if name != "stiffness":
            found[name] = values[:, on] if few else np.where(on.reshape(-1, *[1] * (values.ndim - 2)), values, np.nan)
    if nothing:
        found["force"] = np.full(found["force"].shape, np.nan)
    edge, tolerance = [run.edge[0] for run in ladder], tiers.TIERS[LIMIT_TIER].tolerance
    out = {name: curve_limit(edge, values, tolerance=tolerance) for name, values in found.items()}
    if nothing:
        out["force"] = dataclasses.replace(out["force"], why="it met nothing")
    return (out, curves[-1].share[on] if few else curves[-1].share)
