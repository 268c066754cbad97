"""The RGB-D camera inside the bubble: depth and colour of the skin as seen from below the rim.

These values of the real sensor are known (docs/sensing.md): 640 x 480 pixels, a focal length of about 430 px, a tilt
of 25 degrees, and the rim plane at about 54 mm. The public mesh is given in the camera's frame and places the camera
40 mm off the dome's axis along the long semi-axis, so that the tilt turns it to the middle.

The renderer is that of every other camera. The skin bears a noise at its material points, which moves and stretches
with it. Lamp, housing and print of the real sensor are not modelled, since no scene and no method needs them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from vsfsim.core.solid import Appearance
from vsfsim.sensing.camera import render
from vsfsim.sensing.surface import Surface

_LOOK = Appearance(np.array([[0.05, 0.45, 0.18]]), ("noise",), np.array([0.003]), np.array([0.9]))
"""Of the skin: green, with patches of 3 mm on its stress-free shape."""


@dataclass(frozen=True)
class BubbleCamera:
    """A pinhole camera in the chamber that looks at the skin from below."""

    width: int = 640
    """Of the picture [px]."""
    height: int = 480
    """Of the picture [px]."""
    focal: float = 430.0
    """Focal length [px]."""
    tilt: float = math.radians(25.0)
    """Angle between the optical axis and the dome's axis, towards +x [rad]."""
    distance: float = 0.054
    """From the camera to the rim plane, along the dome's axis [m]."""
    offset: float = 0.040
    """Of the camera along -x, the long semi-axis [m]."""

    @property
    def intrinsics(self) -> np.ndarray:
        """Pinhole matrix (3, 3) [px]; the centre of the top-left pixel is (0, 0)."""
        return np.array([[self.focal, 0.0, 0.5 * (self.width - 1)], [0.0, self.focal, 0.5 * (self.height - 1)],
                         [0.0, 0.0, 1.0]])

    @property
    def pose(self) -> np.ndarray:
        """Camera-to-mount transform, OpenCV axes (4, 4) [m]; the picture's right is +x of the mount, leaning down."""
        s, c = math.sin(self.tilt), math.cos(self.tilt)
        out = np.eye(4)
        out[:3, 0], out[:3, 1], out[:3, 2] = (c, 0.0, -s), (0.0, 1.0, 0.0), (s, 0.0, c)
        out[:3, 3] = (-self.offset, 0.0, -self.distance)
        return out


def look_inside(points: np.ndarray, triangles: np.ndarray, material: np.ndarray, camera: BubbleCamera, *,
                device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    """Depth along the optical axis, 0 where no skin is visible (T, H, W) float32 [m], and colour, sRGB (T, H, W, 3)
    uint8, of the skin in T frames.

    Args:
        points: node positions, mount frame (T, n, 3) [m].
        triangles: wound outwards (m, 3).
        material: coordinates of the nodes on the stress-free skin (n, 2) [m]; the noise is fixed there.
        camera: its pose and intrinsics.
        device: Warp device.
    """
    printed = np.pad(material, ((0, 0), (0, 1)))
    seen = [render(Surface(x, triangles, np.zeros(len(triangles), np.int64), _LOOK, printed), camera.intrinsics,
                   camera.pose, camera.width, camera.height, device=device) for x in points]
    return np.stack([view.depth for view in seen]), np.stack([view.rgb for view in seen])
