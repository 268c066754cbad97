"""Styles of shoe, and the allowed range of every parameter. A new shoe is a new table of
`tables/shoe_styles.toml`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from vsfsim.core.table import between, shipped_rows, typed, value

REGIONS = ("sole", "toe_cap", "upper", "tongue", "heel_counter")


@dataclass(frozen=True)
class ShoeForm:
    """The form of a shoe."""

    length: float
    """Length of the upper from heel to toe [m]."""
    width: float
    """Width at the ball of the foot [m]."""
    heel_width: float
    """Width at the heel [m]."""
    collar_height: float
    """Height of the top line at the ankle above the ground [m]."""
    throat_height: float
    """Height of the top line above the ground where the tongue begins [m]."""
    toe_height: float
    """Height of the toe box above the ground [m]."""
    sole_heel: float
    """Thickness of the sole under the heel [m]."""
    sole_fore: float
    """Thickness of the sole under the ball [m]."""
    wall: float
    """Thickness of upper, toe cap, tongue and heel counter [m]."""
    opening: float
    """End of the collar's opening, as a fraction of the length from the heel."""
    toe_spring: float
    """Height of the toe's underside above the ground [m]."""
    arch: float
    """Height of the waist's underside above the ground [m]."""
    flare: float
    """Projection of the sole beyond the upper [m]."""
    bend: float
    """Sideways deviation of the centre line [m]."""


RANGES: dict[str, tuple[float, float]] = {
    "length": (0.22, 0.30), "width": (0.080, 0.115), "heel_width": (0.060, 0.085),
    "collar_height": (0.050, 0.120), "throat_height": (0.075, 0.130), "toe_height": (0.048, 0.070),
    "sole_heel": (0.012, 0.030), "sole_fore": (0.012, 0.025), "wall": (0.002, 0.009),
    "opening": (0.36, 0.52), "toe_spring": (0.0, 0.015), "arch": (0.0, 0.006),
    "flare": (0.0, 0.005), "bend": (0.0, 0.010),
}


@dataclass(frozen=True)
class Style:
    """A kind of shoe."""

    form: ShoeForm
    """The usual form."""
    materials: Mapping[str, tuple[str, ...]]
    """Material classes that each region may be made of."""


STYLES: dict[str, Style] = shipped_rows(__file__, "tables/shoe_styles.toml", Style)


@dataclass(frozen=True)
class ShoeOptions:
    """The parameters of a shoe besides its form."""

    style: Literal["sneaker", "boot", "runner", "slipper"] = "sneaker"
    """Key of `STYLES`."""
    side: Literal["left", "right"] = "right"
    """"left" or "right"."""
    variation: Annotated[float, between(0.0, 0.3)] = 0.05
    """Largest relative deviation from the style's form, for values that the scene does not give [-]."""
    appearance_informative: Annotated[float, between(0.0, 1.0)] = 0.8
    """Probability that a region has the appearance of its own material [-]."""
    materials: Literal["style", "any"] = "style"
    """With "style", the style's own materials, which colour and texture indicate. With "any", most parts except the
    sole are of one class of `_materials.TEXTURED` in a random colour, so that only the texture indicates the
    material."""


def read_parameters(parameters: Mapping[str, Any], rng: np.random.Generator,
                    where: str) -> tuple[ShoeForm, ShoeOptions]:
    """Check the scene's parameters, and draw those that the scene does not give.

    Raises:
        SceneError: an unknown parameter, style or side, or a number out of its range.
    """
    options, form = typed(parameters, ShoeOptions, where, also=tuple(RANGES)), {}
    usual = STYLES[options.style].form
    for name, (low, high) in RANGES.items():
        # Every factor is drawn, needed or not, so that fixing one parameter does not change the others.
        factor = 1.0 + options.variation * rng.uniform(-1.0, 1.0)
        drawn = float(np.clip(getattr(usual, name) * factor, low, high))
        asked = Annotated[float, between(low, high, "(lengths in metres)")]
        form[name] = value(parameters.get(name, drawn), asked, f"{where}: {name}")
    return ShoeForm(**form), options
