"""From the flat sheet to the inflated dome, by continuation in the volume, which passes limit points of the pressure.

A rubber membrane has a largest pressure: beyond its *limit point* a larger volume needs less pressure, and under a
prescribed pressure the membrane would grow without bound. The working state of a sensor is on the branch from the flat
state, before that point.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from vsfsim.core.errors import SceneError
from vsfsim.physics.bubble.sheet import Balanced, Sheet

_GROWTH, _MOST_TIMES = 1.4, 1e4  # ratio of the volumes of two steps, and of the last and the first one
_LEAST = 1e-3  # smallest growth of the volume in a step


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
    first = _shallow(sheet, guess, pressure, where)
    states, growth, limited = [first], _GROWTH, False
    while (states[-1].pressure < pressure and not limited and growth > 1.0 + _LEAST
           and states[-1].volume < _MOST_TIMES * first.volume):
        volume = growth * states[-1].volume
        found = sheet.at_volume(*_ahead(states, volume), volume)
        if found is None:
            growth = 1.0 + 0.5 * (growth - 1.0)
            continue
        growth = min(_GROWTH, 1.0 + 1.5 * (growth - 1.0))
        limited = found.pressure < states[-1].pressure
        states.append(_top(sheet, [*states[-2:], found]) if limited else found)
    last = states[-1]
    if last.pressure < pressure:
        reach, why = ("'s limit point is at", ": beyond it a rubber membrane blows up without bound") if limited else (
            " could be followed only to", "")
        raise SceneError(f"{where}: gauge_pressure is {pressure:g} Pa, but the membrane{reach} {last.pressure:.5g} Pa "
                         f"(volume {1e6 * last.volume:.4g} mL, height "
                         f"{1e3 * float(np.abs(last.displacement).max()):.3g} mm){why}. Give less pressure, or a "
                         f"larger young_modulus or thickness.")
    lower = [first, *(state for state in states if state.volume < last.volume)][-1]
    return _between(sheet, lower, last, pressure, where)


def _shallow(sheet: Sheet, guess: np.ndarray, pressure: float, where: str) -> Balanced:
    """A state below the pressure, near the plane: there the pressure grows with the volume or faster."""
    volume = sheet.volume(guess)
    for _ in range(60):
        found = sheet.at_volume(guess, pressure, volume)
        if found is not None and found.pressure <= pressure:
            return found
        share = 0.5 if found is None else max(0.05, min(0.7, pressure / found.pressure))
        volume, guess = share * volume, share * (guess if found is None else found.displacement)
    raise SceneError(f"{where}: the membrane could not be inflated from flat to a gauge pressure of {pressure:g} Pa; "
                     f"check young_modulus, thickness and pre_stretch.")


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
    """The state at the pressure, which is between those of two states of the rising branch."""
    if low is high:
        return high
    for _ in range(50):
        share = (pressure - low.pressure) / (high.pressure - low.pressure)
        found = sheet.at_pressure(low.displacement + share * (high.displacement - low.displacement), pressure)
        if found is not None and (1.0 - 1e-9) * low.volume <= found.volume <= (1.0 + 1e-9) * high.volume:
            return found
        volume = 0.5 * (low.volume + high.volume)
        middle = sheet.at_volume(*_ahead([low, high], volume), volume)
        if middle is None:
            break
        low, high = (middle, high) if middle.pressure < pressure else (low, middle)
    raise SceneError(f"{where}: the membrane could not be brought to a gauge pressure of {pressure:g} Pa; check "
                     f"young_modulus, thickness and pre_stretch.")
