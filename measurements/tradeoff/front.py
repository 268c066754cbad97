"""Points of cost and error: which are on the front, and what a goal costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measurements.tradeoff.touches import Curve, Run
from vsfsim.data.manifest import NOISE
from vsfsim.generate.trade.setting import Setting
from vsfsim.physics.convergence import Limit

GOALS = (0.1, 0.05, 0.02, 0.01, 0.005, 0.002)
"""Errors of the force of which the sentences say what they cost [-]."""
CHANNELS = {"force": "%", "direction": "deg", "torque": "%", "pressure": "%", "dense": "%", "stiffness": "%"}
"""Readings that are compared, and the unit that their errors are printed in."""
DISTINCT = 0.95
"""A dearer point is on the front if its error is this share of a cheaper one's at most [-]."""
IN_CONTACT = 0.05
"""Share of a reading's largest value from which a frame of another reading than the force counts [-]."""
SHALLOW = 1.0 / 3.0
"""Share of the full depth up to which a frame is shallow [-]."""
READINGS = 36_000
"""Of the dataset whose cost is told: frames of all its touches."""


@dataclass(frozen=True)
class Point:
    """What one setting costs and misses."""

    key: str
    """The setting in words."""
    tier: str
    """Its tier."""
    cpu: float
    """CPU time of a touch, without what is made once an object [s]."""
    reading: float
    """CPU time of a frame of a dataset of the scene, with its part of what is made once an object [s]."""
    once: float
    """CPU time of meshes and factors, once an object [s]."""
    marked: float
    """Share of the frames in contact that did not converge or are not resolved by the mesh [-]."""
    error: float
    """Of the force: the largest error of any frame above `NOISE`, over the force there [-]. NaN if a frame is lost."""
    bar: float
    """The error of the limits themselves, likewise [-]."""
    channels: Mapping[str, Mapping[str, float]]
    """Of each reading what `distance` measures, the largest of all touches."""
    shows: bool = True
    """Whether its tier shows what the scene needs."""
    own: bool = False
    """What the scene itself says."""
    front: bool = False
    """On the front: no point is cheaper and as exact."""


def distance(name: str, curve: Curve, share: np.ndarray, limit: Limit) -> dict[str, float] | None:
    """How far the reading called ``name`` is from its limit, at the depths ``share`` (T,) of the limit.

    Between the frames of the curve readings are interpolated, since that is all that a coarse curve tells. None if a
    frame is lost, which did not converge, or the reading is not there.

    Returns:
        ``rms``, the root mean square over the way in, over the largest value of the limit; ``worst``, ``shallow`` and
        ``full``, the largest error over the limit's value in the same frame, of all frames that count (of a force those
        above `NOISE`), of those of the first third of the depth (0 without one), and at full depth; ``bar``, as
        ``worst`` for what the limit may be off. All [-], of a direction [rad].
    """
    values = curve.readings.get(name)
    if values is None or not curve.converged.all():
        return None
    if name == "stiffness":
        found, wanted, error = values[None], limit.value[None], limit.error[None]
    else:
        at = np.append(0.0, curve.share)
        flat = np.concatenate([np.zeros((1, values[0].size)), values.reshape(len(values), -1)])
        found = np.stack([np.interp(share, at, column) for column in flat.T], axis=1)
        wanted, error = (v.reshape(len(share), -1) for v in (limit.value, limit.error))
    size = np.linalg.norm(wanted, axis=1)
    if not np.isfinite(found).all() or size.max(initial=0.0) == 0.0:
        return None
    on = size > (NOISE if name == "force" else IN_CONTACT * size.max())
    if not on.any():
        return None
    off, bar = np.linalg.norm(found - wanted, axis=1), np.linalg.norm(error, axis=1)
    rms = _rms(off) / size.max()
    off, bar = off[on] / size[on], bar[on] / size[on]
    if name == "direction":
        length = np.maximum(np.linalg.norm(found[on], axis=1), 1e-300)
        off = np.arccos(np.clip(np.einsum("ti,ti->t", found[on], wanted[on]) / length / size[on], -1.0, 1.0))
        rms = _rms(off)
    first = off[share[on] <= SHALLOW + 1e-6] if len(share) == len(on) else off[:0]
    return {"rms": rms, "worst": float(off.max()), "bar": float(bar.max()),
            "shallow": float(first.max(initial=0.0)), "full": float(off[-1])}


def point(setting: Setting, run: Run, limits: Sequence[Mapping[str, Limit]],
          shares: Sequence[np.ndarray], *, shows: bool, once: float = 0.0, own: bool = False) -> Point:
    """What a run costs and misses.

    Args:
        setting: of the run.
        run: all touches.
        limits: of each touch.
        shares: of each limit, its depths.
        shows: whether the tier shows what the scene needs.
        once: of what is made once for all objects of the run, the share that a reading of the scene has [-].
        own: whether the setting is the scene's.
    """
    found: dict[str, list[dict[str, float]]] = {}
    for curve, limit, share in zip(run.curves, limits, shares, strict=True):
        for name in CHANNELS:
            d = distance(name, curve, share, limit[name]) if name in limit and limit[name].known else None
            if d is not None:
                found.setdefault(name, []).append(d)
    channels = {name: {key: max(d[key] for d in all_touches) for key in all_touches[0]}
                for name, all_touches in found.items()}
    force, wanted = channels.get("force", {}), sum(limit["force"].known for limit in limits)
    error = force.get("worst", 0.0) if len(found.get("force", ())) == wanted else math.nan
    marked = np.concatenate([c.marked[(np.abs(np.nan_to_num(c.readings["force"])) > 0.0) | ~c.converged]
                             for c in run.curves])
    return Point(setting.key, setting.tier, run.cpu / len(run.curves), run.cpu / run.frames + once * run.once,
                 run.once, float(marked.mean()) if len(marked) else 0.0, error, force.get("bar", 0.0), channels, shows,
                 own)


def _rms(values: Sequence[float] | np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def with_front(points: Sequence[Point]) -> list[Point]:
    """The points with those on the front marked, cheapest first."""
    out, least = [], math.inf
    for p in sorted(points, key=lambda p: (p.cpu, p.error)):
        on = p.shows and p.error < DISTINCT * least
        least = p.error if on else least
        out.append(dataclasses.replace(p, front=on))
    return out


def sentence(goal: float, points: Sequence[Point], missing: int = 0) -> str:
    """What a goal [-] for every reading of the force costs on this scene; ``missing`` settings were not measured."""
    said = f"{100 * goal:g} %"
    known = [p for p in points if p.shows and math.isfinite(p.error)]
    able = [p for p in known if p.error + p.bar <= goal]
    if able:
        best = min(able, key=lambda p: p.cpu)
        marked = f", {100 * best.marked:.0f} % of the frames marked" if best.marked else ""
        return (f"{said}: {best.key}; {READINGS:,} readings cost {READINGS * best.reading / 3600:.2g} CPU hours (error "
                f"{100 * best.error:.2g} %, limit known to {100 * best.bar:.2g} %{marked})")
    if missing:
        return f"{said}: not measured; {len(points)} settings do not keep it, and {missing} more were not tried"
    bar = min((p.bar for p in points if math.isfinite(p.error)), default=math.nan)
    if bar > goal:
        return f"{said}: cannot be told on this scene, the limit itself is known to {100 * bar:.2g} % only"
    if not known:
        return f"{said}: not on this scene, no setting finds all equilibria"
    best = min(known, key=lambda p: p.error + p.bar)
    return (f"{said}: not on this scene, the most exact setting, {best.key}, is off by "
            f"{100 * best.error:.2g} % (limit known to {100 * best.bar:.2g} %)")


def cells(points: Sequence[Point]) -> tuple[list[str], list[list[str]]]:
    """The head of the table and its rows, one a point: with a star on the front, = for the scene's own setting, a cross
    where the tier does not show what the scene needs."""
    others = [name for name in CHANNELS if name != "force" and any(name in p.channels for p in points)]
    head = ["", "setting", "CPU s/touch", "once s", "marked %", "rms %", "worst %", "bar %", "shallow %", "full %",
            *(f"{name} {CHANNELS[name]}" for name in others)]
    rows = []
    for p in points:
        mark = "*" * p.front + "x" * (not p.shows) + "=" * p.own
        force = {**dict.fromkeys(("rms", "shallow", "full"), math.nan), **p.channels.get("force", {})}
        errors = [100.0 * v for v in (force["rms"], p.error, p.bar, force["shallow"], force["full"])]
        for name in others:
            unit = 180.0 / math.pi if CHANNELS[name] == "deg" else 100.0
            errors.append(unit * p.channels.get(name, {}).get("worst", math.nan))
        rows.append([mark, p.key, f"{p.cpu:.2f}", f"{p.once:.1f}", f"{100 * p.marked:.0f}",
                     *(("-" if math.isfinite(p.error) else "lost") if math.isnan(v) else f"{v:.3g}" for v in errors)])
    return head, rows
