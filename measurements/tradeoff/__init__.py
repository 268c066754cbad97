"""`vsfsim lab tradeoff SCENE`: the limit of some touches, then setting after setting, kept as they come; the picture of
error against time on logarithmic axes with a line a tier."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

import vsfsim
from measurements.kept import Kept
from measurements.tradeoff import front
from measurements.tradeoff.front import Point
from measurements.tradeoff.touches import DatasetTouches, Run, is_known, limits, sweep, unsure
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import SceneFile
from vsfsim.core.system.interactive import new_figure
from vsfsim.core.text_table import text_table
from vsfsim.data.provenance import commit, machine_kind
from vsfsim.data.recipe import text_sha256
from vsfsim.generate.trade.setting import Setting
from vsfsim.generate.workers import in_pool
from vsfsim.physics import tiers
from vsfsim.physics.convergence import Limit

LINES = "points.jsonl"
COLOURS = {"linear": "#e69f00", "fem-coarse": "#0072b2", "fem": "#009e73", "fem-fine": "#d55e00"}
"""Of the tiers (Okabe and Ito 2008, which people with colour blindness tell apart)."""
DOTS = 200  # per inch
_SIZE = re.compile(r"[\w-]+, [\d.]+ mm")
"""Keys of settings that say a tier and the size of its elements alone, see `Setting.key`; a line joins these."""


@dataclass(frozen=True)
class Tradeoff:
    """What a sweep found."""

    scene: str
    """Name."""
    what: str
    """The touches in words."""
    points: tuple[Point, ...]
    """Cheapest first."""
    limit: tuple[str, ...]
    """One sentence a touch: its order and what is known of its limit."""
    refused: Mapping[str, str]
    """Settings that could not be made, with the reason."""
    machine: str
    """Kind of machine."""

    def sentences(self) -> list[str]:
        """One a goal, and what the scene's own setting does to the order of methods."""
        return [*(front.sentence(goal, self.points, len(self.refused)) for goal in front.GOALS),
                *(front.ranking(p) for p in self.points if p.own and p.flips)]

    def text(self) -> str:
        """For the terminal."""
        return "\n".join([f"{self.scene}: {self.what}", *self.limit, "",
                          text_table(*front.cells(self.points), right=True, left=2),
                          "* on the front   = the scene's own setting   x tier does not show the scene's needs", "",
                          *self.sentences(),
                          *(f"note: {key}: {why}" for key, why in self.refused.items())])

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return {**dataclasses.asdict(self), "commit": commit(), "sentences": self.sentences()}


def tradeoff(loaded: SceneFile, out: Path, *, touches: int = 4, objects: int = 1, seed: int = 0,
             device: str = "cpu", workers: int = 1, tiers_only: tuple[str, ...] = (),
             progress: Callable[[int, int, str], None] = lambda done, total, what: None) -> Tradeoff:
    """Measure what settings cost and miss on a scene, and write lines into a folder.

    Args:
        loaded: the scene, with ``[touches]``.
        out: folder; what an earlier run of the same command has there is not made again.
        touches: of each object.
        objects: the first so many of the scene's.
        seed: as of `vsfsim generate`.
        device: Warp device.
        workers: processes that make the limits, whose cost does not count.
        tiers_only: only these tiers; empty for all.
        progress: called with (done, in all, what).

    Raises:
        VsfsimError: no [touches] on a solid, a tier that they do not have, a folder of another run, or no touch whose
            limit is known.
    """
    lines = Kept(out / LINES, {"format": "vsfsim-tradeoff", "scene": loaded.name,
                                 "scene_sha256": text_sha256(loaded.text), "seed": seed,
                                 "touches": touches, "objects": objects, "device": device,
                                 "version": vsfsim.__version__, "commit": commit()})
    subject = DatasetTouches(loaded, touches=touches, objects=objects, seed=seed, device=device)
    everything = sweep(subject)
    chosen = [s for s in everything if not tiers_only or s.tier in tiers_only]
    if not chosen:
        raise VsfsimError(f"{loaded.path}: none of the tiers {', '.join(tiers_only)} can be "
                          f"touched here; there are {', '.join(subject.pressable)}.")
    total, bounds, shares = subject.count + len(chosen), [], []
    keys = [f"limit of touch {k}" for k in range(subject.count)]
    left = [k for k, key in enumerate(keys) if key not in lines.rows]
    for k, found in in_pool(ladder_of, left, loaded, touches, seed, device, device=device, workers=workers):
        lines.add({"key": keys[k], "ladder": found})
        progress(len(lines.rows), total, keys[k])
    for key in keys:
        bound, share = limits([Run.read(mesh) for mesh in lines.rows[key]["ladder"]])
        bounds.append(bound)
        shares.append(share)
    said = tuple(_said(k, own["force"]) for k, own in enumerate(bounds))
    if not any(is_known(own["force"]) for own in bounds):
        raise VsfsimError(f"{loaded.path}: the limit of no touch is known: {'; '.join(said)}. Give "
                          "more --touches, or a finer resolution in [object], from which the "
                          "meshes of the limit start.")
    points, refused = [], {s.key: f"left out by --tier {' '.join(tiers_only)}" for s in everything if s not in chosen}
    for number, setting in enumerate(chosen):
        row = lines.made(setting.key, lambda s=setting: _made(subject, s))  # type: ignore[misc]
        if "refused" in row:
            refused[setting.key] = row["refused"]
        else:
            points.append(front.point(setting, Run.read(row["run"]), bounds, shares,
                                      shows=_shows(loaded, setting.tier), once=1.0 / objects / subject.readings,
                                      own=setting == subject.own))
        progress(subject.count + number + 1, total, setting.key)
    if not points:
        raise VsfsimError(f"{loaded.path}: no setting of the sweep can be made. "
                          + " ".join(f"{key}: {why}" for key, why in refused.items()))
    return Tradeoff(loaded.name, subject.what, tuple(front.with_front(points)), said, refused, machine_kind())


def ladder_of(number: int, loaded: SceneFile, touches: int, seed: int, device: str) -> list[dict[str, Any]]:
    """In a process of its own: a touch, of so many of each object, on the meshes of its limit."""
    subject = DatasetTouches(loaded, touches=touches, first=number // touches, seed=seed, device=device)
    return [subject.near(number % touches, setting).table() for setting in subject.ground.ladder()]


def _made(subject: DatasetTouches, setting: Setting) -> dict[str, Any]:
    try:
        return {"run": subject.run(setting).table()}
    except VsfsimError as error:
        return {"refused": str(error)}


def _shows(loaded: SceneFile, tier: str) -> bool:
    """Whether the tier shows what the scene needs."""
    try:
        tiers.choose(loaded.sample(0), tier)
    except VsfsimError:
        return False
    return True


def _said(touch: int, force: Limit) -> str:
    """What is known of the limit of a touch."""
    if not is_known(force):
        size = f", known to {100 * unsure(force):.2g} % only" if np.isfinite(unsure(force)) else ""
        return f"touch {touch}: not used, {force.why}{size}"
    order = "" if force.order is None else f", order {force.order:.1f}"
    return (f"touch {touch}: {force.why}{order}; largest force "
            f"{float(np.abs(force.value).max()):.4g} N, known to {100 * unsure(force):.2g} %")


def draw(points: Sequence[Point], title: str) -> Any:
    """The figure: CPU time of a touch against the error of the force; points without an error have no place."""
    figure = new_figure(figsize=(7.0, 4.0), dpi=DOTS, layout="tight")
    axes = figure.subplots()
    shown = sorted((p for p in points if math.isfinite(p.error) and p.error > 0.0 and p.cpu > 0.0),
                   key=lambda p: p.cpu)

    def at(some: Sequence[Point]) -> tuple[list[float], list[float]]:
        return [p.cpu for p in some], [100.0 * p.error for p in some]

    for tier in dict.fromkeys(p.tier for p in shown):
        own, colour = [p for p in shown if p.tier == tier], COLOURS[tier]
        axes.plot(*at([p for p in own if _SIZE.fullmatch(p.key)]), color=colour, linewidth=1.2)
        axes.errorbar(*at(own), yerr=[100.0 * p.bar for p in own], fmt="o", markersize=5, color=colour, elinewidth=0.6,
                      label=tier)
    axes.scatter(*at([p for p in shown if p.front]), s=110, facecolor="none", edgecolor="black",
                 zorder=4, label="on the front")
    axes.set(xscale="log", yscale="log", xlabel="CPU time of a touch [s]",
             ylabel="largest error of a reading of the force [%]", title=title)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", color="0.88")
    axes.legend(fontsize=8, loc="best", framealpha=1.0)
    return figure
