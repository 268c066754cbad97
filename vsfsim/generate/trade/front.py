"""Points of cost and error: which are on the front, and what a goal costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.text_table import text_table
from vsfsim.generate.trade.setting import Setting
from vsfsim.generate.trade.touches import Curve, Run
from vsfsim.physics.convergence import Limit

GOALS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
"""Errors of the force of which the sentences say what they cost [-]."""
CHANNELS = {"force": "%", "direction": "deg", "torque": "%", "pressure": "%", "dense": "%", "stiffness": "%"}
"""Readings that are compared, and the unit that their errors are printed in."""
DISTINCT = 0.95
"""A dearer point is on the front if its error is this share of a cheaper one's at most [-]."""
SHALLOW = 0.05
"""Share of a reading's largest value from which a frame counts as in contact [-]."""


@dataclass(frozen=True)
class Point:
    """What one setting costs and misses."""

    key: str
    """The setting in words."""
    tier: str
    """Its tier."""
    cpu: float
    """CPU time of a touch, without what is made once an object [s]."""
    frame: float
    """CPU time of a frame [s]."""
    once: float
    """CPU time of meshes and factors, once an object [s]."""
    marked: float
    """Share of the frames in contact that did not converge or are not resolved by the mesh [-]."""
    error: float
    """Of the force: of the touch that is worst, root mean square over its way in, over its largest force [-]. NaN if a
    touch has no equilibrium at full depth."""
    bar: float
    """The error of the limits themselves, likewise [-]."""
    channels: Mapping[str, Mapping[str, float]]
    """Of each reading what `distance` measures: bar and worst the largest of all touches, the others root mean squares
    over them."""
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


def distance(name: str, curve: Curve, share: np.ndarray, limit: Limit) -> dict[str, float] | None:
    """How far the reading called ``name`` is from its limit, at the depths ``share`` (T,) of the limit.

    Between the frames of the curve readings are interpolated, since that is all that a coarse curve tells. Frames that
    did not converge tell nothing; None if that of full depth did not, or the reading is not there.

    Returns:
        ``rms`` and ``worst``, the root mean square and the largest over the way in, over the largest value of the
        limit; ``shallow`` and ``full``, in the first frame in contact and at full depth, over the limit there;
        ``bar``, what the limit may be off, as rms. All [-], of a direction [rad].
    """
    values = curve.readings.get(name)
    if values is None or not curve.converged[-1]:
        return None
    if name == "stiffness":
        found, wanted, error = values[None], limit.value[None], limit.error[None]
    else:
        good = np.flatnonzero(curve.converged)
        at = np.append(0.0, curve.share[good])
        flat = np.concatenate([np.zeros((1, values[0].size)), values[good].reshape(len(good), -1)])
        found = np.stack([np.interp(share, at, column) for column in flat.T], axis=1)
        wanted, error = (v.reshape(len(share), -1) for v in (limit.value, limit.error))
    size = np.linalg.norm(wanted, axis=1)
    if not np.isfinite(found).all() or size.max(initial=0.0) == 0.0:
        return None
    on = np.flatnonzero(size > SHALLOW * size.max())
    off, bar = np.linalg.norm(found - wanted, axis=1), np.linalg.norm(error, axis=1)
    if name == "direction":
        length = np.maximum(np.linalg.norm(found[on], axis=1), 1e-300)
        cosine = np.einsum("ti,ti->t", found[on], wanted[on]) / length / size[on]
        off, bar, size = np.arccos(np.clip(cosine, -1.0, 1.0)), bar[on] / size[on], np.ones(len(on))
        on = np.arange(len(on))
    top = size.max()
    return {"rms": _rms(off) / top, "worst": float(off.max() / top), "bar": _rms(bar) / top,
            "shallow": float(off[on[0]] / size[on[0]]), "full": float(off[-1] / size[-1])}


def point(setting: Setting, run: Run, limits: Sequence[Mapping[str, Limit]],
          shares: Sequence[np.ndarray], *, shows: bool) -> Point:
    """What a run costs and misses.

    Args:
        setting: of the run.
        run: all touches.
        limits: of each touch.
        shares: of each limit, its depths.
        shows: whether the tier shows what the scene needs.
    """
    found: dict[str, list[dict[str, float]]] = {}
    off = 0.0
    for curve, own, share in zip(run.curves, limits, shares, strict=True):
        for name in CHANNELS:
            if name not in own or not np.isfinite(own[name].error).all():
                continue
            d = distance(name, curve, share, own[name])
            if name == "force":
                off = math.nan if d is None or math.isnan(off) else max(off, math.hypot(d["rms"], d["bar"]))
            if d is not None and own[name].known:
                found.setdefault(name, []).append(d)
    channels = {name: {key: (max if key in ("worst", "bar") else _rms)([d[key] for d in all_touches])
                       for key in all_touches[0]} for name, all_touches in found.items()}
    force, wanted = found.get("force", []), sum(own["force"].known for own in limits)
    error = max((d["rms"] for d in force), default=0.0) if len(force) == wanted else math.nan
    marked = np.concatenate([_in_contact(c) for c in run.curves])
    return Point(setting.key, setting.tier, run.cpu / len(run.curves), run.cpu / run.frames,
                 run.once, float(marked.mean()) if len(marked) else 0.0, error,
                 max((d["bar"] for d in force), default=0.0), channels, shows, off=off)


def _rms(values: Sequence[float] | np.ndarray) -> float:
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
    known = [p for p in points if p.shows and math.isfinite(p.error)]
    able = [p for p in known if p.error + p.bar <= goal]
    if able:
        best = min(able, key=lambda p: p.cpu)
        marked = f", {100 * best.marked:.0f} % of the frames marked" if best.marked else ""
        return (f"{said}: {best.key}, {best.frame:.2g} s a frame (error {100 * best.error:.2g} %, "
                f"limit known to {100 * best.bar:.2g} %{marked})")
    bar = min((p.bar for p in points if math.isfinite(p.error)), default=math.nan)
    if bar > goal:
        return f"{said}: cannot be told on this scene, the limit itself is known to {100 * bar:.2g} % only"
    if not known:
        return f"{said}: not on this scene, no setting finds all equilibria"
    best = min(known, key=lambda p: p.error + p.bar)
    return (f"{said}: not on this scene, the most exact setting, {best.key}, is off by "
            f"{100 * best.error:.2g} % (limit known to {100 * best.bar:.2g} %)")


def text(points: Sequence[Point]) -> str:
    """The table."""
    return text_table(*cells(points), right=True, left=2)


def cells(points: Sequence[Point]) -> tuple[list[str], list[list[str]]]:
    """The head of the table and its rows, one a point: with a star on the front, a wave under the bar, a cross where
    the tier does not show what the scene needs."""
    others = [name for name in CHANNELS if name != "force" and any(name in p.channels for p in points)]
    head = ["", "setting", "CPU s/touch", "once s", "marked %", "error %", "bar %", "shallow %",
            "full %", *(f"{name} {CHANNELS[name]}" for name in others)]
    rows = []
    for p in points:
        mark = "*" if p.front else "x" if not p.shows else "" if p.ranked or math.isnan(p.error) else "~"
        force = p.channels.get("force", {})
        errors = [100.0 * v for v in (p.error, p.bar, force.get("shallow", math.nan), force.get("full", math.nan))]
        for name in others:
            unit = 180.0 / math.pi if CHANNELS[name] == "deg" else 100.0
            errors.append(unit * p.channels.get(name, {}).get("rms", math.nan))
        rows.append([mark, p.key, f"{p.cpu:.2f}", f"{p.once:.1f}", f"{100 * p.marked:.0f}",
                     *("-" if math.isnan(v) else f"{v:.3g}" for v in errors)])
    return head, rows
