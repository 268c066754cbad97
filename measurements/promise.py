"""Is an accuracy that is bought also kept, and at what price? `vsfsim measure promise`.

The pilot of `vsfsim generate --accuracy` chooses on the first objects of each class of a scene; objects after them,
which it has not seen, are held out. Their touches are made at the setting that it chose, at the cheaper ones, and again
one level finer, as an audit is. The regret is what the chosen setting costs over what the cheapest setting costs that
also keeps the accuracy on 95 % of the held-out touches, with no more of its frames marked.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import vsfsim
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.pieces import Piece, Pieces
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.checks.kept import ENOUGH, error_against
from vsfsim.data.recipe import text_sha256
from vsfsim.generate.trade import front
from vsfsim.generate.trade.buy import (
    MARKED,
    OBJECTS,
    TOUCHES,
    Choice,
    candidates,
    choose,
    classes,
    dearest,
    too_much,
)
from vsfsim.generate.trade.curve import Curve
from vsfsim.generate.trade.front import Point
from vsfsim.generate.trade.made import Run, limits, together
from vsfsim.generate.trade.runs import touched
from vsfsim.generate.trade.setting import LIMIT_TIER, RATIO, Ground, Setting
from vsfsim.physics.convergence import Limit

UNKNOWN = "refused: of no touch of the pilot is the limit known"
OWN = {name: Path(__file__).parent / "scenes" / f"{name}.toml" for name in ("column", "bubble")}
SCENES = ("foam-block", "shoes-v3-mini", "column", "bubble")
"""An even body, a shell of many parts, layers and a bubble on an even body."""
ACCURACIES = (0.05, 0.02, 0.01)
EAGER = 3
"""Processes from which on the pilot is made at once, but for the dearest setting."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One scene: its pilot and the objects that are held out."""

    loaded: SceneFile
    ground: Ground
    name: str
    """Of the class of these objects; empty where there is one."""
    pilot: range
    held: range
    touches: int
    """Of each object that is held out."""
    pieces: Pieces

    @property
    def settings(self) -> list[Setting]:
        """From which the pilot chooses, cheap ones first."""
        return candidates(self.loaded, self.ground.resolution, self.ground.device)

    def piece(self, number: int, setting: Setting, alone: int | None = None) -> Piece:
        """Of an object of the pilot, or of one that is held out."""
        count = TOUCHES if number in self.pilot else self.touches
        return Piece(str(self.loaded.path), number, count, setting, alone)

    def ladders(self) -> list[list[Piece]]:
        """The meshes of the limit of every touch of the pilot."""
        return [[self.piece(number, setting, alone) for setting in self.ground.ladder()]
                for number in self.pilot for alone in range(TOUCHES)]

    def audits(self, chosen: Setting) -> list[Piece]:
        """Every touch that is held out, one level finer than a setting."""
        assert chosen.resolution is not None
        finer = Setting(LIMIT_TIER, chosen.resolution / RATIO, level=(chosen.level or 0) + 1)
        return [self.piece(number, finer, alone) for number in self.held for alone in range(self.touches)]

    def runs(self, setting: Setting, numbers: range) -> Run | str | None:
        """Of some objects together."""
        found = self.pieces.ask(self.piece(number, setting) for number in numbers)
        bad = [run for run in found if not isinstance(run, Run)]
        return bad[0] if bad else together([run for run in found if isinstance(run, Run)])

    def points(self, bounds: list[dict[str, Limit]], shares: list[np.ndarray]) -> Iterator[tuple[Setting, Point]]:
        """What the pilot finds of its settings, as far as the time goes."""
        for setting in self.settings:
            run = self.runs(setting, self.pilot)
            if isinstance(run, Run):
                yield setting, front.point(setting.key, setting.tier or "", run, bounds, shares, shows=True)

    def cost(self, run: Run) -> float:
        """CPU time of a touch of a dataset, with its share of what is made once an object [s]."""
        count = self.loaded.sample(0).required_touches.count
        return run.cpu / len(run.curves) + run.once / len(self.held) / count


def audit_error(curve: Curve, finer: Curve) -> float:
    """See `vsfsim.data.checks.kept.error_against` [-], on the way in; not a number if nothing was met."""
    force, exact = curve.readings["direction"], finer.readings["direction"]
    if len(force) != len(exact):
        return float("inf")
    found = error_against(force, curve.converged, exact, finer.converged)
    return float("nan") if found is None else found


def rows(trials: Sequence[Trial], accuracies: Sequence[float]) -> list[dict[str, Any]]:
    """One a class and accuracy: what was chosen, kept and paid. The classes' pieces are made side by side."""
    pieces = trials[0].pieces
    if pieces.workers >= EAGER:
        pieces.ask([p for t in trials for p in [*(t.piece(n, s) for s in reversed(t.settings[:-1]) for n in t.pilot),
                                                *(p for ladder in t.ladders() for p in reversed(ladder))]])
    pilots = [_pilot(trial, accuracies) for trial in trials]
    others = [found for found in pilots if isinstance(found, dict)]
    pilots = [{asked: dearest([found[asked] for found in others]) for asked in accuracies}
              if found == UNKNOWN and others else found for found in pilots]
    held = [[trial.piece(n, chosen) for n in trial.held]
            for trial, found in zip(trials, pilots, strict=True) if not isinstance(found, str)
            for chosen in _chosen(found)]
    audits = [trial.audits(chosen) for trial, found in zip(trials, pilots, strict=True) if not isinstance(found, str)
              for chosen in _chosen(found)]
    cheaper = [trial.piece(n, s) for trial, found in zip(trials, pilots, strict=True)
               if not isinstance(found, str) and (some := _chosen(found))
               for s in trial.settings[max(map(trial.settings.index, some))::-1] for n in trial.held]
    pieces.ask([*(p for own in (*held, *audits) for p in own), *cheaper])
    return [{"class": trial.name, **row} for trial, found in zip(trials, pilots, strict=True)
            for row in ([{"said": found}] if isinstance(found, str) else
                        [{"asked": asked, **_row(trial, asked, *found[asked])} for asked in accuracies])]


Choices = dict[float, Choice]
"""What `choose` says of each accuracy."""


def _chosen(found: Choices) -> list[Setting]:
    return list(dict.fromkeys(chosen[0] for chosen, _ in found.values() if chosen))


def _pilot(trial: Trial, accuracies: Sequence[float]) -> Choices | str:
    """What is chosen for each accuracy, or why nothing is."""
    ladders = trial.ladders()
    found = iter(trial.pieces.ask(p for ladder in ladders for p in ladder))
    bounds, shares = [], []
    for ladder in ladders:
        runs = [next(found) for _ in ladder]
        whole = [run for run in runs if isinstance(run, Run)]
        if len(whole) == len(runs):
            bound, share = limits(whole)
            bounds.append(bound)
            shares.append(share)
    if len(bounds) < len(ladders):
        return "the time was over in the pilot"
    if not any(own["force"].known for own in bounds):
        return UNKNOWN
    return {asked: choose(trial.points(bounds, shares), asked) for asked in accuracies}


def _row(trial: Trial, asked: float, chosen: tuple[Setting, Point] | None, best: Point | None) -> dict[str, Any]:
    if best is None or (chosen is None and any(trial.runs(s, trial.pilot) is None for s in trial.settings)):
        return {"said": "the time was over in the pilot"}
    if chosen is None:
        return {"said": f"refused: {too_much(best)}"}
    setting, point = chosen
    out = {"setting": setting.key, "expected": point.error, "bar": point.bar}
    finer = {k: run for k, run in enumerate(trial.pieces.ask(trial.audits(setting))) if isinstance(run, Run)}
    kept: dict[Setting, tuple[np.ndarray, float, float]] = {}  # errors, cost, share of marked frames
    for other in trial.settings[:trial.settings.index(setting) + 1]:
        run = trial.runs(other, trial.held)
        if isinstance(run, Run) and finer:
            errors = np.array([audit_error(run.curves[k], own.curves[0]) for k, own in finer.items()])
            kept[other] = (errors[~np.isnan(errors)], trial.cost(run),
                           float(np.concatenate([c.marked for c in run.curves]).mean()))
    if setting not in kept:
        held = trial.runs(setting, trial.held)
        return {**out, "said": f"refused on an object that is held out: {held}" if isinstance(held, str) else
                "the time was over before the audits"}
    errors, cost, marked = kept[setting]
    if not len(errors):
        return {**out, "said": "no touch that is held out met anything, of the audits that were made in time"}
    able = [c for e, c, m in kept.values() if len(e) and (e <= asked).mean() >= ENOUGH and m <= max(marked, MARKED)]
    within = float((errors <= asked).mean())
    return {**out, "audits": len(errors), "within": within, "worst": float(errors.max()), "marked": marked,
            "cost": cost, "regret": cost / min(able) if within >= ENOUGH else None, "said": ""}


def measure(scenes: Sequence[str] = (), *, accuracies: Sequence[float] = ACCURACIES, objects: int = 5, touches: int = 4,
            workers: int = 1, out: Path = Path("promise"), budget: float | None = None,
            progress: Progress = lambda said: None) -> Measurement:
    """The table of the scenes.

    Args:
        scenes: names or paths; empty for `SCENES`.
        accuracies: that are asked for [-].
        objects: that are held out.
        touches: of each of these.
        workers: processes.
        out: folder of what was made; a later run goes on with it.
        budget: begin nothing new after this time [s]; None for all.
        progress: called with what is going on.

    Raises:
        VsfsimError: there is no such scene, or the folder holds other runs.
    """
    until = time.perf_counter() + (math.inf if budget is None else budget)
    found = []
    for name in scenes or SCENES:
        loaded = load_scene(OWN.get(name) or find_scene(name))
        circumstances = {"scene": loaded.name, "scene_sha256": text_sha256(loaded.text), "version": vsfsim.__version__}
        progress(f"{loaded.name}: what it is")
        try:
            ground = touched(loaded, touches=1, objects=1, seed=0, device="cpu", cache=None).ground
        except VsfsimError as error:
            found.append({"scene": loaded.name, "said": f"refused: {error}"})
            continue
        with Pieces(out / f"{loaded.name}.jsonl", circumstances, workers=workers, until=until,
                    progress=progress) as pieces:
            names = classes(loaded)
            n, first = len(names), (OBJECTS if len(names) == 1 else 1)
            own = -(-objects // n)  # held out of each class
            trials = [Trial(loaded, ground, name, range(k, k + n * first, n),
                            range(k + n * first, k + n * (first + own), n), touches, pieces)
                      for k, name in enumerate(names)]
            found += [{"scene": loaded.name, **row} for row in rows(trials, accuracies)]
    return found_of(found, {"scenes": list(scenes), "accuracies": list(accuracies), "objects": objects,
                            "touches": touches})


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> Measurement:
    """The measurement of these rows."""
    columns = [Column("scene", "scene"), Column("class", "class"), Column("asked", "asked", "1", "%", "g"),
               Column("setting", "chosen"), Column("expected", "expected", "1", "%", ".2g"),
               Column("audits", "audits", "1", "", "d"), Column("within", "kept", "1", "%", ".0f"),
               Column("worst", "worst", "1", "%", ".2g"), Column("marked", "marked", "1", "%", ".0f"),
               Column("cost", "CPU s a touch", "1", "", ".2g"), Column("regret", "regret", "1", "", ".2f"),
               Column("said", "")]
    notes = []
    for asked in sorted({row["asked"] for row in rows if "asked" in row}, reverse=True):
        some = [row for row in rows if row.get("asked") == asked and "audits" in row]
        total, most = sum(row["audits"] for row in some), [row["regret"] for row in some if row["regret"] is not None]
        if total:
            kept = sum(round(row["within"] * row["audits"]) for row in some)
            notes.append(f"{100 * asked:g} %: {kept} of {total} audits within ({100 * kept / total:.0f} %)"
                         + (f"; largest regret {max(most):.2f}" if most else ""))
    return Measurement.of("promise", settings, [
        Table("Accuracies that were bought, on touches of other objects than the pilot's, against one level finer",
              columns, rows, name="promise")], notes=notes)
