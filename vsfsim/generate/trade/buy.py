"""`vsfsim generate --accuracy 5%`: the cheapest tier and element size that keep it on the first objects of a class."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import SceneFile
from vsfsim.data.manifest import MANIFEST, PART_MANIFEST
from vsfsim.data.store import open_store
from vsfsim.generate.effector import effector_of
from vsfsim.generate.trade import front
from vsfsim.generate.trade.front import Point
from vsfsim.generate.trade.made import Touched, limits
from vsfsim.generate.trade.runs import DatasetTouches
from vsfsim.generate.trade.setting import LIMIT_TIER, RATIO, REFINED, Setting

LEAST, MOST = 0.001, 0.5
"""Accuracies that can be asked for [-]."""
MARGIN = 0.7
"""Share of what is asked that the worst touch of the pilot may be off by, see `Point.off`: other touches are worse than
these few [-]."""
MARKED = 0.25
"""Share of the frames in contact that may be marked, where another setting does with less [-]."""
TOUCHES, OBJECTS = 3, 2
"""Of the pilot: touches of each of the first objects; of each class the first object alone."""
_COARSE, _MIDDLE, _FINE, _FINEST = ((power, LIMIT_TIER, level) for power, level in REFINED)
SIZES = ((1, "linear", None), (1, "fem-coarse", None), (0, "linear", None), (0, "fem-coarse", None), _COARSE, _MIDDLE,
         (-1, "linear", None), (-1, "fem-coarse", None), _FINE, _FINEST)
"""Elements of the candidates, cheap ones first, as the scene's own times `RATIO` to such a power; tier; level of the
elements where a touch meets the object."""
CLASSES = 6
"""Most classes of objects of which each has a choice of its own."""

Choice = tuple[tuple[Setting, Point] | None, Point | None]
"""What a pilot takes, and the most exact point that it looked at, see `choose`."""


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


def classes(loaded: SceneFile) -> list[str]:
    """Names of the classes of a scene's objects, which take turns: those of the longest list in the shape of its object
    of which `each` object has the next, if it has at most `CLASSES`; else there is one without a name."""
    shape = loaded.tree.get("object", {}).get("shape", {})
    lists = [value["each"] for value in shape.values() if isinstance(value, dict) and "each" in value]
    longest: list[Any] = max(lists, key=len, default=[])
    return [str(one) for one in longest] if 1 < len(longest) <= CLASSES else [""]


def bought(loaded: SceneFile, folder: Path | str, accuracy: float, *, seed: int, objects: int, device: str,
           cache: Path | None, note: Callable[[str], None] | None) -> tuple[str, dict[str, Any]]:
    """The tier and the options of the recipe that keep an accuracy: those of the dataset that was begun in ``folder``,
    else those that a pilot finds, for each of the `classes` of objects.

    The pilot takes the first of `candidates` whose worst touch keeps `MARGIN` of the accuracy, and of which at most
    `MARKED` frames are marked if there is one. A class of whose touches no limit is known has the dearest setting of
    the others.

    Raises:
        VsfsimError: no setting keeps it, with the figure; or the scene's touches cannot be made again.
    """
    there = _begun(folder)
    if there is not None and there.get("options", {}).get("accuracy", {}).get("asked") == accuracy:
        return there["tier"], {name: there["options"][name] for name in ("accuracy", "resolution", "contact", "classes")
                               if name in there["options"]}
    names, said = classes(loaded)[:objects], note or (lambda sentence: None)
    said(f"--accuracy {100 * accuracy:g} %: a pilot chooses tier and element size")
    asked = f"{loaded.path}: --accuracy is {100 * accuracy:g} %, but"
    found: list[Choice | str] = []
    counts = []
    for k in range(len(names)):
        subject = DatasetTouches(loaded, touches=TOUCHES, objects=min(OBJECTS, objects) if len(names) == 1 else 1,
                                 first=k, seed=seed, device=device, cache=cache)
        choice, known = _pilot(subject, loaded, accuracy, device)
        if not isinstance(choice, str) and choice[0] is None:
            assert choice[1] is not None
            raise SceneError(f"{asked} {too_much(choice[1])}, or give a finer resolution in [object].")
        found.append(choice)
        counts.append(known)
    others = [choice for choice in found if not isinstance(choice, str)]
    if not others:
        raise SceneError(f"{asked} of no touch of the pilot is the limit known: {found[0]}. Give a finer resolution in "
                         f"[object].")
    taken = [one for choice in found if (one := (dearest(others) if isinstance(choice, str) else choice)[0])]
    table: list[dict[str, Any]] = []
    for name, (setting, p), known in zip(names, taken, counts, strict=True):
        whose = f"error {100 * p.error:.2g} % on the worst of {known} touches, limit known to {100 * p.bar:.2g} %, " \
                f"{100 * p.marked:.0f} % of the frames in contact marked" if known else \
                "as the dearest of the others, because of no touch of the pilot is the limit known"
        said(f"chosen{f' for {name}' * bool(name)}: {p.key}, {p.frame:.2g} s a frame; {whose}")
        table.append({"class": name, "tier": str(setting.tier), **setting.options()})
    worst = {"asked": accuracy, "expected": _short(max(p.error for _, p in taken)),
             "limit": _short(max(p.bar for _, p in taken)), "touches": sum(counts)}
    if len(names) > 1:
        return str(max(taken, key=lambda one: cost(one[0]))[0].tier), {"accuracy": worst, "classes": table}
    return table[0]["tier"], {"accuracy": worst, **taken[0][0].options()}


def _pilot(subject: Touched, loaded: SceneFile, accuracy: float, device: str) -> tuple[Choice | str, int]:
    """What is chosen on some touches, or why no limit of one is known; and of how many one is."""
    ladder = subject.ground.ladder()
    bounds, shares = zip(*(limits([subject.near(k, setting) for setting in ladder])
                           for k in range(subject.count)), strict=True)
    known = sum(own["force"].known for own in bounds)
    if not known:
        return str(bounds[0]["force"].why), 0
    points = ((setting, front.point(setting.key, setting.tier or "", subject.run(setting), bounds, shares, shows=True))
              for setting in candidates(loaded, subject.ground.resolution, device))
    return choose(points, accuracy), known


def cost(setting: Setting) -> tuple[float, float, bool]:
    """Where a setting stands among those of several classes: by elements, there and elsewhere, then by tier."""
    return 1.0 / (setting.resolution or 1.0), -1.0 if setting.level is None else setting.level, setting.tier != "linear"


def dearest(found: Iterable[Choice]) -> Choice:
    """Of the choices of several classes that of the dearest setting, or one that found none."""
    return max(found, key=lambda one: (one[0] is None, (0.0, 0.0, False) if one[0] is None else cost(one[0][0])))


def choose(points: Iterable[tuple[Setting, Point]], accuracy: float) -> Choice:
    """The setting that a pilot takes, None if no one keeps the accuracy; and the most exact point that was looked at,
    None if there was none.

    Args:
        points: settings with what they miss, cheap ones first; no more are taken than it needs.
        accuracy: asked for [-].
    """
    best: Point | None = None
    chosen: tuple[Setting, Point] | None = None
    for setting, p in points:
        if best is None or math.isnan(best.off) or p.off < best.off:
            best = p
        if p.off <= MARGIN * accuracy:
            chosen = chosen or (setting, p)
            if p.marked <= MARKED:
                chosen = setting, p
                break
    return chosen, best


def too_much(best: Point) -> str:
    """Why an accuracy is not to be had, and what can be done."""
    if math.isnan(best.off):
        return (f"the most exact setting of the pilot, {best.key}, has no equilibrium at full depth in a touch. "
                "Press less deep")
    return (f"the most exact setting of the pilot, {best.key}, is off by {100 * best.off:.2g} % on its worst touch, "
            f"the error of its limit included. Ask for {100 * best.off / MARGIN:.2g} % or more")


def candidates(loaded: SceneFile, resolution: float | None, device: str) -> list[Setting]:
    """Settings that show what the scene needs, cheap ones first; the order is that of `SIZES` and of no clock, so that
    every machine chooses the same."""
    scene, out = loaded.sample(0), []
    if resolution is None:
        raise SceneError(f"{loaded.path}: --accuracy chooses the elements of an [object], and the scene has none.")
    for power, name, level in SIZES:
        try:
            effector_of(scene).check(scene, name)
        except VsfsimError:
            continue
        out.append(Setting(name, resolution * RATIO**power, level=level, device=device))
    return out


def _begun(folder: Path | str) -> Mapping[str, Any] | None:
    """The recipe of the dataset that lies in a folder, or was begun there."""
    store = open_store(folder)
    for name in (MANIFEST, PART_MANIFEST):
        try:
            found = from_json(store.get(name) or b"")["recipe"]
            if isinstance(found["options"], dict):
                return found
        except (ValueError, KeyError, TypeError):
            continue
    return None


def _short(value: float) -> float:
    return float(f"{value:.3g}")
