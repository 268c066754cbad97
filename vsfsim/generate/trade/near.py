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
from vsfsim.data.streams import Stream
from vsfsim.generate.aim import Aim
from vsfsim.generate.solid import Subject
from vsfsim.generate.trade.setting import LIMIT_TIER, LOCAL, RATIO
from vsfsim.physics import tiers
from vsfsim.physics.mesh.edge_refine import EdgePath

ONE_IN = 10
"""One touch in so many is audited, and one of every view at least."""


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


Toucher = Callable[..., list[Touch]]
"""`OnSolids.touch` of an effector: what is read of some touches of a subject."""


def touch_near(touch: Toucher, reach: float, subject: Subject, aims: list[Aim], *, device: str) -> list[Touch]:
    """The touches of a subject by what has this ``reach`` [m], each on a mesh of its own where the recipe has a level
    for it."""
    if "contact" not in subject.job.recipe.options:
        return touch(subject, aims, device=device)
    return [one for a in aims for one in touch(near(subject, a, reach, {}), [a], device=device)]


def audited(touch: Toucher, reach: float, subject: Subject, aims: list[Aim], *, device: str) -> list[Touch]:
    """The same; where the recipe promises an accuracy, some of the touches have the force on a mesh one level finer in
    their audit."""
    out, options = touch_near(touch, reach, subject, aims, device=device), subject.job.recipe.options
    if "accuracy" not in options:
        return out
    rng = np.random.default_rng(subject.job.stream(Stream.AUDIT))
    finer = {"resolution": options["resolution"] / RATIO, "contact": options.get("contact", 0) + 1}
    for k in rng.permutation(len(out))[:max(1, round(len(out) / ONE_IN))].tolist():
        (again,) = touch(near(subject, aims[k], reach, finer), [aims[k]], device=device)
        found = again.converged & np.isfinite(again.force).all(axis=1)
        out[k] = dataclasses.replace(out[k], audit={
            **out[k].audit, "finer_force": np.where(found[:, None], again.force, 0.0), "finer_converged": found})
    return out


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
