"""The picture of a trade-off, error against time on logarithmic axes with a line a tier, and the page that has it with
every figure."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

from jinja2 import Environment
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from vsfsim.core.system.interactive import new_figure
from vsfsim.generate.trade.front import Point, cells

COLOURS = {"vsf": "#7f7f7f", "linear": "#e69f00", "fem-coarse": "#0072b2", "fem": "#009e73", "fem-fine": "#d55e00"}
"""Of the tiers (Okabe and Ito 2008, which people with colour blindness tell apart)."""
DOTS = 200  # per inch
_SIZE = re.compile(r"[\w-]+, [\d.]+ mm")
"""Keys of settings that say a tier and the size of its elements alone, see `Setting.key`; a line joins these."""


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
        axes.scatter(*at(own), s=28, facecolor=[colour if p.ranked else "white" for p in own],
                     edgecolor=colour, zorder=3, label=tier)
    axes.scatter(*at([p for p in shown if p.front]), s=110, facecolor="none", edgecolor="black",
                 zorder=4, label="on the front")
    bar = 100.0 * max((p.bar for p in shown), default=0.0)
    if bar > 0.0:
        axes.axhline(bar, color="0.5", linestyle="--", linewidth=1.0)
        axes.annotate("error of the limit; open marks are not ranked", (0.01, bar), (0, 3), ("axes fraction", "data"),
                      "offset points", ha="left", va="bottom", fontsize=8, color="0.4")
    axes.set(xscale="log", yscale="log", xlabel="CPU time of a touch [s]",
             ylabel="error of the force [%], worst touch", title=title)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", color="0.88")
    axes.legend(fontsize=8, loc="best", framealpha=1.0)
    return figure


def page(points: Sequence[Point], **words: str | Sequence[str]) -> str:
    """One HTML file that needs no network.

    Args:
        points: cheapest first.
        words: ``title``, and sentences ``about`` the touches and their limits, one a goal (``sentences``), and
            ``notes`` at the end.
    """
    drawing = io.StringIO()
    draw(points, "").savefig(drawing, format="svg")
    head, rows = cells(points)
    template = Environment(autoescape=True).from_string(files(__package__).joinpath("page.html").read_text("utf-8"))
    return template.render(drawing=drawing.getvalue()[drawing.getvalue().index("<svg"):], head=head, rows=rows, **words)
