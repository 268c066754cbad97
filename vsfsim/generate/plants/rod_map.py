"""`rod-map`: a plant's true skeleton and sections with moduli that are fitted to the support touches, a ceiling of what
touches of plants can tell (`vsfsim evaluate --method rod-map`).

It knows every axis, its thickness and its wires, but one number less for each class of segments (trunk, branch,
petiole, leaf, joint in the pot): log E, whose mean in the dataset's other plants is the prior. The fit is a damped
Gauss-Newton method with forward differences over steps of `_STEP`, because which branch slips off the arm changes with
the last bits, so that readings have no derivative in the small.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError, one_of
from vsfsim.core.plant import Plant
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import Touch
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.aim import ArmAim, load
from vsfsim.generate.plants.skeleton import displaced
from vsfsim.generate.plants.subject import Subject, admitted, beams, outline
from vsfsim.generate.plants.touches import finish_touches, solve
from vsfsim.generate.resim import named_job

MODULI = ("fitted", "own", "true")
"""What is known of the moduli: the classes' means in other plants, fitted to touches; those in this plant; all."""
_ROUNDS = 4  # of the fit
_STEP, _LONGEST = 0.3, 1.2  # differences and largest step of log E [-]
_FLOOR, _SHARE = 0.45, 0.1  # deviation of a torque: a tared Gen3's [N m], and over its size [-]
_STD = 1.0  # of log E of a class about its mean in the other plants


def fitted(recipe: Recipe, name: str, plans: Sequence[Any], *, support: Sequence[Any] = (), device: str = "cpu",
           moduli: str = "fitted", jitter: float = 0.0) -> list[Touch]:
    """Grow the plant of a view from its recipe, fit its moduli to the ``support`` and touch it.

    Args:
        recipe: of the dataset. name: of the object view. plans: of the touches that are asked, each with joint angles
        ``q`` (T, 7) [rad].
        support: readings of the same plant, each as `vsfsim.bench.method.Reading` of joint torques (T, 7) [N m].
        device: Warp device.
        moduli: one of `MODULI`.
        jitter: RMS of a smooth random displacement of the skeleton, which stands for what vision errs [m].

    Returns:
        One touch a plan; it ends where the model meets the scene's force limit.

    Raises:
        SceneError: the scene has no arm that touches a plant, or ``moduli`` is none of them.
    """
    one_of(moduli, MODULI, "moduli", SceneError)
    job = named_job(recipe, name)
    if job.scene().effector != "arm":
        raise SceneError(f"rod-map bends plants, and scene '{recipe.scene}' has none.")
    subject = outline(job)
    known = displaced(subject.plant, jitter, np.random.default_rng((recipe.seed, job.object_index)))
    subject = dataclasses.replace(subject, arm=load(subject.scene.required_arm))
    if moduli == "true":
        return touched(subject, [known], plans, device)[0]
    own = given = class_means([subject.plant])
    if moduli == "fitted":
        given = class_means([admitted(one, one.scene()) for one in jobs_of(job.recipe, job.path, "")
                             if one.object_index != job.object_index and one.view_index == 0])
        missing = [part for part in own if part not in given]
        if missing:
            raise SceneError(f"rod-map learns its prior from the other plants of the dataset, and none of scene "
                             f"'{recipe.scene}' has a {missing[0]}.")
    theta = np.array([given.get(part, 0.0) for part in known.region_names])
    if moduli == "fitted" and support:
        theta = fit(subject, known, theta, support, device)
    return touched(subject, [with_classes(known, theta)], plans, device)[0]


def fit(subject: Subject, plant: Plant, mean: np.ndarray, support: Sequence[Any], device: str) -> np.ndarray:
    """log E of the classes (R,) of a plant that explains the readings of a support best; ``mean`` is the prior's."""
    actions, truth = [one.action for one in support], np.concatenate([one.value for one in support])
    known = np.concatenate([one.valid for one in support])
    weight = np.where(known[:, None], 1.0 / np.hypot(_FLOOR, _SHARE * np.nan_to_num(truth)), 0.0)
    used = np.unique(plant.region[1:])

    def residuals(tried: Sequence[np.ndarray]) -> np.ndarray:
        found = touched(subject, [with_classes(plant, one) for one in tried], actions, device)
        torque = np.stack([np.concatenate([held(touch, len(action.q)) for touch, action in zip(some, actions)])
                           for some in found])
        return np.concatenate([(weight * (torque - np.nan_to_num(truth))).reshape(len(tried), -1),
                               (np.stack(tried) - mean)[:, used] / _STD], axis=1)

    theta, length = np.array(mean), _LONGEST
    (here,) = residuals([theta])
    for _ in range(_ROUNDS):
        slope = (residuals([theta + _STEP * way for way in np.eye(len(mean))[used]]) - here) / _STEP
        step = np.zeros(len(mean))
        step[used] = np.linalg.solve(slope @ slope.T, -slope @ here)
        step *= min(1.0, length / max(np.abs(step).max(), 1e-12))
        tried = [theta + part * step for part in (1.0, 0.3)]
        found = residuals(tried)
        loss = (found**2).sum(axis=1)
        best = int(loss.argmin())
        if loss[best] >= here @ here:
            length *= 0.3
            continue
        theta, here = tried[best], found[best]
    return theta


def touched(subject: Subject, plants: Sequence[Plant], plans: Sequence[Any], device: str) -> list[list[Touch]]:
    """The touches of each plant, along the joint angles of the plans."""
    arm = subject.loaded_arm()
    out: list[dict[int, Touch]] = [{} for _ in plants]
    for frames in dict.fromkeys(len(plan.q) for plan in plans):
        mine = [k for k, plan in enumerate(plans) if len(plan.q) == frames]
        aims = tuple(ArmAim.along(plans[k].q, plans[k].axis) for k in mine)
        poses = np.stack([arm.body_poses(a.line) for a in aims], axis=1)
        each = [dataclasses.replace(subject, plant=plant, model=beams(plant, subject.scene), aims=aims, poses=poses)
                for plant in plants]
        solved = solve(each, device=device)
        for k, one in enumerate(each):
            some = finish_touches(one, solved.of(slice(k * len(aims), (k + 1) * len(aims))))
            out[k] |= zip(mine, some, strict=True)
    return [[one[k] for k in range(len(plans))] for one in out]


def held(touch: Touch, frames: int) -> np.ndarray:
    """Joint torques (frames, 7) [N m] of a touch that holds its last where it ended before, or had no equilibrium."""
    good = np.flatnonzero(touch.converged)
    if not len(good):
        return np.zeros((frames, 7))
    return np.stack([np.interp(np.arange(frames), good, column[good]) for column in np.asarray(touch.torque).T], axis=1)


def with_classes(plant: Plant, log_modulus: np.ndarray) -> Plant:
    """A plant with log E (R,) of its classes; the cores of its wires change with their segments."""
    modulus = np.exp(np.asarray(log_modulus))[plant.region]
    core = None if plant.yielding is None else plant.yielding * (modulus / plant.young_modulus)[:, None]
    if core is not None:
        core[0] = plant.yielding[0]  # type: ignore[index]
    return dataclasses.replace(plant, young_modulus=modulus, yielding=core)


def class_means(plants: Sequence[Plant]) -> dict[str, float]:
    """Mean log E of the segments of each class over plants that have it."""
    found: dict[str, list[float]] = {}
    for plant in plants:
        for index, name in enumerate(plant.region_names):
            mine = np.flatnonzero(plant.region[1:] == index) + 1
            if len(mine):
                found.setdefault(name, []).append(float(np.log(plant.young_modulus[mine]).mean()))
    return {name: float(np.mean(values)) for name, values in found.items()}
