"""From the flat sheet to the inflated dome, by continuation in the volume, which passes limit points of the pressure.

A rubber membrane has a largest pressure: beyond its *limit point* a larger volume needs less pressure, and under a
prescribed pressure the membrane would grow without bound. The working state of a sensor is on the branch from the flat
state, before that point.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from vsfsim.core.errors import SceneError
from vsfsim.physics.bubble.sheet import Balanced, Sheet

_GROWTH, _MOST_TIMES = 1.4, 1e4  # ratio of the volumes of two steps, and of the last and the first one
_LEAST = 1e-3  # smallest growth of the volume in a step
_OFF = 1e-6  # of the pressure; a volume that is known to 1e-14 leaves far less


def inflate(sheet: Sheet, guess: np.ndarray, pressure: float, *, where: str) -> Balanced:
    """The equilibrium at a gauge pressure, on the branch from the flat state.

    Args:
        sheet: the sheet, flat and clamped at u = 0.
        guess: a shallow dome (3 n,) [m].
        pressure: gauge pressure [Pa].
        where: scene and section, for messages.

    Raises:
        SceneError: the pressure is beyond the limit point, or the branch could not be followed.
    """
    low, high = _bracket(sheet, guess, pressure, where)
    return _between(sheet, low, high, pressure, where)


def _bracket(sheet: Sheet, guess: np.ndarray, pressure: float, where: str) -> tuple[Balanced, Balanced]:
    """Two states on the rising branch with the pressure between them."""
    volume = sheet.volume(guess)
    first, shrink = sheet.at_volume(guess, pressure, volume), 0
    while first is None or first.pressure > pressure:
        # a flatter dome has less pressure: near the plane it grows with the volume or faster
        share = 0.5 if first is None else max(0.05, min(0.7, pressure / first.pressure))
        volume, guess = share * volume, share * (guess if first is None else first.displacement)
        first, shrink = sheet.at_volume(guess, pressure, volume), shrink + 1
        if shrink > 60:
            raise SceneError(f"{where}: the membrane could not be inflated from flat to a gauge pressure of "
                             f"{pressure:g} Pa; check young_modulus, thickness and pre_stretch.")
    states = [first]
    growth = _GROWTH
    while states[-1].pressure < pressure:
        now = states[-1]
        volume = growth * now.volume
        if volume > _MOST_TIMES * first.volume:
            break
        found = sheet.at_volume(*_ahead(states, volume), volume)
        if found is None:
            growth = 1.0 + 0.5 * (growth - 1.0)
            if growth < 1.0 + _LEAST:
                break
            continue
        states.append(found)
        growth = min(_GROWTH, 1.0 + 1.5 * (growth - 1.0))
        if found.pressure < now.pressure:
            top = _top(sheet, states[-3:] if len(states) > 2 else states)
            if top.pressure < pressure:
                raise SceneError(
                    f"{where}: gauge_pressure is {pressure:g} Pa, but the membrane's limit point is at "
                    f"{top.pressure:.5g} Pa (volume {1e6 * top.volume:.4g} mL, height "
                    f"{1e3 * float(np.abs(top.displacement).max()):.3g} mm): beyond it a rubber membrane blows up "
                    f"without bound. Give less pressure, or a larger young_modulus or thickness.")
            return now if now.pressure <= pressure else states[-3], top
    if states[-1].pressure < pressure:
        raise SceneError(f"{where}: gauge_pressure is {pressure:g} Pa, but the membrane could be followed to "
                         f"{states[-1].pressure:.5g} Pa only (volume "
                         f"{1e6 * states[-1].volume:.4g} mL). Give less pressure, or a larger young_modulus "
                         f"or thickness.")
    return states[-2], states[-1]


def _ahead(states: list[Balanced], volume: float) -> tuple[np.ndarray, float]:
    """Displacement and pressure extrapolated from the last two states."""
    now = states[-1]
    if len(states) == 1:
        return now.displacement * volume / now.volume, now.pressure * volume / now.volume
    before = states[-2]
    share = (volume - now.volume) / (now.volume - before.volume)
    return (now.displacement + share * (now.displacement - before.displacement),
            now.pressure + share * (now.pressure - before.pressure))


def _top(sheet: Sheet, around: list[Balanced]) -> Balanced:
    """The state of highest pressure between the first and the last of these."""
    known = list(around)

    def fall(volume: float) -> float:
        near = min(known, key=lambda s: abs(s.volume - volume))
        found = sheet.at_volume(near.displacement, near.pressure, volume)
        if found is not None:
            known.append(found)
        return 0.0 if found is None else -found.pressure

    minimize_scalar(fall, bounds=(around[0].volume, around[-1].volume), method="bounded",
                    options={"xatol": 1e-4 * around[-1].volume, "maxiter": 24})
    return max(known, key=lambda s: s.pressure)


def _between(sheet: Sheet, low: Balanced, high: Balanced, pressure: float, where: str) -> Balanced:
    """By the volume, which is known to all its digits."""
    known = [low, high]
    lost = SceneError(f"{where}: the membrane could not be brought to a gauge pressure of {pressure:g} Pa; check "
                      f"young_modulus, thickness and pre_stretch.")

    def over(volume: float) -> float:
        if volume in (low.volume, high.volume):
            return known[volume == high.volume].pressure - pressure
        found = sheet.at_volume(*_ahead([low, high], volume), volume)
        if found is None:
            raise lost
        known.append(found)
        return found.pressure - pressure

    brentq(over, low.volume, high.volume, xtol=1e-14 * high.volume, maxiter=200)
    best = min(known, key=lambda s: abs(s.pressure - pressure))
    if abs(best.pressure - pressure) > _OFF * abs(pressure):  # the states jump to others between two volumes
        raise lost
    return best
