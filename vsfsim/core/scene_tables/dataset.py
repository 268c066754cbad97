"""``[touches]`` and ``[dataset]``: how many objects, views and touches a dataset has, and how touches are made."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.chain import Chain
from vsfsim.core.dome import Dome
from vsfsim.core.errors import SceneError
from vsfsim.core.shape import MeshFile, ProbeShape, parse_probe_shape
from vsfsim.core.table import Table, flag, integer, number, read

STEEPEST = 0.87
"""Height of a visible unit normal, up to which a surface can be pressed from the side: 60 degrees above the level."""


@dataclass(frozen=True)
class TouchSpec:
    """``[touches]``: how the touches of a dataset are drawn on the visible cloud."""

    count: int = integer(10, 1, 10_000)
    """Touches of a view."""
    depth: float = number(0.01, 1e-5, 0.5, "m")
    """Travel of the probe past first contact [m]."""
    approach: float = number(0.01, 1e-4, 0.5, "m")
    """Clearance between the probe and the target point at the start [m]."""
    force_limit: float = number(30.0, 1e-3, 1e6, "N")
    """The press stops before the linear response of the rest state passes this force [N]; that of a bubble, before a
    flat rigid wall would."""
    frames: tuple[int, int, int, int] = (2, 6, 1, 3)
    """Readings in each phase: (free, in, hold, out)."""
    tilt: float = number(0.0, 0.0, 1.2, "rad")
    """Half angle of the cone about the visible normal from which the direction of a press is drawn, so that a sensor's
    flanks touch, too [rad]; 0 for the normal itself."""
    depth_range: tuple[float, float] | None = None
    """Bounds that each touch's own depth is drawn from [m]; None: every touch has ``depth``."""
    approach_range: tuple[float, float] | None = None
    """Bounds that each touch's own approach is drawn from [m]; None: every touch has ``approach``."""
    plan: bool = flag(False)
    """Keep the planned path of an arm beside the one that it took. A task with cross-validation shows only the plan
    of a touch that is to be predicted, because the path that was taken tells where the force limit was met."""
    level: bool = flag(False)
    """Press from the side: along the level part of minus the visible normal. A target whose normal is steeper than
    `STEEPEST` is drawn again."""
    other: tuple[tuple[ProbeShape | None, TouchSpec], ...] = ()
    """``[[touches.other]]``: presses of other kinds, each with its shape (None for the scene's probe) and how it is
    drawn. Every second touch is one of them, in turn."""

    def kind(self, touch: int) -> int:
        """What touch number ``touch`` is: 0 for the scene's own press, k for the k-th of ``other``."""
        return 1 + touch // 2 % len(self.other) if self.other and touch % 2 else 0

    def draw_depth(self, rng: np.random.Generator) -> float:
        """Depth of one touch [m]; nothing is drawn where all touches have the same."""
        return self.depth if self.depth_range is None else float(rng.uniform(*self.depth_range))

    def draw_approach(self, rng: np.random.Generator) -> float:
        """Approach of one touch [m]; nothing is drawn where all touches have the same."""
        return self.approach if self.approach_range is None else float(rng.uniform(*self.approach_range))


@dataclass(frozen=True)
class DatasetSpec:
    """``[dataset]``."""

    objects: int
    """Number of objects."""
    views: int
    """Views of each."""
    splits: Mapping[str, int]
    """Number of objects by split name, in order."""


def parse_touches(node: Any, path: Path) -> TouchSpec:
    """The table ``[touches]`` of the scene file ``path``.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    where, more = f"{path} [touches]", ("frames", "depth_range", "approach_range", "other")
    found = read(TouchSpec, node, where, more)
    t, f = Table(node, where, tuple(node)), Table(node.get("frames", {}), f"{where} frames",
                                                  ("free", "in", "hold", "out"))
    depth, approach = _range(t, "depth", 1e-5), _range(t, "approach", 1e-4)
    return dataclasses.replace(
        found, depth=depth[1] if depth else found.depth, approach=approach[1] if approach else found.approach,
        depth_range=depth, approach_range=approach,
        frames=(f.count("free", 2, 1, 1000), f.count("in", 6, 1, 1000), f.count("hold", 1, 0, 1000),
                f.count("out", 3, 0, 1000)),
        other=tuple(_other(node, row, f"{path} [[touches.other]] {k}", path)
                    for k, row in enumerate(t.rows("other"), start=1)))


def _other(own: Mapping[str, Any], node: Any, where: str, path: Path) -> tuple[ProbeShape | None, TouchSpec]:
    """A press of another kind: what its row does not say is as in [touches]."""
    row = dict(Table(node, where, ("shape", "depth", "depth_range", "tilt", "level")).table)
    shape = parse_probe_shape(row.pop("shape"), where) if "shape" in row else None
    if isinstance(shape, (Chain, Dome, MeshFile)):
        raise SceneError(f"{where}: shape is {node['shape']!r}; a touch of a dataset is made with a simple shape, e.g. "
                         f"shape = {{ cylinder = [0.01, 0.02] }}.")
    dropped = {"other", *(("depth", "depth_range") if {"depth", "depth_range"} & row.keys() else ())}
    return shape, parse_touches({**{key: value for key, value in own.items() if key not in dropped}, **row}, path)


def _range(t: Table, key: str, least: float) -> tuple[float, float] | None:
    """The bounds ``key``_range [m], from ``least`` to 0.5; None where there are none.

    Raises:
        SceneError: the bounds are not in order, out of range, or given beside the one value for all touches.
    """
    name = f"{key}_range"
    if name not in t.table:
        return None
    if key in t.table:
        raise SceneError(f"{t.where}: {key} gives one value for all touches, and {name} bounds that each touch draws "
                         f"its own from; give one of them.")
    low, high = t.vector(name, None, 2)
    if not least <= low <= high <= 0.5:
        raise SceneError(f"{t.where}: {name} is [{low:g}, {high:g}]; it must satisfy {least:g} <= low <= high <= 0.5 "
                         f"(metres).")
    return low, high


def parse_dataset(node: Any, path: Path) -> DatasetSpec:
    """The table ``[dataset]`` of the scene file ``path``.

    Raises:
        SceneError: an unknown key, a value that is not allowed, or splits that do not add up.
    """
    where = f"{path} [dataset]"
    t = Table(node, where, ("objects", "views", "splits"))
    objects = t.count("objects", 6, 1, 100_000)
    splits = t.table.get("splits", {"test": objects})
    if not isinstance(splits, Mapping) or any(isinstance(n, bool) or not isinstance(n, int) or n < 0
                                              for n in splits.values()):
        raise SceneError(f"{where}: splits is {splits!r}; give the number of objects of each, e.g. "
                         f"{{ train = 4, test = 2 }}.")
    if sum(splits.values()) != objects:
        raise SceneError(f"{where}: splits add up to {sum(splits.values())}, but there are {objects} objects; make "
                         f"them equal.")
    return DatasetSpec(objects, t.count("views", 1, 1, 1000), dict(splits))
