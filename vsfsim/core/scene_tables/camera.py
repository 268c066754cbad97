"""``[camera]``: the view of the object at rest."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.table import Table


@dataclass(frozen=True)
class CameraSpec:
    """``[camera]``: a pinhole camera that looks at the object."""

    width: int
    """Of the picture [px]."""
    height: int
    """Of the picture [px]."""
    fov: float
    """Vertical field of view [rad]."""
    distance: float
    """To the look-at point [m]."""
    azimuth: float
    """Direction from the object to the camera, about +z from +x [rad]."""
    elevation: float
    """Direction from the object to the camera, above the horizontal plane [rad]."""
    noise: str = "none"
    """Of its depth, "none" or "kinect" (`vsfsim.sensing.kinect`)."""


def parse_camera(node: Any, path: Path) -> CameraSpec:
    """The table ``[camera]`` of the scene file ``path``.

    Raises:
        SceneError: an unknown key, or a value that is not allowed.
    """
    t = Table(node, f"{path} [camera]", ("width", "height", "fov", "distance", "azimuth", "elevation", "noise"))
    return CameraSpec(t.count("width", 640, 8, 8192), t.count("height", 480, 8, 8192),
                      t.number("fov", 0.8, 0.05, 2.8, "rad"), t.number("distance", 0.6, 0.01, 100.0, "m"),
                      t.number("azimuth", 0.9, -2 * math.pi, 2 * math.pi, "rad"),
                      t.number("elevation", 0.7, -1.55, 1.55, "rad"),
                      t.word("noise", "none", ("none", "kinect")))
