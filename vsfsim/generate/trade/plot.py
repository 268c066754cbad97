"""The picture of a trade-off for pages that show no HTML: error against time, a line a tier."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from vsfsim.core.interactive.figure import new_figure
from vsfsim.data.disk import write_figure
from vsfsim.generate.trade.front import Point
from vsfsim.generate.trade.page import by_size, by_tier

DOTS = 200  # per inch


def draw(points: Sequence[Point], title: str, file: Path) -> None:
    """Write the picture.

    Args:
        points: as of `vsfsim.generate.trade.command.Tradeoff`.
        title: above it.
        file: the picture.
    """
    figure = new_figure(figsize=(7.0, 4.0), dpi=DOTS, layout="tight")
    axes = figure.subplots()
    tiers = by_tier(points)
    shown = [p for _, own in tiers.values() for p in own]
    for tier, (colour, own) in tiers.items():
        line = by_size(own)
        axes.plot([p.cpu for p in line], [100.0 * p.error for p in line], color=colour, linewidth=1.2)
        for ranked, fill in ((True, colour), (False, "white")):
            some = [p for p in own if p.ranked == ranked]
            axes.scatter([p.cpu for p in some], [100.0 * p.error for p in some], s=28, facecolor=fill, edgecolor=colour,
                         zorder=3, label=tier if ranked == any(p.ranked for p in own) else None)
    best = [p for p in shown if p.front]
    axes.scatter([p.cpu for p in best], [100.0 * p.error for p in best], s=110, facecolor="none", edgecolor="black",
                 zorder=4, label="on the front")
    bar = 100.0 * max((p.bar for p in shown), default=0.0)
    if bar > 0.0:
        axes.axhline(bar, color="0.5", linestyle="--", linewidth=1.0)
        axes.annotate("error of the limit; open marks are not ranked", (0.01, bar), (0, 3),
                      ("axes fraction", "data"), "offset points", ha="left", va="bottom", fontsize=8, color="0.4")
    axes.set(xscale="log", yscale="log", xlabel="CPU time of a touch [s]", ylabel="error of the force [%], worst touch",
             title=title)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="major", color="0.88")
    axes.legend(fontsize=8, loc="best", framealpha=1.0)
    write_figure(figure, file)
