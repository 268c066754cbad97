"""Touches of a dataset that are solved again one level finer: a promise of accuracy is held against them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from vsfsim.data.records import Touch
from vsfsim.data.streams import Stream
from vsfsim.generate.aim import Aim
from vsfsim.generate.solid import Retouching, Subject
from vsfsim.generate.trade.near import near, touch_near
from vsfsim.generate.trade.setting import RATIO

ONE_IN = 10
"""One touch in so many is audited, and one of every view at least."""


def audited(effector: Retouching, subject: Subject, aims: list[Aim], *, device: str,
            progress: Callable[[int], None] | None = None) -> list[Touch]:
    """The touches of a view; where the recipe promises an accuracy, some of them with the force on a finer mesh in
    their audit.

    Args:
        effector: what touches.
        subject: the object.
        aims: the touches.
        device: Warp device.
        progress: called with the number of frames newly done.
    """
    touches = touch_near(effector, subject, aims, device=device, progress=progress)
    if "accuracy" not in subject.job.recipe.options:
        return touches
    size = subject.scene.required_object.resolution
    assert size is not None  # the accuracy that was bought has one
    level = subject.job.recipe.options.get("contact", 0) + 1
    rng = np.random.default_rng(subject.job.stream(Stream.AUDIT))
    out = list(touches)
    for k in rng.permutation(len(touches))[:max(1, round(len(touches) / ONE_IN))].tolist():
        finer = near(subject, aims[k], effector.manner(subject.scene).reach,
                     {"resolution": size / RATIO, "contact": level})
        (again,) = effector.touch(finer, [aims[k]], device=device)
        found = again.converged & np.isfinite(again.force).all(axis=1)
        out[k] = dataclasses.replace(out[k], audit={
            **out[k].audit, "finer_force": np.where(found[:, None], again.force, 0.0), "finer_converged": found})
    return out
