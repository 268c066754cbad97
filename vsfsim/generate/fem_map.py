"""`fem-map`: the true mesh with moduli that are fitted to the support touches, a ceiling of what touches can tell
(`vsfsim evaluate --method fem-map`).

It knows the object's form, its parts and their elastic laws, but no modulus. With ``field`` "parts" log E of the parts
has the means and, shrunk, the covariance of the parts of the dataset's other objects; with "smooth" log E is a
Gaussian process over the object that knows no parts.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError, one_of
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import Touch
from vsfsim.data.streams import Stream
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.resim import Planned, job_of, retouch
from vsfsim.generate.solid import Subject, prepare
from vsfsim.physics import tiers
from vsfsim.physics.inverse.modulus_fit import Noise, Press, Prior, fit_modulus, smooth_basis

FIELDS = ("parts", "smooth")
"""Where log E may vary: from part to part, or smoothly."""
NOISE = Noise(0.2, 0.03)
"""Of the readings: that of the tared sensor of the tasks (0.15 N in a frame and 0.1 N in all of them), and what the
derivative of a step leaves."""

_OTHERS = 16  # objects that the prior is learned from
_LEAST_STD = 0.3  # of log E of a part whose modulus the others share [-]
_TOGETHER = 0.5  # share of the covariance of different parts that so few objects are believed
_REACH = 0.06  # over which log E is alike where it varies smoothly [m]


def fitted(recipe: Recipe, name: str, plans: Sequence[Planned], *, support: Sequence[Any] = (),
           tier: str = "", device: str = "cpu", field: str = "parts") -> list[Touch]:
    """Build the object of a view from its recipe, fit its moduli to the ``support`` and touch it.

    Args:
        recipe: of the dataset. name: of the object view. plans: of the touches that are asked.
        support: readings of the same object, each as `vsfsim.bench.method.Reading`.
        tier: of the simulation; "" for the dataset's own.
        device: Warp device of the touches that are asked; the fit runs on the CPU.
        field: one of `FIELDS`.

    Raises:
        SceneError: the effector cannot repeat a plan, has not this tier, or rubs against the object; or the tier has no
            tetrahedra or no large strain.
    """
    one_of(field, FIELDS, "field", SceneError)
    job = job_of(recipe, name, tier)
    subject = prepare(job, device=device)
    scene = subject.scene
    if scene.effector != "probe":
        raise SceneError(f"fem-map differentiates touches by rigid probes, and scene '{recipe.scene}' has none.")
    if scene.required_object.friction:
        raise SceneError("fem-map differentiates touches without friction, and scene "
                         f"'{recipe.scene}' has friction = {scene.required_object.friction:g}.")
    if not tiers.TIERS[job.recipe.tier].nonlinear:
        raise SceneError("fem-map needs a tier of large strain; give --set tier=fem-coarse "
                         f"instead of '{job.recipe.tier}'.")
    prior = _prior(job, subject, field)

    model_of = functools.partial(tiers.model_of, scene, job.recipe.tier, subject.model.solid)
    presses = [Press(one.action.poses, one.action.axis, np.where(one.valid, one.value[:, 0], np.nan), one.action.probe,
                     one.action.mount_stiffness) for one in support]
    theta, _ = fit_modulus(model_of, prior, presses, subject.limits(), NOISE)
    return retouch(dataclasses.replace(subject, model=model_of(prior.modulus(theta))), plans, device=device)


def _prior(job: Job, subject: Subject, field: str) -> Prior:
    """Of log E of the object, from the others of its dataset."""
    solid = subject.model.solid
    others = [one for one in jobs_of(job.recipe, job.path, "")
              if one.object_index != job.object_index and one.view_index == 0][:_OTHERS]
    if not others:
        raise SceneError("fem-map learns its prior from the other objects of the dataset, and "
                         f"scene '{job.recipe.scene}' has {job.name} alone.")
    rows = []
    for other in others:
        body, values = tiers.body(other.scene(), job.recipe.tier, seed=other.stream(Stream.BODY))
        log, region = np.log(values).mean(axis=1), np.asarray(body.region)
        own = {part: float(log[region == k].mean()) for k, part in enumerate(body.region_names) if (region == k).any()}
        rows.append([own.get(part, np.nan) for part in solid.region_names])
    table = np.array(rows)
    level = float(np.nanmean(table))
    known = np.isfinite(table).any(axis=0)
    mean = np.where(known, np.nanmean(np.where(known, table, level), axis=0), level)
    if field == "parts":
        away = np.where(np.isfinite(table), table, mean) - mean
        alike = np.eye(len(mean)) + _TOGETHER * (1.0 - np.eye(len(mean)))
        unknown = np.where(known, _LEAST_STD, float(np.nanstd(table)) + _LEAST_STD)
        basis = (np.asarray(solid.region)[:, None] == np.arange(len(mean))).astype(float)
        return Prior(basis, mean, alike * (away.T @ away) / len(away) + np.diag(unknown**2))
    centre = subject.model.mesh.points[subject.model.mesh.tets[:, :4]].mean(axis=1)
    basis = smooth_basis(centre, reach=_REACH, std=max(float(np.nanstd(table)), _LEAST_STD))
    return Prior(np.concatenate([np.ones((len(centre), 1)), basis], axis=1),
                 np.concatenate([[level], np.zeros(basis.shape[1])]),
                 np.diag(np.concatenate([[max(float(np.nanstd(np.nanmean(table, axis=1))),
                                              _LEAST_STD) ** 2], np.ones(basis.shape[1])])))
