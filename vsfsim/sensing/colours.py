"""How numbers become colours, and the bar beside a picture that says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

_GREY = 0.82  # of a surface without contact
_NOTHING = 0.01  # of the highest value: what is less is drawn as none
_LINE = 0.85  # of the lines between elements


@dataclass(frozen=True)
class Colours:
    """How numbers become colours."""

    name: str
    """Colour map of matplotlib."""
    low: float
    """Value of its lower end, in the unit of the label; below zero, the map's middle is zero."""
    high: float
    """Value of its upper end, in the unit of the label."""
    label: str = ""
    """Label of the colour bar with its unit; empty for no bar."""
    grey_zero: bool = False
    """Draw values under a hundredth of the highest in light grey."""
    log: bool = False
    """Whether equal ratios are equal steps of colour; the values are then in pascals."""

    def scale(self) -> Any:
        """The `matplotlib.cm.ScalarMappable`. Colours of a map with a middle are equally far from it on both sides."""
        import matplotlib  # only where something is drawn: it takes half a second

        high = max(self.high, 1e-12)
        most = max(high, -self.low)
        norm = (matplotlib.colors.LogNorm(self.low, high) if self.log
                else matplotlib.colors.Normalize(-most if self.low < 0.0 else self.low, most))
        return matplotlib.cm.ScalarMappable(norm, self.name)

    def rgb(self, values: np.ndarray) -> np.ndarray:
        """sRGB from 0 to 1 (f, 3) of values (f,); NaN is a line."""
        colour = self.scale().to_rgba(values)[:, :3]
        if self.grey_zero:
            colour[values <= _NOTHING * self.high] = _GREY
        colour[np.isnan(values)] = _LINE
        return colour

    def bar(self, figure: Any, axes: Any | Sequence[Any], **options: Any) -> None:
        """Draw the bar beside axes, from the lowest to the highest value, with ticks."""
        from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullLocator

        drawn = figure.colorbar(self.scale(), ax=axes, **options)
        drawn.set_label(self.label, fontsize=9, labelpad=8)
        drawn.ax.set_ylim(self.low, max(self.high, 1e-12))
        along = drawn.ax.yaxis
        along.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)) if self.log else MaxNLocator(6))
        along.set_minor_locator(NullLocator())
        if self.log:
            along.set_major_formatter(EngFormatter("Pa"))


def of_modulus(modulus: np.ndarray) -> Colours:
    """From the smallest to the largest of Young's moduli [Pa]; a body of one modulus gets an octave."""
    low, high = float(modulus.min()), float(modulus.max())
    room = 1.0 if high > 1.5 * low else 2.0
    return Colours("viridis", low / room, high * room, "Young's modulus, mean of each element", log=True)
