"""A model of an object that is fine where one touch will be: the meshes of a limit, and of an audit."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from vsfsim.generate.aim import Aim
from vsfsim.generate.solid import Subject
from vsfsim.generate.trade.setting import LIMIT_TIER, RATIO
from vsfsim.physics import tiers
from vsfsim.physics.mesh.edge_refine import EdgePath

LOCAL = 0.5
"""Edge of the elements where the first of these meshes is touched, over the radius of the contact [-]; on each finer
one smaller by `RATIO`."""


def near(subject: Subject, a: Aim, reach: float, options: Mapping[str, Any], level: int) -> Subject:
    """The object at the tier of the limit, with small elements where a touch meets it.

    Args:
        subject: the object.
        a: the touch.
        reach: radius of what touches [m].
        options: of the recipe, see `Job.scene`; the resolution is that of the elements elsewhere.
        level: 0 for the first mesh of a ladder.

    Raises:
        SceneError, MeshError: it cannot be built.
    """
    scene = subject.scene
    size = LOCAL * float(np.sqrt(reach * a.depth)) / RATIO**level  # a ball of that radius touches over sqrt(r d)
    own = tiers.element_size(dataclasses.replace(scene.required_object, resolution=None), LIMIT_TIER, scene.probe)
    # what `tiers.body` makes of the half-width of an edge
    share = tiers.TIERS[LIMIT_TIER].probe * min(1.0, options.get("resolution", own) / own)
    ends = np.stack([a.target - 2.0 * a.depth * a.axis, a.target + 2.0 * a.depth * a.axis])
    return subject.again(LIMIT_TIER, options, edges=EdgePath(ends[:, None], np.array([size / share])))
