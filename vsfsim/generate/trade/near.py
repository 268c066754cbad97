"""A model of an object that is fine where one touch will be: a setting of its own, the meshes of a limit, and audits.

The elements are small over the whole disc that the touch will meet, not at its middle alone, because its rim is where
the pressure falls with an infinite slope.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vsfsim.data.records import Touch
from vsfsim.generate.aim import Aim
from vsfsim.generate.solid import Retouching, Subject
from vsfsim.generate.trade.setting import LIMIT_TIER, LOCAL, RATIO
from vsfsim.physics import tiers
from vsfsim.physics.mesh.edge_refine import EdgePath


def contact_edge(a: Aim, reach: float, level: int) -> tuple[float, float]:
    """Radius of the disc that a touch will meet, and longest edge of the elements in it [m].

    Args:
        a: the touch.
        reach: radius of what touches; a ball of radius r that is pressed d deep touches over sqrt(r d) (Hertz) [m].
        level: see `LOCAL`.
    """
    radius = float(np.sqrt(reach * a.depth))
    return radius, LOCAL * radius / RATIO**level


def near(subject: Subject, a: Aim, reach: float, options: Mapping[str, Any]) -> Subject:
    """The object at the tier of the limit, with small elements where a touch meets it.

    Args:
        subject: the object.
        a: the touch.
        reach: radius of what touches [m].
        options: of the recipe, see `Job.scene`; the resolution is that of the elements elsewhere, ``contact`` the level
            of those where it touches, see `LOCAL`.

    Raises:
        SceneError, MeshError: it cannot be built.
    """
    scene, options = subject.scene, {**subject.job.recipe.options, **options}
    radius, size = contact_edge(a, reach, options["contact"])
    own = tiers.element_size(dataclasses.replace(scene.required_object, resolution=None), LIMIT_TIER, scene.probe)
    # what `tiers.body` makes of the half-width of an edge
    share = tiers.TIERS[LIMIT_TIER].probe * min(1.0, options.get("resolution", own) / own)
    at = a.target + size * _disc(radius / size) @ _across(a.axis)
    ends = np.stack([at - 2.0 * radius * a.axis, at + 2.0 * radius * a.axis])
    return subject.again(LIMIT_TIER, options, edges=EdgePath(ends, np.full(len(at), size / share)))


def touch_near(effector: Retouching, subject: Subject, aims: list[Aim], *, device: str,
               progress: Callable[[int], None] | None = None) -> list[Touch]:
    """The touches of a subject, each on a mesh of its own where the recipe has a level for it."""
    if "contact" not in subject.job.recipe.options:
        return effector.touch(subject, aims, device=device, progress=progress)
    reach = effector.manner(subject.scene).reach
    return [touch for a in aims
            for touch in effector.touch(near(subject, a, reach, {}), [a], device=device, progress=progress)]


def _disc(radius: float) -> np.ndarray:
    """Points of a triangular lattice of spacing 1 in a disc (k, 2)."""
    n = int(np.ceil(2.0 * radius))
    i, j = (v.ravel() for v in np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1)))
    points = np.stack([i + 0.5 * j, np.sqrt(0.75) * j], axis=1)
    return points[np.linalg.norm(points, axis=1) <= radius + 1e-9]


def _across(axis: np.ndarray) -> np.ndarray:
    """Two unit directions across an axis (2, 3)."""
    one = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(axis, one)])
