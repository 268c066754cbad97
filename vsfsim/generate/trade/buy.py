"""`vsfsim generate --accuracy 5%`: a promise for every touch, by a factor that a pilot calibrates.

Every touch is simulated under two settings, and its error is taken as their difference times a factor; where that is
above what was asked, the touch goes on to the next setting. Of touches of a pilot, of different objects, the errors are
known from a reference, so that each has a least factor with which, and with any larger one, it ends under a setting
that keeps what was asked. With the largest of 59 of these at least 95 % of further touches are kept, with a confidence
of 95 % (Wilks 1941, Annals of Mathematical Statistics 12, 91).
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import itertools
import json
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import DatasetError, SceneError, VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.disk import Store
from vsfsim.data.lines import FOLDER, TOUCH
from vsfsim.data.manifest import MANIFEST, PART_MANIFEST, apart, error_against
from vsfsim.data.provenance import made_by
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import Touch
from vsfsim.generate.effector import effector_of, kernels_of
from vsfsim.generate.job import Job, jobs_of
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import prepare
from vsfsim.generate.trade.setting import Setting
from vsfsim.generate.workers import ENDED, in_pool
from vsfsim.physics import tiers
from vsfsim.physics.runtime import compile_kernels

LEAST, MOST = 0.001, 0.5
"""Accuracies that can be asked for [-]."""
PILOT = 59
"""Touches of the pilot, each of an object of its own: the least number of which at least `ENOUGH` of all of their kind
are under the largest, but for a probability of `RISK`."""
SEED = 1_000_003
"""Added to the seed of a dataset for the objects and touches of its pilot, which are others."""
AUDITS = 29, 100
"""Audited touches, one in ten and at least and at most so many: 29 that are all kept show 90 %, see `least_share`."""


def check_accuracy(accuracy: float, tier: str | None) -> None:
    """Raises:
        VsfsimError: no share of a force that could be kept, or a tier was asked for as well.
    """
    if not LEAST <= accuracy <= MOST:
        raise VsfsimError(f"--accuracy is {100 * accuracy:g} %; the error of the force may be {100 * LEAST:g} % to "
                          f"{100 * MOST:g} % of its largest value, e.g. --accuracy 5%.")
    if tier is not None:
        raise VsfsimError(f"--tier is '{tier}' and --accuracy is {100 * accuracy:g} %, which "
                          "chooses the tier itself. Leave one of them out.")


def bought(loaded: SceneFile, folder: Path | str, request: Request, recipe: Recipe) -> tuple[str, dict[str, Any]]:
    """The tier and the options of the recipe that keep the accuracy of a request: those of the dataset that was begun
    in ``folder``, else those that a pilot finds; ``recipe`` is the dataset's without them.

    Raises:
        SceneError: no factor keeps it, with the figure; or the scene's touches cannot be made again.
    """
    asked, said = request.accuracy, request.note
    assert asked is not None
    if (there := _begun(folder, asked)) is not None:
        return there
    (ground, _), tried = ground_of(loaded, device=request.device), list[Tried]()
    steps, ladder = ground.steps(), ground.ladder(asked)
    pilot = request.but(seed=request.seed + SEED, objects=PILOT)
    for _, touch in touches(loaded, ground, asked, pilot, Store(folder)):
        tried.append(touch)
        if len(tried) == 1:
            said(f"--accuracy {100 * asked:g} %: a pilot of {PILOT} touches of different objects, about "
                 f"{PILOT * sum(touch.seconds):.0f} s of processor time")
        request.progress(len(tried), PILOT, "touches of the pilot")
    factor = max(least_factor(touch.differences, touch.errors[1:], asked) for touch in tried)
    last = [touch.errors[-1] for touch in tried]
    if math.isinf(factor):
        raise SceneError(f"{loaded.path}: --accuracy is {100 * asked:g} %, but in the pilot "
                         f"{sum(error > asked for error in last)} of {PILOT} touches are off by more under the finest "
                         f"setting, {steps[-1].key}, the worst by {_percent(max(last))}, the error of its reference "
                         f"included. Ask for more than that, or give [object] a finer resolution.")
    ends = [ended(touch.differences, factor, asked) for touch in tried]
    total = recipe.objects * recipe.views * recipe.touches
    audits = min(total, max(AUDITS[0], min(AUDITS[1], total // 10)))
    cost = [sum(touch.seconds[:k + 2]) for k, touch in zip(ends, tried, strict=True)]
    said(f"the error of a touch is taken as {factor:.2g} times the difference of two settings: "
         + ", ".join(f"{ends.count(k)} of {PILOT} end under {steps[k + 1].key}" for k in sorted(set(ends)))
         + f"; {total} touches cost about {total * sum(cost) / PILOT:.0f} s of processor time, and the audits of "
         f"{audits} of them {audits * sum(sum(touch.seconds[2:]) for touch in tried) / PILOT:.0f} s")
    promise = {"asked": asked, "factor": factor, "touches": PILOT, "audits": audits,
               "expected": max(touch.errors[k + 1] for k, touch in zip(ends, tried, strict=True)),
               **{name: [s.table() for s in some] for name, some in (("steps", steps), ("ladder", ladder))}}
    return ground.tier, {"accuracy": promise}


@dataclass(frozen=True)
class Tried:
    """A touch under all settings."""

    differences: Sequence[float]
    """From each setting to the next [-]."""
    errors: Sequence[float]
    """Of each setting [-]."""
    seconds: Sequence[float]
    """Processor time of each setting, then of what a reference needs besides [s]."""


def touches(loaded: SceneFile, ground: Setting, asked: float, request: Request,
            store: Store) -> Iterator[tuple[int, Tried]]:
    """The number of each object of a request and a touch of it, as they come, each made by one process. Each lies in
    the folder of the lines of a dataset until that is finished, and is not made again there for an accuracy of the same
    reference, or for another number of objects.

    Raises:
        VsfsimError: of the first that cannot be made; the others are then cancelled.
    """
    recipe, left = make_recipe(loaded, request, views=1, touches=1), list[Job]()
    steps, ladder = ground.steps(), ground.ladder(asked)
    words = [dataclasses.replace(recipe, objects=0, splits={}).table(), made_by(),
             *(setting.table() for setting in (*steps, *ladder))]
    mark = hashlib.sha256(json.dumps(words, sort_keys=True).encode()).hexdigest()
    for job in jobs_of(recipe, loaded.path, "."):
        there = from_json(store.get(f"{FOLDER}/{job.name}{TOUCH}") or b"{}")
        if there.get("of") == mark:
            yield job.object_index, Tried(there["differences"], there["errors"], there["seconds"])
        else:
            left.append(job)
    try:
        for job, touch in in_pool(_tried, left, steps, ladder, request.device, device=request.device,
                                  workers=request.workers):
            store.put(f"{FOLDER}/{job.name}{TOUCH}", json.dumps({"of": mark, **dataclasses.asdict(touch)}).encode())
            yield job.object_index, touch
    except BrokenProcessPool as error:
        raise DatasetError(ENDED.format("touch of the pilot")) from error


def _tried(job: Job, steps: Sequence[Setting], ladder: Sequence[Setting], device: str) -> Tried:
    """In a process of its own: the touch of a view under all settings, and on the meshes of its reference."""
    subject, made, clock = prepare(job, device=device), list[Touch](), list[float]()
    effector = effector_of(subject.scene)
    assert isinstance(effector, OnSolids)
    (a,) = effector.aim(subject, device=device)
    for step in steps:
        clock.append(time.process_time())
        made += effector.touched(subject, [a], step, device=device)
    clock.append(time.process_time())
    force, error, found = effector.reference(subject, a, ladder, made=dict(zip(steps, made, strict=True)),
                                             device=device).values()
    return Tried([apart(*pair) for pair in itertools.pairwise(made)],
                 [error_against(one.force, one.converged, force, found, error) or 0.0 for one in made],
                 np.diff([*clock, time.process_time()]).tolist())


def ground_of(loaded: SceneFile, *, device: str) -> tuple[Setting, OnSolids]:
    """Where the settings of a scene begin, its own tier or ``fem-coarse``, and what touches; kernels are compiled.

    Raises:
        SceneError: its touches cannot be made again.
    """
    scene = loaded.sample(0)
    effector = effector_of(scene)
    if not isinstance(effector, OnSolids):
        raise SceneError(f"{scene.source}: what a [{effector.table}] touches cannot be touched again on another mesh. "
                         f"Speed against accuracy is measured for a [probe] and a [sensor] on a solid object.")
    tier = max(effector.check(scene, None), "fem-coarse", key=list(tiers.TIERS).index)
    compile_kernels(kernels_of(scene), device)
    return Setting(tier, tiers.element_size(scene.required_object, tier, scene.probe),
                   nodes=None if scene.sensor is None else scene.sensor.nodes), effector


def least_factor(differences: Sequence[float], errors: Sequence[float], asked: float) -> float:
    """Least factor [-] with which, and with any larger one, a touch ends under a setting that keeps what was ``asked``
    [-]; infinite if the last one does not.

    Args:
        differences: from each setting to the next [-].
        errors: of all settings but the first [-].
    """
    if errors[-1] > asked:
        return math.inf
    return max((asked / max(d, 1e-12) * (1.0 + 1e-9) for d, error in zip(differences[:-1], errors[:-1], strict=True)
                if error > asked), default=0.0)


def ended(differences: Sequence[float], factor: float, asked: float) -> int:
    """The first difference of settings that keeps what was asked by the factor, or the last."""
    return next((k for k, d in enumerate(differences) if factor * d <= asked), len(differences) - 1)


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if math.isfinite(share) else "all, for a frame has no equilibrium"


def _begun(folder: Path | str, asked: float) -> tuple[str, dict[str, Any]] | None:
    """What `bought` found for the dataset that lies in a folder, or was begun there, if the same was ``asked``."""
    for name in (MANIFEST, PART_MANIFEST):
        with contextlib.suppress(ValueError, KeyError, TypeError):
            found = from_json(Store(folder).get(name) or b"")["recipe"]
            if found["options"]["accuracy"]["asked"] == asked:
                return found["tier"], {"accuracy": found["options"]["accuracy"]}
    return None
