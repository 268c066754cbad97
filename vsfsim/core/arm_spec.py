"""``[arm]``: the arm that touches: where it stands, and how it goes about it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vsfsim.core.table import flag, number, vector, word


@dataclass(frozen=True)
class ArmSpec:
    """``[arm]``: the arm that touches: where it stands, and how it goes about it."""

    model: str = word("gen3")
    """The one arm that there is."""
    punyo: bool = flag(False)
    """Whether it carries a Punyo."""
    base: tuple[float, float, float] = vector((-0.65, 0.0, 0.0))
    """Of its foot (3,) [m]."""
    yaw: float = number(0.0, -2 * math.pi, 2 * math.pi, "rad")
    """Rotation about +z [rad]."""
    mode: str = word("kinematic")
    """Its torques are J^T f."""
    clearance: float = number(0.01, 0.0, 0.2, "m")
    """Least gap to the plant at the start of a touch, and to its pot all the way [m]."""
    at_limit: str = word("end", "return")
    """What a touch does before its force limit: "end" with the readings made so far, or "return", a guarded move
    that slows down, goes back and keeps its number of readings."""
    sweep: float = number(1.0, 0.0, 1.2, "rad")
    """Largest angle between the line of motion and the tool's own axis in half of the touches [rad]; in the others, and
    with 0 in all, the tool moves along its axis."""
    reject_below: float = number(0.0, 0.0, 50.0, "N m")
    """A plant is drawn again if a push at the middle of its visible parts would give joint torques whose norm is below
    this [N m]; 0 for never."""
