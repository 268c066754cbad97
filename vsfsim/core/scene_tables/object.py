"""``[object]``: what is touched, where it stands, and what it is made of; and ``[camera]``: the view of it at rest."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from vsfsim.core.errors import SceneError, one_of
from vsfsim.core.material import FOAMS, MaterialField, parse_law, parse_material
from vsfsim.core.rigid import beside
from vsfsim.core.shape import Family, ObjectShape, parse_object_shape
from vsfsim.core.table import Angle, Finite, Friction, Vector, between, check_keys, shipped_rows, typed

Tier = Literal["auto", "linear", "fem-coarse", "fem", "fem-fine", "rod"]
"""Fidelities that a scene may name."""
Corners = Annotated[tuple[Finite, Finite, Finite, Finite, Finite, Finite], msgspec.Meta(description="6 numbers")]


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """``[object]``."""

    shape: ObjectShape
    """Of the object."""
    pose: Vector = (0.0, 0.0, 0.0)
    """Base centre in the world (3,) [m]."""
    yaw: Angle = 0.0
    """Rotation about +z [rad]."""
    fixed: Literal["bottom", "none"] | Corners = "bottom"
    """Either "bottom", "none", or a box (x0, y0, z0, x1, y1, z1) [m] in the object's frame whose nodes are held."""
    tier: Tier = "auto"
    """Fidelity, one of `Tier`."""
    resolution: Annotated[float, between(1e-5, 1.0, "m")] | None = None
    """Element size [m], or None for the tier's own."""
    poisson_ratio: Annotated[float, between(0.0, 0.4999)] = 0.45
    """Of the whole object [-]."""
    density: Annotated[float, between(1e-3, 3e4, "kg/m^3")] = 1000.0
    """Of the whole object [kg/m^3]."""
    friction: Friction = 0.0
    """Coulomb coefficient against rigid bodies [-]."""
    young_modulus: MaterialField
    """The field E(x) [Pa]."""
    law: tuple[str, Mapping[str, tuple[float, ...]]] | None
    """Name and rows of numbers of the law that ``law`` gives, see `vsfsim.physics.laws.law`; None for the neo-Hookean
    one."""
    appearance: Mapping[str, Any] = field(default_factory=dict)
    """Table for the family or the renderer."""


def parse_object(node: Any, path: Path) -> ObjectSpec:
    """The table ``[object]`` of the scene file ``path``. A foam that ``material`` names is a law with its numbers,
    Poisson's ratio and, where the scene gives none, Young's modulus.

    Raises:
        SceneError: an unknown key, a value that is not allowed, or two things that say the law.
    """
    where, own = f"{path} [object]", ("shape", "young_modulus", "material", "law")
    table = check_keys(node, where, {"material", *(one.name for one in fields(ObjectSpec))})
    shape = beside(parse_object_shape(table.get("shape"), where), path)  # type: ignore[arg-type]
    family = isinstance(shape, Family)
    given = [key for key in ("material", "law") if key in table]
    if given and (family or len(given) > 1):
        raise SceneError(f"{where}: {given[-1]} = {table[given[-1]]!r} beside "
                         f"{'a family, whose parts have laws' if family else 'material, which has a law'} of its own. "
                         f"Leave one of them out.")
    if "material" in table:
        foam = FOAMS[one_of(table["material"], FOAMS, f"{where}: material", SceneError)]
        if "poisson_ratio" in table:
            raise SceneError(f"{where}: material = {table['material']!r} has a Poisson's ratio of its own, "
                             f"{foam.poisson_ratio:.3g}; leave poisson_ratio = {table['poisson_ratio']!r} out.")
        table = {"young_modulus": foam.young_modulus, **table, "poisson_ratio": foam.poisson_ratio,
                 "law": {"name": "hyperfoam", **msgspec.to_builtins(foam)}}
    material = parse_material(table.get("young_modulus"), where)
    if material.base is None and not family:
        raise SceneError(f"{where}: young_modulus is missing; give pascals, e.g. young_modulus = 1e5, or "
                         f"{{ base = 1e5, inclusions = [..] }}.")
    return typed(table, ObjectSpec, where, also=own, shape=shape, young_modulus=material,
                 law=parse_law(table["law"], where) if "law" in table else None)


@dataclass(frozen=True)
class DepthCamera:
    """A real RGB-D camera: its picture and the errors of its depth."""

    width: int
    """Of the depth picture [px]."""
    height: int
    """Of the depth picture [px]."""
    fov: float
    """Vertical field of view [rad]."""
    curve: tuple[tuple[float, float], ...]
    """Standard deviation of a pixel's depth [m] at some depths [m], ascending; linear between them, and beyond the last
    two."""
    bias: float
    """Largest error common to a picture, drawn evenly between its two signs [m]."""
    quantum: float
    """Step of the stored depth [m]."""
    lost: float
    """Share of the pixels at depth edges without a depth [-]."""


DEPTH_CAMERAS: dict[str, DepthCamera] = shipped_rows(__file__, "../cameras.toml", DepthCamera)
"""Cameras that ``model`` in ``[camera]`` may name."""


Pixels = Annotated[int, between(8, 8192, whole=True)]


@dataclass(frozen=True)
class CameraSpec:
    """``[camera]``: a pinhole camera that looks at the object."""

    width: Pixels = 640
    """Of the picture [px]."""
    height: Pixels = 480
    """Of the picture [px]."""
    fov: Annotated[float, between(0.05, 2.8, "rad")] = 0.8
    """Vertical field of view [rad]."""
    distance: Annotated[float, between(0.01, 100.0, "m")] = 0.6
    """To the look-at point [m]."""
    azimuth: Angle = 0.9
    """Direction from the object to the camera, about +z from +x [rad]."""
    elevation: Annotated[float, between(-1.55, 1.55, "rad")] = 0.7
    """Direction from the object to the camera, above the horizontal plane [rad]."""
    noise: Literal["none", "kinect"] = "none"
    """Of its depth, "none" or "kinect" (`vsfsim.sensing.camera`)."""
    model: Literal["", "azure-kinect", "l515"] = ""
    """Key of `DEPTH_CAMERAS`, whose picture and depth errors it has; "" for an ideal camera."""


def parse_camera(node: Any, path: Path) -> CameraSpec:
    """The table ``[camera]`` of the scene file ``path``.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    found = typed(node, CameraSpec, f"{path} [camera]")
    if not found.model:
        return found
    if "noise" in node:
        raise SceneError(f"{path} [camera]: there is a model, '{found.model}', which has its own errors of depth, and "
                         f"a noise; take one of them out.")
    usual = DEPTH_CAMERAS[found.model]
    return replace(found, **{key: getattr(usual, key) for key in ("width", "height", "fov") if key not in node})
