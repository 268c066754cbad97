"""`vsfsim generate --accuracy 5%`: the cheapest tier and element size that keep it on the first objects of a scene."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.disk import Store
from vsfsim.data.manifest import MANIFEST, PART_MANIFEST
from vsfsim.generate.effector import effector_of
from vsfsim.generate.trade import front
from vsfsim.generate.trade.front import Point
from vsfsim.generate.trade.setting import LIMIT_TIER, RATIO, REFINED, Setting
from vsfsim.generate.trade.touches import DatasetTouches, limits

LEAST, MOST = 0.001, 0.5
"""Accuracies that can be asked for [-]."""
MARGIN = 0.7
"""Share of what is asked that the worst touch of the pilot may be off by, see `Point.off`: other touches are worse than
these few [-]."""
MARKED = 0.25
"""Share of the frames in contact that may be marked, where another setting does with less [-]."""
TOUCHES, OBJECTS = 3, 2
"""Of the pilot: touches of each of the first objects."""
_COARSE, _MIDDLE, _FINE, _FINEST = ((power, LIMIT_TIER, level) for power, level in REFINED)
SIZES = ((1, "linear", None), (1, "fem-coarse", None), (0, "linear", None), (0, "fem-coarse", None),
         _COARSE, _MIDDLE,(-1, "linear", None), (-1, "fem-coarse", None), _FINE, _FINEST)
"""Elements of the candidates, cheap ones first, as the scene's own times `RATIO` to such a power; tier; level of the
elements where a touch meets the object. The order is that of no clock, so that every machine chooses the same."""


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


def bought(loaded: SceneFile, folder: Path | str, request: Request, objects: int) -> tuple[str, dict[str, Any]]:
    """The tier and the options of the recipe that keep the accuracy of a request: those of the dataset that was begun
    in ``folder``, else those that a pilot finds: the first candidate whose worst touch keeps `MARGIN` of the accuracy,
    and of which at most `MARKED` frames are marked if there is one.

    Raises:
        SceneError: no setting keeps it, with the figure; or the scene's touches cannot be made again.
    """
    accuracy, there = request.accuracy, _begun(folder)
    assert accuracy is not None
    if there is not None and there.get("options", {}).get("accuracy", {}).get("asked") == accuracy:
        return there["tier"], {name: there["options"][name] for name in ("accuracy", "resolution", "contact")
                               if name in there["options"]}
    said, asked = request.note or (lambda sentence: None), f"{loaded.path}: --accuracy is {100 * accuracy:g} %, but"
    said(f"--accuracy {100 * accuracy:g} %: a pilot chooses tier and element size")
    subject = DatasetTouches(loaded, touches=TOUCHES, objects=min(OBJECTS, objects), seed=request.seed,
                             device=request.device)
    ladder = subject.ground.ladder()
    bounds, shares = zip(*(limits([subject.near(k, setting) for setting in ladder])
                           for k in range(subject.count)), strict=True)
    known = sum(own["force"].known for own in bounds)
    if not known:
        raise SceneError(f"{asked} of no touch of the pilot is the limit known: "
                         f"{bounds[0]['force'].why}. Give a finer resolution in [object].")
    best: Point | None = None
    chosen: tuple[Setting, Point] | None = None
    for setting in candidates(loaded, subject.ground.resolution):
        p = front.point(setting, subject.run(setting), bounds, shares, shows=True)
        best = p if best is None or math.isnan(best.off) or p.off < best.off else best
        if p.off <= MARGIN * accuracy and (chosen is None or p.marked <= MARKED):
            chosen = setting, p
            if p.marked <= MARKED:
                break
    if chosen is None:
        assert best is not None
        raise SceneError(f"{asked} {too_much(best)}, or give a finer resolution in [object].")
    setting, p = chosen
    said(f"chosen: {p.key}, {p.frame:.2g} s a frame; error {100 * p.error:.2g} % on the worst of "
         f"{known} touches, limit known to {100 * p.bar:.2g} %, {100 * p.marked:.0f} % of the "
         "frames in contact marked")
    promise = {"asked": accuracy, "expected": float(f"{p.error:.3g}"),
               "limit": float(f"{p.bar:.3g}"), "touches": known}
    return setting.tier, {"accuracy": promise, **setting.options()}


def too_much(best: Point) -> str:
    """Why an accuracy is not to be had, and what can be done."""
    if math.isnan(best.off):
        return (f"the most exact setting of the pilot, {best.key}, has no equilibrium at full "
                "depth in a touch. Press less deep")
    return (f"the most exact setting of the pilot, {best.key}, is off by {100 * best.off:.2g} % on its worst touch, "
            f"the error of its limit included. Ask for {100 * best.off / MARGIN:.2g} % or more")


def candidates(loaded: SceneFile, resolution: float) -> list[Setting]:
    """Settings that show what the scene needs, cheap ones first."""
    scene, out = loaded.sample(0), []
    for power, name, level in SIZES:
        try:
            effector_of(scene).check(scene, name)
        except VsfsimError:
            continue
        out.append(Setting(name, resolution * RATIO**power, level=level))
    return out


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
