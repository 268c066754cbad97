"""``[arm]``: which arm touches, where it stands, and how its torques come about."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.table import Table

ARM_MODES = ("kinematic", "dynamic")
ARM_DRIVES = ("position", "impedance")
AT_LIMIT = ("end", "return")


@dataclass(frozen=True)
class ArmSpec:
    """``[arm]``: which arm touches, where it stands, and how its torques arise."""

    punyo: bool
    """Whether it carries a Punyo."""
    base: tuple[float, float, float]
    """Of its foot (3,) [m]."""
    yaw: float
    """Rotation about +z [rad]."""
    mode: str
    """"kinematic" (J^T f) or "dynamic" (simulated controller and sensors)."""
    drive: str
    """Of the dynamic mode: position control or impedance."""
    clearance: float
    """Least gap to the plant at the start of a touch, and to its pot all the way [m]."""
    at_limit: str = "end"
    """What a touch does before its force limit: "end" with the readings made so far, or "return", a guarded move
    that slows down, goes back and keeps its number of readings."""
    sweep: float = 1.0
    """Largest angle between the line of motion and the tool's own axis in half of the touches [rad]; in the others, and
    with 0 in all, the tool moves along its axis."""
    reject_below: float = 0.0
    """A plant is drawn again if a push at the middle of its visible parts would give joint torques whose norm is below
    this [N m]; 0 for never."""


def parse_arm(node: Any, path: Path) -> ArmSpec:
    """The table ``[arm]``.

    Raises:
        SceneError: an unknown key, or a value out of its range.
    """
    t = Table(node, f"{path} [arm]", ("model", "punyo", "base", "yaw", "mode", "drive", "clearance", "at_limit",
                                   "sweep", "reject_below"))
    t.word("model", "gen3", ("gen3",))  # the one arm that there is
    return ArmSpec(t.flag("punyo", False), t.vector("base", (-0.65, 0.0, 0.0)),
                   t.number("yaw", 0.0, -2 * math.pi, 2 * math.pi, "rad"), t.word("mode", "kinematic", ARM_MODES),
                   t.word("drive", "position", ARM_DRIVES),
                   t.number("clearance", 0.01, 0.0, 0.2, "m"), t.word("at_limit", "end", AT_LIMIT),
                   t.number("sweep", 1.0, 0.0, 1.2, "rad"), t.number("reject_below", 0.0, 0.0, 50.0, "N m"))
