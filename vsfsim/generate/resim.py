"""The true object asked again: touches of planned paths by the very model that made a dataset, which is what a
perfect model of object and solver would answer (`vsfsim evaluate --method resim`).

It asks effectors whose touches of a solid can be made again (`OnSolids`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.shape import ProbeShape
from vsfsim.core.shelf import find_scene, scenes
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import Touch
from vsfsim.generate.aim import Aim
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.recipe import check_files
from vsfsim.generate.solid import Subject, prepare


class Planned(Protocol):
    """A touch before it is made, as a method is asked for it."""

    poses: np.ndarray
    """Planned poses of the mount (T, 4, 4) [m]."""
    axis: np.ndarray
    """Unit direction of the press (3,) [-]."""
    probe: ProbeShape
    """What presses, one of the scene's shapes."""


def again(recipe: Recipe, name: str, plans: Sequence[Planned], *, tier: str = "", device: str = "cpu") -> list[Touch]:
    """Build the object of a view from its recipe and touch it.

    Args:
        recipe: of the dataset. name: of the object view. plans: of the touches. tier: of the simulation; "" for the
        dataset's own. device: Warp device.

    Returns:
        One touch a plan, in their order.

    Raises:
        SceneError: the effector cannot repeat a plan, or has not this tier.
        DatasetError: a file that the scene names has changed.
    """
    return retouch(prepare(job_of(recipe, name, tier), device=device), plans, device=device)


def job_of(recipe: Recipe, name: str, tier: str = "") -> Job:
    """The view ``name`` to make again; arguments and errors as `again`."""
    job = named_job(recipe, name)
    effector = effector_of(job.scene())
    if not isinstance(effector, OnSolids):
        raise SceneError(f"the touches of scene '{recipe.scene}' are not made again from their "
                         "plans: its effector takes no paths. Rigid probes and bubbles do.")
    if job.scene().required_touches.contact_edge is not None:
        raise SceneError(f"the touches of scene '{recipe.scene}' are not made again from plans, "
                         "which do not say the mesh of each (contact_edge in [touches]).")
    if not tier:
        return job
    # what a tier that does not show the scene's needs errs is what is asked
    chosen = effector.check(dataclasses.replace(job.scene(), needs=()), tier)
    return dataclasses.replace(job, recipe=dataclasses.replace(recipe, tier=chosen))


def named_job(recipe: Recipe, name: str) -> Job:
    """The job of the object view ``name`` of a dataset.

    Raises:
        DatasetError: a file that the scene names has changed.
    """
    path = find_scene(recipe.scene) if recipe.scene in scenes() else Path(f"{recipe.scene}.toml")
    check_files(recipe, path)
    return next(one for one in jobs_of(recipe, path, "") if one.name == name)


def retouch(subject: Subject, plans: Sequence[Planned], *, device: str) -> list[Touch]:
    """One touch a plan, in their order, of an object whose `job_of` can be made again."""
    effector, unknown = effector_of(subject.scene), np.full(3, np.nan)
    assert isinstance(effector, OnSolids)
    kinds = {press.probe: number for number, press in reversed([*enumerate(subject.scene.presses)])}
    out: dict[int, Touch] = {}
    for frames in dict.fromkeys(len(plan.poses) for plan in plans):
        mine = [k for k, plan in enumerate(plans) if len(plan.poses) == frames]
        aims = [Aim(unknown, unknown, plans[k].axis, plans[k].poses[0, :3, 3], np.nan,
                    press=kinds.get(plans[k].probe, 0), path=plans[k].poses) for k in mine]
        out |= zip(mine, effector.touch(subject, aims, device=device))
    return [out[k] for k in range(len(plans))]
