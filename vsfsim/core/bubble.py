"""The ``[sensor]`` table: an air-filled membrane on an elliptical rim, the soft-bubble sensor (Punyo)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError, did_you_mean
from vsfsim.core.rigid import MAX_FRICTION
from vsfsim.core.shelf import effectors
from vsfsim.core.table import Table, flag, integer, number, read, vector

NODES = 1493  # the read-out mesh of 390 nodes with every triangle cut in four
ATMOSPHERE = 101325.0  # [Pa]
CAMERA = (640, 480)  # the real one's picture [px]


@dataclass(frozen=True)
class Bubble:
    """``[sensor] kind = "bubble"``. The defaults are a real Punyo's (docs/physics.md, references/punyo.json).

    The mount frame has its origin in the middle of the rim, x along the long semi-axis, y along the short one, +z
    out of the dome.
    """

    semi_axes: tuple[float, float] = vector((0.05725, 0.040), 2)
    """Of the clamped, planar rim, long and short (2,) [m]."""
    young_modulus: float = number(1.36e6, 1e3, 1e10, "Pa")
    """Of the rubber [Pa]."""
    thickness: float = 0.0005
    """Before stretching [m]. Only the product E h matters, except for bending."""
    pre_stretch: float = number(1.10, 1.0, 3.0)
    """Of the flat membrane when it was clamped, over its own length [-]."""
    gauge_pressure: float = number(7820.0, 1.0, 1e8, "Pa")
    """Of the free dome [Pa]."""
    gas_volume: float = number(150e-6, 1e-12, 10.0, "m^3")
    """Volume of the enclosed air, dome and chamber together, with the dome free [m^3]."""
    chamber: float = number(0.0, 0.0, 1.0, "m")
    """Depth of the chamber behind the plane of the rim, at whose rigid floor membrane and obstacles end [m]."""
    gamma: float = number(1.4, 1.0, 1.67)
    """Exponent of p V^gamma, from 1 (isothermal) to 1.4 (adiabatic) [-]."""
    ambient_pressure: float = number(ATMOSPHERE, 0.0, 1e8, "Pa")
    """Absolute, outside [Pa]."""
    sealed: bool = flag(True)
    """Whether the air is enclosed; if not, a supply keeps the gauge pressure."""
    nodes: int = integer(NODES, 100, 20_000)
    """Number of nodes of the mesh."""
    contact_edge: float | None = number(None, 1e-4, 0.1, "m")
    """Longest edge of the triangles where a rigid body touches, for which the mesh is refined there [m]; None: a
    third of the radius of balls and capsules, and three fifths of the membrane's edges under bodies with edges."""
    friction: float = number(2.0, 0.0, MAX_FRICTION)
    """Coulomb coefficient against what it touches [-]."""
    fine: bool = flag(False)
    """Whether a dataset also keeps the mesh of ``nodes`` nodes that was solved, beside the read-out mesh."""
    camera: tuple[int, int] | None = None
    """Width and height of the pictures of the skin from inside that a dataset keeps (2,) [px]; None for none."""

    @property
    def modulus(self) -> float:
        """E h [N/m]."""
        return self.young_modulus * self.thickness

    @property
    def bending(self) -> float:
        """D = E h^3 / (12 (1 - nu^2)) of incompressible rubber [J]."""
        return self.young_modulus * self.thickness**3 / 9.0


def sensor_kind(node: Any, path: Path) -> str:
    """``kind`` of the table ``[sensor]``, the name of an effector; "bubble" if the table does not say.

    Raises:
        SceneError: there is no effector of that name.
    """
    kind = node.get("kind", "bubble") if isinstance(node, Mapping) else "bubble"
    allowed = [name for name in effectors() if name not in ("probe", "arm")]  # those have tables of their own
    if kind not in allowed:
        raise SceneError(f"{path} [sensor]: kind is {kind!r}. {did_you_mean(str(kind), allowed)}")
    return kind


def parse_sensor(node: Any, path: Path) -> Bubble:
    """The bubble that ``[sensor] kind = "bubble"`` describes.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    where = f"{path} [sensor]"
    if not isinstance(node, Mapping):
        raise SceneError(f"{where} is {node!r}; it must be a table, e.g. kind = \"bubble\".")
    found = read(Bubble, node, where, ("kind", "thickness", "camera"))
    if "kind" not in node:
        raise SceneError(f"{where}: kind is missing; write kind = \"bubble\".")
    long, short = found.semi_axes
    if not 1e-3 <= short <= long <= 1.0 or long > 10.0 * short:
        raise SceneError(f"{where}: semi_axes is {[long, short]}; give [long, short] in metres, from 0.001 to 1, the "
                         f"first not the smaller, and at most ten times the second.")
    thickness = Table(node, where, tuple(node)).number("thickness", found.thickness, 1e-5, 0.1 * short, "m")
    return dataclasses.replace(found, thickness=thickness, camera=_camera(node.get("camera", False), where))


def _camera(value: Any, where: str) -> tuple[int, int] | None:
    if isinstance(value, bool):
        return CAMERA if value else None
    if (not isinstance(value, list) or len(value) != 2
            or any(isinstance(v, bool) or not isinstance(v, int) or not 8 <= v <= 4096 for v in value)):
        raise SceneError(f"{where}: camera is {value!r}; it must be true (pictures of {CAMERA[0]} x {CAMERA[1]} pixels "
                         f"from inside the bubble), false, or [width, height] from 8 to 4096 pixels.")
    return int(value[0]), int(value[1])
