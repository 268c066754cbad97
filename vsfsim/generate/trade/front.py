"""Points of cost and error: which are on the front, and what a goal costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.text_table import text_table
from vsfsim.generate.trade.curve import Curve, Distance, distance
from vsfsim.generate.trade.setting import Setting
from vsfsim.generate.trade.touches import Run
from vsfsim.physics.convergence import Limit

GOALS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
"""Errors of the force of which the sentences say what they cost [-]."""
CHANNELS = {"force": "%", "direction": "deg", "torque": "%", "pressure": "%", "dense": "%", "stiffness": "%"}
"""Readings that are compared, and the unit that their errors are printed in."""
DISTINCT = 0.95
"""A dearer point is on the front if its error is this share of a cheaper one's at most [-]."""


@dataclass(frozen=True)
class Point:
    """What one setting costs and misses."""

    key: str
    """The setting in words."""
    tier: str
    """Its tier."""
    cpu: float
    """CPU time of a touch, without what is made once an object [s]."""
    wall: float
    """The same on the clock [s]."""
    frame: float
    """CPU time of a frame [s]."""
    once: float
    """CPU time of meshes and factors, once an object [s]."""
    memory: float
    """Largest memory of the process [MiB]."""
    marked: float
    """Share of the frames in contact that did not converge or are not resolved by the mesh [-]."""
    error: float
    """Of the force: of the touch that is worst, root mean square over its way in, over its largest force [-]. NaN if a
    touch has no equilibrium at full depth."""
    bar: float
    """The error of the limits themselves, likewise [-]."""
    channels: Mapping[str, Mapping[str, float]]
    """Of each reading: rms, worst, shallow, full, bar, see `Distance`; rms, shallow and full are root mean squares over
    the touches, worst and bar the largest."""
    shows: bool = True
    """Whether its tier shows what the scene needs."""
    front: bool = False
    """On the front: no ranked point is cheaper and as exact."""
    off: float = math.nan
    """Of the touch that is worst, one whose limit does not count as known too: the root of the sum of squares of its
    error and of that of its limit, which know nothing of one another [-]. NaN as above."""

    @property
    def ranked(self) -> bool:
        """Whether its error can be told from that of the limit."""
        return self.error >= self.bar


def point(setting: Setting, run: Run, limits: Sequence[Mapping[str, Limit]], shares: Sequence[np.ndarray], *,
          shows: bool) -> Point:
    """What a run costs and misses.

    Args:
        setting: of the run.
        run: all touches.
        limits: of each touch.
        shares: of each limit, its depths.
        shows: whether the tier shows what the scene needs.
    """
    count = len(run.curves)
    found: dict[str, list[Distance]] = {}
    error, bar, off, lost = 0.0, 0.0, 0.0, False
    for curve, own, share in zip(run.curves, limits, shares, strict=True):
        for name in CHANNELS:
            if name not in own or not np.isfinite(own[name].error).all():
                continue
            d = distance(name, curve, share, own[name])
            if d is None:
                lost |= name == "force"
                continue
            if name == "force":
                off = max(off, math.hypot(d.rms, d.bar))
            if own[name].known:
                found.setdefault(name, []).append(d)
                if name == "force":
                    error, bar = max(error, d.rms), max(bar, d.bar)
    used = sum(own["force"].known for own in limits)
    if len(found.get("force", ())) < used:
        error = math.nan
    if lost:
        off = math.nan
    channels = {name: {"rms": _rms([d.rms for d in ds]), "worst": max(d.worst for d in ds),
                       "shallow": _rms([d.shallow for d in ds]), "full": _rms([d.full for d in ds]),
                       "bar": max(d.bar for d in ds)} for name, ds in found.items()}
    marked = np.concatenate([_in_contact(c) for c in run.curves])
    return Point(setting.key, setting.tier, run.cpu / count, run.wall / count, run.cpu / run.frames, run.once,
                 run.memory, float(marked.mean()) if len(marked) else 0.0, error, bar, channels, shows, off=off)


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _in_contact(curve: Curve) -> np.ndarray:
    force = np.abs(np.nan_to_num(curve.readings["force"]))
    return curve.marked[(force > 0.0) | ~curve.converged]


def with_front(points: Sequence[Point]) -> list[Point]:
    """The points with those on the front marked, cheapest first."""
    out, least = [], math.inf
    for p in sorted(points, key=lambda p: (p.cpu, p.error)):
        on = p.ranked and p.shows and p.error < DISTINCT * least
        least = p.error if on else least
        out.append(dataclasses.replace(p, front=on))
    return out


def sentence(goal: float, points: Sequence[Point]) -> str:
    """What a goal [-] for the error of the force costs on this scene."""
    said = f"{100 * goal:g} %"
    able = [p for p in points if p.shows and p.error + p.bar <= goal]
    if able:
        best = min(able, key=lambda p: p.cpu)
        marked = f", {100 * best.marked:.0f} % of the frames marked" if best.marked else ""
        return (f"{said}: {best.key}, {best.frame:.2g} s a frame (error {100 * best.error:.2g} %, limit known to "
                f"{100 * best.bar:.2g} %{marked})")
    bar = min((p.bar for p in points if math.isfinite(p.error)), default=math.nan)
    if bar > goal:
        return f"{said}: cannot be told on this scene, the limit itself is known to {100 * bar:.2g} % only"
    known = [p for p in points if p.shows and math.isfinite(p.error)]
    if not known:
        return f"{said}: not on this scene, no setting finds all equilibria"
    best = min(known, key=lambda p: p.error + p.bar)
    return (f"{said}: not on this scene, the most exact setting, {best.key}, is off by {100 * best.error:.2g} % "
            f"(limit known to {100 * best.bar:.2g} %)")


def text(points: Sequence[Point]) -> str:
    """The table."""
    head, rows = cells(points)
    return text_table(head, rows, right=True, left=2)


def cells(points: Sequence[Point]) -> tuple[list[str], list[list[str]]]:
    """The head of the table and its rows, one a point: with a star on the front, a wave under the bar, a cross where
    the tier does not show what the scene needs."""
    names = [name for name in CHANNELS if any(name in p.channels for p in points)]
    head = ["", "setting", "CPU s/touch", "clock s/touch", "once s", "MiB", "marked %", "error %", "bar %", "shallow %",
            "full %", "worst %", *(f"{name} {CHANNELS[name]}" for name in names if name != "force")]
    rows = []
    for p in points:
        mark = "*" if p.front else "x" if not p.shows else "" if p.ranked or math.isnan(p.error) else "~"
        force = p.channels.get("force", {})
        errors = [100.0 * p.error, 100.0 * p.bar,
                  *(100.0 * force.get(key, math.nan) for key in ("shallow", "full", "worst")),
                  *((180.0 / math.pi if CHANNELS[name] == "deg" else 100.0)
                    * p.channels.get(name, {}).get("rms", math.nan) for name in names if name != "force")]
        rows.append([mark, p.key, f"{p.cpu:.2f}", f"{p.wall:.2f}", f"{p.once:.1f}", f"{p.memory:.0f}",
                     f"{100 * p.marked:.0f}", *("-" if math.isnan(v) else f"{v:.3g}" for v in errors)])
    return head, rows
