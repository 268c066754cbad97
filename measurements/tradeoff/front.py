"""Points of cost and error: which are on the front, and what a goal costs."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from measurements.tradeoff.touches import Curve, Run, is_known
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
METHODS = 0.3 * (1.0 + 0.01 * np.arange(10.0))
"""Errors, over that of predicting zero, of the ten methods whose order is looked at: within a tenth, and about those of
the best methods on the board of shoes after five touches [-]."""
OBJECTS, ASKED, DRAWS = 12, 4, 1000
"""Objects of that board, touches of each that it asks, and boards that are drawn."""


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
    flips: Mapping[str, float] = dataclasses.field(default_factory=dict)
    """What `flips` finds, of the touches whose limit is known; empty if a frame is lost."""
    front: bool = False
    """On the front: no point is cheaper and as exact."""


def between(curve: Curve, values: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Readings (T, k) at other depths ``share`` (T,) than those of a curve, from its ``values`` (t, ...)."""
    flat = np.concatenate([np.zeros((1, values[0].size)), values.reshape(len(values), -1)])
    return np.stack([np.interp(share, np.append(0.0, curve.share), column) for column in flat.T], axis=1)


def flips(read: Sequence[np.ndarray], exact: Sequence[np.ndarray], *, seed: int = 0) -> dict[str, float]:
    """Share of the pairs of methods that a board of readings puts in another order than one of their limits.

    A method knows the true forces of each object but for one factor, as if all its moduli were off by it. The factors
    are normal about 1, and scaled so that on the limits the methods have exactly the errors `METHODS`, by the metric of
    the boards, `rmse_ratio`. A board has `OBJECTS` of `ASKED` touches each, drawn from those that are given after these
    were drawn with replacement themselves.

    Args:
        read, exact: forces (T,) of each touch, and their limits [N].
        seed: of the draws.

    Returns:
        ``mean`` of `DRAWS` boards, and the bounds ``low`` and ``high`` of 95 % of them [-].
    """
    sums = np.array([[np.mean(v) for v in (f**2, f * (f - r), (f - r) ** 2, r**2)]
                     for r, f in zip(read, exact, strict=True)])
    rng, count = np.random.default_rng(seed), len(sums)
    some = rng.integers(count, size=(DRAWS, count))
    at = np.take_along_axis(some, rng.integers(count, size=(DRAWS, OBJECTS * ASKED)), axis=1)
    square, cross, off, zero = np.moveaxis(sums[at].reshape(DRAWS, 1, OBJECTS, ASKED, 4), -1, 0)
    factor = rng.standard_normal((DRAWS, len(METHODS), OBJECTS, 1))
    factor *= METHODS[:, None, None] / np.abs(factor).mean(axis=2, keepdims=True)
    error = np.sqrt(np.maximum(factor**2 * square + 2.0 * factor * cross + off, 0.0)).sum(axis=3)
    error = (error / np.sqrt(zero).sum(axis=3)).mean(axis=2)
    better, worse = np.triu_indices(len(METHODS), 1)
    share = (error[:, better] > error[:, worse]).mean(axis=1)
    return {"mean": float(share.mean()), **dict(zip(("low", "high"), np.percentile(share, [2.5, 97.5]).tolist()))}


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
        found = between(curve, values, share)
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
            d = distance(name, curve, share, limit[name]) if name in limit and is_known(limit[name]) else None
            if d is not None:
                found.setdefault(name, []).append(d)
    channels = {name: {key: max(d[key] for d in all_touches) for key in all_touches[0]}
                for name, all_touches in found.items()}
    force, sure = channels.get("force", {}), [k for k, limit in enumerate(limits) if is_known(limit["force"])]
    whole = len(found.get("force", ())) == len(sure)
    order = flips([between(run.curves[k], run.curves[k].readings["force"], shares[k])[:, 0] for k in sure],
                  [limits[k]["force"].value for k in sure]) if whole else {}
    marked = np.concatenate([c.marked[(np.abs(np.nan_to_num(c.readings["force"])) > 0.0) | ~c.converged]
                             for c in run.curves])
    return Point(setting.key, setting.tier, run.cpu / len(run.curves), run.cpu / run.frames + once * run.once,
                 run.once, float(marked.mean()) if len(marked) else 0.0,
                 force.get("worst", 0.0) if whole else math.nan, force.get("bar", 0.0), channels, shows, own, order)


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


def ranking(p: Point) -> str:
    """Whether the readings of a point keep the order of methods."""
    mean, low, high = (p.flips[key] for key in ("mean", "low", "high"))
    return (f"ten methods 1 % apart: readings of {p.key} put {100 * mean:.0f} % of the pairs in another order than the "
            f"limit (95 % of boards: {100 * low:.0f} to {100 * high:.0f} %, Kendall's tau {1 - 2 * high:.2f} to "
            f"{1 - 2 * low:.2f})")


def cells(points: Sequence[Point]) -> tuple[list[str], list[list[str]]]:
    """The head of the table and its rows, one a point: with a star on the front, = for the scene's own setting, a cross
    where the tier does not show what the scene needs."""
    others = [name for name in CHANNELS if name != "force" and any(name in p.channels for p in points)]
    head = ["", "setting", "CPU s/touch", "once s", "marked %", "rms %", "worst %", "bar %", "shallow %", "full %",
            "flips %", *(f"{name} {CHANNELS[name]}" for name in others)]
    rows = []
    for p in points:
        mark = "*" * p.front + "x" * (not p.shows) + "=" * p.own
        force = {**dict.fromkeys(("rms", "shallow", "full"), math.nan), **p.channels.get("force", {})}
        errors = [100.0 * v for v in (force["rms"], p.error, p.bar, force["shallow"], force["full"])]
        errors.append(100.0 * p.flips.get("mean", math.nan))
        for name in others:
            unit = 180.0 / math.pi if CHANNELS[name] == "deg" else 100.0
            errors.append(unit * p.channels.get(name, {}).get("worst", math.nan))
        rows.append([mark, p.key, f"{p.cpu:.2f}", f"{p.once:.1f}", f"{100 * p.marked:.0f}",
                     *(("-" if math.isfinite(p.error) else "lost") if math.isnan(v) else f"{v:.3g}" for v in errors)])
    return head, rows
