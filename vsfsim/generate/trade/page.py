"""The picture of a trade-off, error against time on logarithmic axes with a line a tier, and the page that has it with
every figure."""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Sequence
from typing import Any

from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from vsfsim.core.system.interactive import new_figure
from vsfsim.generate.trade import front
from vsfsim.generate.trade.front import Point

COLOURS = {"vsf": "#7f7f7f", "linear": "#e69f00", "fem-coarse": "#0072b2", "fem": "#009e73", "fem-fine": "#d55e00"}
"""Of the tiers (Okabe and Ito 2008, which people with colour blindness tell apart)."""
DOTS = 200  # per inch
_SIZE = re.compile(r"[\w-]+, [\d.]+ mm")
"""Keys of settings that say a tier and the size of its elements alone, see `Setting.key`; a line joins these."""
_STYLE = """body { margin: 24px auto; max-width: 1180px; padding: 0 16px; font: 15px/1.45 system-ui, sans-serif; }
svg { max-width: 100%; height: auto; } .wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 8px; text-align: right; border-bottom: 1px solid #d4d4d8; white-space: nowrap; }
th:nth-child(2), td:nth-child(2) { text-align: left; } tr.front { font-weight: 600; }"""


def draw(points: Sequence[Point], title: str) -> Any:
    """The figure: CPU time of a touch against the error of the force; points without an error have no place."""
    figure = new_figure(figsize=(7.0, 4.0), dpi=DOTS, layout="tight")
    axes = figure.subplots()
    shown = sorted((p for p in points if math.isfinite(p.error) and p.error > 0.0 and p.cpu > 0.0),
                   key=lambda p: p.cpu)
    for tier in dict.fromkeys(p.tier for p in shown):
        own = [p for p in shown if p.tier == tier]
        line = [p for p in own if _SIZE.fullmatch(p.key)]
        axes.plot([p.cpu for p in line], [100.0 * p.error for p in line], color=COLOURS[tier], linewidth=1.2)
        for ranked, fill in ((True, COLOURS[tier]), (False, "white")):
            some = [p for p in own if p.ranked == ranked]
            axes.scatter([p.cpu for p in some], [100.0 * p.error for p in some], s=28, facecolor=fill,
                         edgecolor=COLOURS[tier], zorder=3,
                         label=tier if ranked == any(p.ranked for p in own) else None)
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
    return figure


def page(title: str, about: Sequence[str], points: Sequence[Point], sentences: Sequence[str],
         notes: Sequence[str]) -> str:
    """One HTML file that needs no network.

    Args:
        title: of the page.
        about: sentences about the touches and their limits.
        points: cheapest first.
        sentences: one a goal.
        notes: at the end.
    """
    def items(name: str, lines: Sequence[str]) -> str:
        rows = "".join(f"<li>{html.escape(line)}</li>" for line in lines)
        return f"<h2>{name}</h2><ul>{rows}</ul>" if lines else ""

    drawing = io.StringIO()
    draw(points, "").savefig(drawing, format="svg")
    head, rows = front.cells(points)
    top = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    body = "".join(f"<tr{' class=front' if p.front else ''}>{''.join(f'<td>{html.escape(c)}</td>' for c in row)}</tr>"
                   for p, row in zip(points, rows, strict=True))
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
            f"<style>{_STYLE}</style></head><body><h1>{html.escape(title)}</h1>"
            f"{drawing.getvalue()[drawing.getvalue().index('<svg'):]}"
            f"{items('What a goal costs', sentences)}<h2>All points</h2><p>* on the front, ~ error below that of the "
            f"limit, not ranked, x the tier does not show what the scene needs.</p>"
            f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>'
            f"{items('The limit', about)}{items('Notes', notes)}</body></html>\n")
