"""`vsfsim generate --accuracy 5%`: the cheapest tier and element size that keep it on the first objects."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.scene import SceneFile
from vsfsim.data.manifest import MANIFEST, PART_MANIFEST
from vsfsim.data.store import open_store
from vsfsim.generate.effector import effector_of
from vsfsim.generate.trade import front
from vsfsim.generate.trade.curve import limits
from vsfsim.generate.trade.runs import DatasetTouches
from vsfsim.generate.trade.setting import LIMIT_TIER, RATIO, Setting
from vsfsim.physics import tiers

LEAST, MOST = 0.001, 0.5
"""Accuracies that can be asked for [-]."""
MARGIN = 0.7
"""Share of what is asked that the worst touch of the pilot, and the error of its limit, may take: other touches are
worse than these few [-]."""
MARKED = 0.25
"""Share of the frames in contact that may be marked, where another setting does with less [-]."""
TOUCHES, OBJECTS = 3, 2
"""Of the pilot: touches of each of the first objects."""


def check_accuracy(accuracy: float, tier: str | None) -> None:
    """Raises:
        VsfsimError: no share of a force that could be kept, or a tier was asked for as well.
    """
    if not LEAST <= accuracy <= MOST:
        raise VsfsimError(f"--accuracy is {100 * accuracy:g} %; the error of the force may be {100 * LEAST:g} % to "
                          f"{100 * MOST:g} % of its largest value, e.g. --accuracy 5%.")
    if tier is not None:
        raise VsfsimError(f"--tier is '{tier}' and --accuracy is {100 * accuracy:g} %, which chooses the tier itself. "
                          f"Leave one of them out.")


def bought(loaded: SceneFile, folder: Path | str, accuracy: float, *, seed: int, objects: int, device: str,
           cache: Path | None, note: Callable[[str], None] | None) -> tuple[str, dict[str, Any]]:
    """The tier and the options of the recipe that keep an accuracy: those of the dataset that was begun in ``folder``,
    else those that a pilot finds.

    The pilot takes the first of `candidates` whose worst touch keeps `MARGIN` of the accuracy, and of which at most
    `MARKED` frames are marked if there is one.

    Raises:
        VsfsimError: no setting keeps it, with the figure; or the scene's touches cannot be made again.
    """
    there = _begun(folder)
    if there is not None and there.get("options", {}).get("accuracy", {}).get("asked") == accuracy:
        return there["tier"], {name: there["options"][name] for name in ("accuracy", "resolution")}
    said = note or (lambda sentence: None)
    subject = DatasetTouches(loaded, touches=TOUCHES, objects=min(OBJECTS, objects), seed=seed, device=device,
                             cache=cache)
    said(f"--accuracy {100 * accuracy:g} %: a pilot on {subject.what} chooses tier and element size")
    bounds, shares = [], []
    for k in range(subject.count):
        runs = [subject.near(k, setting, level) for level, setting in enumerate(subject.ground.ladder())]
        bounds.append(limits([r.edge[0] for r in runs], [r.curves[0] for r in runs],
                             tiers.TIERS[LIMIT_TIER].tolerance))
        shares.append(runs[-1].curves[0].share)
    known = sum(own["force"].known for own in bounds)
    if not known:
        raise SceneError(f"{loaded.path}: --accuracy is {100 * accuracy:g} %, but of no touch of the pilot is the "
                         f"limit known: {bounds[0]['force'].why}. Give a finer resolution in [object].")
    best, chosen = None, None
    for setting in candidates(loaded, subject.ground.resolution, device):
        p = front.point(setting.key, setting.tier or "", subject.run(setting), bounds, shares, shows=True)
        if best is None or p.error + p.bar < best.error + best.bar:
            best = p
        if p.error + p.bar <= MARGIN * accuracy:
            chosen = chosen or (setting, p)
            if p.marked <= MARKED:
                chosen = setting, p
                break
    if chosen is not None:
        setting, p = chosen
        said(f"chosen: {p.key}, {p.frame:.2g} s a frame; error {100 * p.error:.2g} % on the worst of {known} touches, "
             f"limit known to {100 * p.bar:.2g} %, {100 * p.marked:.0f} % of the frames in contact marked")
        return str(setting.tier), {
            "accuracy": {"asked": accuracy, "expected": _short(p.error), "limit": _short(p.bar), "touches": known},
            "resolution": setting.resolution}
    assert best is not None
    least = (best.error + best.bar) / MARGIN
    raise SceneError(f"{loaded.path}: --accuracy is {100 * accuracy:g} %, but the most exact setting of the pilot, "
                     f"{best.key}, is off by {100 * best.error:.2g} % with a limit known to {100 * best.bar:.2g} %. "
                     f"Ask for {100 * least:.2g} % or more, or give a finer resolution in [object].")


def candidates(loaded: SceneFile, resolution: float | None, device: str) -> list[Setting]:
    """Settings that show what the scene needs, cheap ones first by elements and tier; the order is that of no clock, so
    that every machine chooses the same."""
    scene, out = loaded.sample(0), []
    if resolution is None:
        raise SceneError(f"{loaded.path}: --accuracy chooses the elements of an [object], and the scene has none.")
    for level, names in ((1, ("linear", "fem-coarse")), (0, ("linear", "fem-coarse")), (-1, ("linear", "fem-coarse")),
                         (-2, ("linear", LIMIT_TIER))):
        for name in names:
            try:
                effector_of(scene).check(scene, name, "float64")
            except VsfsimError:
                continue
            out.append(Setting(name, resolution * RATIO**level, device=device))
    return out


def _begun(folder: Path | str) -> Mapping[str, Any] | None:
    """The recipe of the dataset that lies in a folder, or was begun there."""
    store = open_store(folder)
    for name in (MANIFEST, PART_MANIFEST):
        try:
            found = json.loads(store.get(name) or b"")["recipe"]
            if isinstance(found["options"], dict):
                return found
        except (ValueError, KeyError, TypeError):
            continue
    return None


def _short(value: float) -> float:
    return float(f"{value:.3g}")
