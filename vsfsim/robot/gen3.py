"""Numbers of the Kinova Gen3 (7 joints) and of the Punyo on its flange, whose bodies are `gen3.xml`."""

from __future__ import annotations

import math
from pathlib import Path

MODEL = Path(__file__).with_name("gen3.xml")
"""MuJoCo's description of both, with the sources of its numbers."""
JOINTS = 7
MARGIN = math.radians(3.0)
"""How near to a joint's limit a path may lead [rad]: the torques of a touch and its friction turn a joint less far from
its desired angle, and a joint at its stop does not read them."""
HOME = (0.0, 0.2618, 3.1416, -2.2689, 0.0, 0.9599, 1.5708)
"""Joint angles of the maker's home posture [rad]."""
