"""What makes a dataset: how many objects, views and touches it has (``[dataset]``), how touches are made
(``[touches]``) and by which arm (``[arm]``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.shape import MeshFile, ProbeShape, parse_probe_shape
from vsfsim.core.table import Angle, Count, Finite, Rows, Vector, between, check_keys, typed, value

STEEPEST = 0.87
"""Height of a visible unit normal, up to which a surface can be pressed from the side: 60 degrees above the level."""
Range = Annotated[tuple[Finite, Finite], msgspec.Meta(description="2 numbers")]


@dataclass(frozen=True)
class TouchSpec:
    """``[touches]``: how the touches of a dataset are drawn on the visible cloud."""

    count: Annotated[int, between(1, 10_000, whole=True)] = 10
    """Touches of a view."""
    depth: Annotated[float, between(1e-5, 0.5, "m")] = 0.01
    """Travel of the probe past first contact [m]."""
    approach: Annotated[float, between(1e-4, 0.5, "m")] = 0.01
    """Clearance between the probe and the target point at the start [m]."""
    force_limit: Annotated[float, between(1e-3, 1e6, "N")] = 30.0
    """The press stops before the linear response of the rest state passes this force [N]; that of a bubble, before a
    flat rigid wall would."""
    frames: tuple[int, int, int, int] = (2, 6, 1, 3)
    """Readings in each phase: (free, in, hold, out)."""
    tilt: Annotated[float, between(0.0, 1.2, "rad")] = 0.0
    """Half angle of the cone about the visible normal from which the direction of a press is drawn, so that a sensor's
    flanks touch, too [rad]; 0 for the normal itself."""
    depth_range: Range | None = None
    """Bounds that each touch's own depth is drawn from [m]; None: every touch has ``depth``."""
    approach_range: Range | None = None
    """Bounds that each touch's own approach is drawn from [m]; None: every touch has ``approach``."""
    late_range: Range | None = None
    """Bounds from which each touch draws how much deeper the probe is than recorded, as by a robot
    that notices contact late [m]; None: nothing. ``depth`` and ``force_limit`` are as recorded."""
    contact_edge: Annotated[float, between(0.1, 1.0)] | None = None
    """Longest edge of elements where a touch meets the object, over the radius of its contact [-]:
    each touch has its own mesh, see `vsfsim.generate.on_solids`. None: one for all touches."""
    plan: bool = False
    """Keep the planned path of an arm beside the one that it took. A task with cross-validation shows only the plan
    of a touch that is to be predicted, because the path that was taken tells where the force limit was met."""
    stations: Annotated[int, between(1, 10, whole=True)] = 1
    """So many touches of an arm in turn go to one stem or branch, 2 cm or more from each other along it; 1: every touch
    goes to a place of its own."""
    level: bool = False
    """Press from the side: along the level part of minus the visible normal. A target whose normal is steeper than
    `STEEPEST` is drawn again."""
    other: tuple[tuple[ProbeShape | None, TouchSpec], ...] = ()
    """``[[touches.other]]``: presses of other kinds, each with its shape (None for the scene's probe) and how it is
    drawn. Every second touch is one of them, in turn."""

    def __post_init__(self) -> None:
        for key, least in (("depth_range", 1e-5), ("approach_range", 1e-4), ("late_range", 1e-5)):
            low, high = getattr(self, key) or (least, least)
            if not least <= low <= high <= 0.5:
                raise ValueError(f"{key} is [{low:g}, {high:g}]; it must satisfy {least:g} <= low <= high <= 0.5 "
                                 f"(metres)")
        start = (self.approach_range or (self.approach,))[0]
        if self.late_range is not None and self.late_range[1] >= start:
            raise ValueError(f"late_range ends at {self.late_range[1]:g} m, and a touch starts "
                             f"{start:g} m before its recorded contact, so that it would begin in "
                             f"the object; make approach longer")

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

    objects: Annotated[int, between(1, 100_000, whole=True)] = 6
    """Number of objects."""
    views: Annotated[int, between(1, 1000, whole=True)] = 1
    """Views of each."""
    splits: Annotated[Mapping[str, Count], msgspec.Meta(
        description="the number of objects of each, e.g. { train = 4, test = 2 }")] = field(default_factory=dict)
    """Number of objects by split name, in order."""

    def __post_init__(self) -> None:
        if self.splits and sum(self.splits.values()) != self.objects:
            raise ValueError(f"splits add up to {sum(self.splits.values())}, but there are {self.objects} objects; "
                             f"make them equal")


@dataclass(frozen=True)
class ArmSpec:
    """``[arm]``: the arm that touches: where it stands, and how it goes about it."""

    model: Literal["gen3"] = "gen3"
    """The one arm that there is."""
    punyo: bool = False
    """Whether it carries a Punyo."""
    base: Vector = (-0.65, 0.0, 0.0)
    """Of its foot (3,) [m]."""
    yaw: Angle = 0.0
    """Rotation about +z [rad]."""
    mode: Literal["kinematic"] = "kinematic"
    """How its torques come about: J^T f, the one way that there is."""
    clearance: Annotated[float, between(0.0, 0.2, "m")] = 0.01
    """Least gap to the plant at the start of a touch, and to its pot all the way [m]."""
    sweep: Annotated[float, between(0.0, 1.2, "rad")] = 1.0
    """Largest angle between the line of motion and the tool's own axis in half of the touches [rad]; in the others, and
    with 0 in all, the tool moves along its axis."""
    reject_below: Annotated[float, between(0.0, 50.0, "N m")] = 0.0
    """A plant is drawn again if a push at the middle of its visible parts would give joint torques whose norm is below
    this [N m]; 0 for never."""
    jitter: Annotated[float, between(0.0, 1e-3, "m")] = 0.0
    """A frame is marked as not resolved from where its torques change by more than a twentieth of the touch's largest
    if the skeleton is displaced so far (RMS, `vsfsim.generate.plants.skeleton.displaced`); 0: none is asked [m]."""


_FRAMES = {"free": (2, 1), "in": (6, 1), "hold": (1, 0), "out": (3, 0)}
"""Default and least number of readings of each phase."""


def parse_touches(node: Any, path: Path, *, row: str = "[touches]") -> TouchSpec:
    """The table ``[touches]`` of the scene file ``path``; messages call it ``row``.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    where = f"{path} {row}"
    written = check_keys(node, where, [field.name for field in fields(TouchSpec)])
    frames = check_keys(written.get("frames", {}), f"{where} frames", _FRAMES)
    for key in ("depth", "approach"):
        if key in written and f"{key}_range" in written:
            raise SceneError(f"{where}: {key} gives one value for all touches, and {key}_range bounds that each touch "
                             f"draws its own from; give one of them.")
    found = typed(node, TouchSpec, where, also=("frames", "other"), frames=tuple(
        value(frames.get(key, usual), Annotated[int, between(least, 1000, whole=True)], f"{where} frames: {key}")
        for key, (usual, least) in _FRAMES.items()), other=tuple(
        _other(node, one, f"[[touches.other]] {k}", path)
        for k, one in enumerate(value(written.get("other", []), Rows, f"{where}: other"), start=1)))
    return replace(found, **{key: bounds[1] for key in ("depth", "approach")
                             if (bounds := getattr(found, f"{key}_range"))})


def _other(own: Mapping[str, Any], node: Any, name: str, path: Path) -> tuple[ProbeShape | None, TouchSpec]:
    """A press of another kind: what its row does not say is as in [touches]."""
    where = f"{path} {name}"
    row = dict(check_keys(node, where, ("shape", "depth", "depth_range", "tilt", "level")))
    shape = parse_probe_shape(row.pop("shape"), where) if "shape" in row else None
    if isinstance(shape, MeshFile):
        raise SceneError(f"{where}: shape is {node['shape']!r}; a touch of a dataset is made with a simple shape, e.g. "
                         f"shape = {{ cylinder = [0.01, 0.02] }}.")
    dropped = {"other", *(("depth", "depth_range") if {"depth", "depth_range"} & row.keys() else ())}
    return shape, parse_touches({**{key: value for key, value in own.items() if key not in dropped}, **row}, path,
                                row=name)


def parse_dataset(node: Any, path: Path) -> DatasetSpec:
    """The table ``[dataset]`` of the scene file ``path``.

    Raises:
        SceneError: an unknown key, a value that is not allowed, or splits that do not add up.
    """
    found = typed(node, DatasetSpec, f"{path} [dataset]")
    return found if found.splits else replace(found, splits={"test": found.objects})
