"""The ``[sensor]`` table: an air-filled membrane on an elliptical rim, the soft-bubble sensor (Punyo)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec

from vsfsim.core.errors import SceneError, one_of
from vsfsim.core.shelf import effectors
from vsfsim.core.table import Finite, Friction, between, typed

NODES = 1493  # the read-out mesh of 390 nodes with every triangle cut in four
ATMOSPHERE = 101325.0  # [Pa]
CAMERA = (640, 480)  # the real one's picture [px]
Pixels = Annotated[int, between(8, 4096, whole=True)]


@dataclass(frozen=True)
class Bubble:
    """``[sensor] kind = "bubble"``. The defaults are a real Punyo's (docs/physics.md, references/punyo.json).

    The mount frame has its origin in the middle of the rim, x along the long semi-axis, y along the short one, +z
    out of the dome.
    """

    semi_axes: Annotated[tuple[Finite, Finite], msgspec.Meta(description="2 numbers")] = (0.05725, 0.040)
    """Of the clamped, planar rim, long and short (2,) [m]."""
    young_modulus: Annotated[float, between(1e3, 1e10, "Pa")] = 1.36e6
    """Of the rubber [Pa]."""
    thickness: Annotated[float, between(1e-5, 1.0, "m")] = 0.0005
    """Before stretching [m]. Only the product E h matters, except for bending."""
    pre_stretch: Annotated[float, between(1.0, 3.0)] = 1.10
    """Of the flat membrane when it was clamped, over its own length [-]."""
    gauge_pressure: Annotated[float, between(1.0, 1e8, "Pa")] = 7820.0
    """Of the free dome [Pa]."""
    gas_volume: Annotated[float, between(1e-12, 10.0, "m^3")] = 150e-6
    """Volume of the enclosed air, dome and chamber together, with the dome free [m^3]."""
    chamber: Annotated[float, between(0.0, 1.0, "m")] = 0.0
    """Depth of the chamber behind the plane of the rim, at whose rigid floor membrane and obstacles end [m]."""
    gamma: Annotated[float, between(1.0, 1.67)] = 1.4
    """Exponent of p V^gamma, from 1 (isothermal) to 1.4 (adiabatic) [-]."""
    ambient_pressure: Annotated[float, between(0.0, 1e8, "Pa")] = ATMOSPHERE
    """Absolute, outside [Pa]."""
    nodes: Annotated[int, between(100, 20_000, whole=True)] = NODES
    """Number of nodes of the mesh."""
    contact_edge: Annotated[float, between(1e-4, 0.1, "m")] | None = None
    """Longest edge of the triangles where a rigid body touches, for which the mesh is refined there [m]; None: a
    third of the radius of balls and capsules, and three fifths of the membrane's edges under bodies with edges."""
    friction: Friction = 2.0
    """Coulomb coefficient against what it touches [-]."""
    fine: bool = False
    """Whether a dataset also keeps the mesh of ``nodes`` nodes that was solved, beside the read-out mesh."""
    camera: Annotated[tuple[Pixels, Pixels], msgspec.Meta(description=(
        f"true (pictures of {CAMERA[0]} x {CAMERA[1]} pixels from inside the bubble), false, or [width, height] from "
        f"8 to 4096 pixels"))] | None = None
    """Width and height of the pictures of the skin from inside that a dataset keeps (2,) [px]; None for none."""

    def __post_init__(self) -> None:
        long, short = self.semi_axes
        if not 1e-3 <= short <= long <= 1.0 or long > 10.0 * short:
            raise ValueError(f"semi_axes is {[long, short]}; give [long, short] in metres, from 0.001 to 1, the first "
                             f"not the smaller, and at most ten times the second")
        if self.thickness > 0.1 * short:
            raise ValueError(f"thickness is {self.thickness}; it must be at most {0.1 * short:g} m, a tenth of the "
                             f"short semi-axis")

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
    # probe and arm have tables of their own
    return one_of(kind, [name for name in effectors() if name not in ("probe", "arm")], f"{path} [sensor]: kind",
                  SceneError)


def parse_sensor(node: Any, path: Path) -> Bubble:
    """The bubble that ``[sensor] kind = "bubble"`` describes.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    where = f"{path} [sensor]"
    if isinstance(node, Mapping) and isinstance(node.get("camera"), bool):
        node = {**node, "camera": CAMERA if node["camera"] else None}
    found = typed(node, Bubble, where, also=("kind",))
    if "kind" not in node:
        raise SceneError(f"{where}: kind is missing; write kind = \"bubble\".")
    return found
