"""A Punyo's free dome over its base, as the sensor's published mesh has it."""

from types import SimpleNamespace

import numpy as np

from vsfsim.physics.bubble.sensor import HEIGHT, POWER
from vsfsim.physics.mesh.membrane import READ_OUT, closed, ellipse
from vsfsim.robot import gen3


def punyo(mount):
    """Vertices [m] and triangles, those of the dome first, in the frame of the arm's link that carries it; the area
    inside the rim [m^2]; and its ``mount``."""
    a, b = 0.05725, 0.040
    flat, faces, rim = ellipse(a, b, READ_OUT[0], rim=READ_OUT[1])
    height = HEIGHT * np.clip(1.0 - (flat[:, 0] / a) ** 2 - (flat[:, 1] / b) ** 2, 0.0, None) ** POWER
    height[rim] = 0.0
    z = np.array(gen3.PUNYO_AXIS) / np.linalg.norm(gen3.PUNYO_AXIS)
    x = np.array(gen3.PUNYO_LONG_AXIS) - z * (z @ np.array(gen3.PUNYO_LONG_AXIS))
    x /= np.linalg.norm(x)
    vertices = gen3.PUNYO_RIM_CENTRE + np.column_stack([flat, height]) @ np.stack([x, np.cross(z, x), z])
    p = vertices[faces][:, :, :2]
    e, f = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = 0.5 * (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]).sum()
    return SimpleNamespace(vertices=vertices, triangles=closed(faces, rim), area=float(area), mount=mount)
