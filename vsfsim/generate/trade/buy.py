"""`vsfsim generate --accuracy 5%`: a promise for every touch, by a factor that a pilot calibrates.

Every touch is simulated under two settings, and its error is taken as their difference times a factor; where that is
above what was asked, the touch goes on to the next setting. The factor is conformal (Angelopoulos et al. 2024,
Conformal risk control, ICLR): of n touches of different objects, whose errors are known from a reference, each has a
least factor with which, and with any larger one, it ends under a setting that keeps what was asked. With the
ceil(0.95 (n + 1))-th smallest of these, 95 % of further touches are kept on average over pilots.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.disk import Store
from vsfsim.data.manifest import ENOUGH, MANIFEST, PART_MANIFEST, apart, error_against
from vsfsim.data.recipe import Recipe
from vsfsim.generate.aim import Aim
from vsfsim.generate.effector import effector_of, kernels_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import Subject, prepare
from vsfsim.generate.trade.setting import Ground
from vsfsim.physics import tiers
from vsfsim.physics.runtime import compile_kernels

LEAST, MOST = 0.001, 0.5
"""Accuracies that can be asked for [-]."""
PILOT = 19
"""Touches of the pilot, each of an object of its own; with fewer no factor is large enough."""
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
    asked, there = request.accuracy, _begun(folder)
    assert asked is not None
    if there is not None and there.get("options", {}).get("accuracy", {}).get("asked") == asked:
        return there["tier"], {"accuracy": there["options"]["accuracy"]}
    said = request.note or (lambda sentence: None)
    pilot = aimed(loaded, touches=1, objects=PILOT, seed=request.seed + SEED, device=request.device)
    steps, ladder = pilot.ground.steps(), pilot.ground.ladder()
    tried, began = list[tuple[list[float], list[float]]](), time.process_time()
    for k, (subject, (a,)) in enumerate(pilot.drawn):
        made = [pilot.effector.touched(subject, [a], step, device=request.device)[0] for step in steps]
        force, error, found = pilot.effector.reference(subject, a, ladder, device=request.device).values()
        tried.append(([apart(*pair) for pair in itertools.pairwise(made)],
                      [error_against(one.force, one.converged, force, found, error) or 0.0 for one in made[1:]]))
        if k == 0:
            said(f"--accuracy {100 * asked:g} %: a pilot of {PILOT} touches of different objects, about "
                 f"{PILOT * (time.process_time() - began):.0f} s of processor time")
        if request.progress is not None:
            request.progress(k + 1, PILOT, "touches of the pilot")
    factor = quantile([least_factor(*touch, asked) for touch in tried])
    last = [errors[-1] for _, errors in tried]
    if math.isinf(factor):
        off = sum(error > asked for error in last)
        raise SceneError(f"{loaded.path}: --accuracy is {100 * asked:g} %, but in the pilot {off} of {PILOT} touches "
                         f"are off by more under the finest setting, {steps[-1].key}, the worst by "
                         f"{_percent(max(last))}, the error of its reference included. Ask for "
                         f"{_percent(quantile(last))} or more, or give a finer resolution in [object].")
    ends = [ended(differences, factor, asked) for differences, _ in tried]
    total = recipe.objects * recipe.views * recipe.touches
    audits = min(total, max(AUDITS[0], min(AUDITS[1], total // 10)))
    said(f"the error of a touch is taken as {factor:.2g} times the difference of two settings: "
         + ", ".join(f"{ends.count(k)} of {PILOT} end under {steps[k + 1].key}" for k in sorted(set(ends)))
         + f"; {audits} of {total} touches are audited, each for about "
         f"{(time.process_time() - began) / PILOT:.2g} s of processor time at most")
    promise = {"asked": asked, "factor": factor, "touches": PILOT, "audits": audits,
               "expected": max(errors[k] for k, (_, errors) in zip(ends, tried, strict=True)),
               **{name: [s.table() for s in some] for name, some in (("steps", steps), ("ladder", ladder))}}
    return pilot.ground.tier, {"accuracy": promise}


@dataclass(frozen=True)
class Aimed:
    """Touches of the first objects of a scene, aimed once."""

    effector: OnSolids
    """What touches."""
    tier: str
    """The scene's own."""
    ground: Ground
    """Where its settings begin."""
    drawn: Sequence[tuple[Subject, list[Aim]]]
    """Of each object, how it is touched."""


def aimed(loaded: SceneFile, *, touches: int, objects: int, seed: int, device: str) -> Aimed:
    """Aim touches that can be made again under other settings.

    Args:
        loaded: the scene, with ``[touches]``.
        touches: of each object.
        objects: how many.
        seed: as of `vsfsim generate`.
        device: Warp device.

    Raises:
        SceneError: the scene cannot be touched so.
    """
    recipe, scene = make_recipe(loaded, seed=seed, objects=objects, views=1, touches=touches), loaded.sample(0)
    effector = effector_of(scene)
    if not isinstance(effector, OnSolids):
        raise SceneError(f"{scene.source}: what a [{effector.table}] touches cannot be touched again on another mesh. "
                         f"Speed against accuracy is measured for a [probe] and a [sensor] on a solid object.")
    start = max(recipe.tier, "fem-coarse", key=list(tiers.TIERS).index)
    ground = Ground(start, tiers.element_size(scene.required_object, start, scene.probe),
                    None if scene.sensor is None else scene.sensor.nodes)
    compile_kernels(kernels_of(scene), device)
    subjects = [prepare(job, device=device) for job in jobs_of(recipe, loaded.path, ".")]
    return Aimed(effector, recipe.tier, ground, [(one, effector.aim(one, device=device)) for one in subjects])


def least_factor(differences: Sequence[float], errors: Sequence[float], asked: float) -> float:
    """Least factor [-] with which, and with any larger one, a touch ends under a setting that keeps what was ``asked``
    [-]; infinite if the last one does not.

    Args:
        differences: from each setting to the next [-].
        errors: of all settings but the first [-].
    """
    if errors[-1] > asked:
        return math.inf
    above = [asked / max(d, 1e-12) for d, error in zip(differences[:-1], errors[:-1], strict=True) if error > asked]
    return max(1.0, *above) * (1.0 + 1e-9) if above else 1.0


def ended(differences: Sequence[float], factor: float, asked: float) -> int:
    """The first difference of settings that keeps what was asked by the factor, or the last."""
    return next((k for k, d in enumerate(differences) if factor * d <= asked), len(differences) - 1)


def quantile(values: Sequence[float]) -> float:
    """What one more of the same kind is under with a probability of `ENOUGH`; infinite if there are too few."""
    rank = math.ceil(ENOUGH * (len(values) + 1) - 1e-9)
    return sorted(values)[rank - 1] if rank <= len(values) else math.inf


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if math.isfinite(share) else "all, for a frame has no equilibrium"


def _begun(folder: Path | str) -> Mapping[str, Any] | None:
    """The recipe of the dataset that lies in a folder, or was begun there."""
    store = Store(folder)
    for name in (MANIFEST, PART_MANIFEST):
        try:
            found = from_json(store.get(name) or b"")["recipe"]
            if isinstance(found["options"], dict):
                return found
        except (ValueError, KeyError, TypeError):
            continue
    return None
