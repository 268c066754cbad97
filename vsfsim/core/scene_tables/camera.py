"""``[camera]``: the view of the object at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from vsfsim.core.errors import SceneError
from vsfsim.core.table import Angle, between, typed


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

DEPTH_CAMERAS: dict[str, DepthCamera] = {
    # Toelgyessy et al. 2021 (Sensors 21:413): 0.6 mm at 1 m, 1 to 1.4 mm at 2 m on a white wall; systematic error under
    # 11 mm. Narrow field of view, unbinned. Its driver removes pixels at depth edges; their share is an estimate.
    "azure-kinect": DepthCamera(
        640, 576, math.radians(65.0), ((0.0, 0.0005), (1.0, 0.0006), (2.0, 0.0012)), 0.010, 0.001, 0.5),
    # Intel's data sheet as quoted in librealsense #5808, #7040 and #15308: mean error under 5 mm and 2.5 mm of standard
    # deviation at 1 m, 15.5 mm at 9 m; in practice 0.5 to 1 mm at 0.5 to 0.8 m. The share of lost pixels is an
    # estimate.
    "l515": DepthCamera(
        640, 480, math.radians(55.0), ((0.0, 0.0003), (0.5, 0.0006), (1.0, 0.0025), (9.0, 0.0155)), 0.005, 0.00025,
        0.35),
}
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
