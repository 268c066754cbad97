"""The page of a trade-off: error against time on logarithmic axes, a line a tier, and every figure; one file."""

from __future__ import annotations

import html
import math
import re
from collections.abc import Sequence

from vsfsim.generate.trade import front
from vsfsim.generate.trade.front import Point

WIDTH, HEIGHT = 900, 500  # of the chart [px]
LEFT, RIGHT, TOP, BOTTOM = 70, 110, 16, 48  # around its axes [px]
COLOURS = {"vsf": "#7f7f7f", "linear": "#e69f00", "fem-coarse": "#0072b2", "fem": "#009e73",
            "fem-fine": "#d55e00", "bubble": "#56b4e9"}
"""Of the tiers (Okabe and Ito 2008, which people with colour blindness tell apart)."""
_STYLE = """
:root { color-scheme: light dark; --back: #fff; --front: #1c1c1e; --faint: #77777d; --line: #d4d4d8; }
@media (prefers-color-scheme: dark) {
  :root { --back: #17181b; --front: #ececf0; --faint: #9a9aa2; --line: #3a3b41; } }
body { margin: 24px auto; max-width: 1180px; padding: 0 16px; background: var(--back); color: var(--front);
  font: 15px/1.45 system-ui, sans-serif; }
h1 { font-size: 20px; } h2 { font-size: 16px; margin-top: 28px; }
svg { max-width: 100%; height: auto; } svg text { fill: var(--front); font-size: 12px; }
.grid { stroke: var(--line); } .frame { stroke: var(--faint); fill: none; } .faint, svg .faint { fill: var(--faint);
  color: var(--faint); }
.wide { overflow-x: auto; } table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 8px; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:nth-child(2), td:nth-child(2) { text-align: left; } tr.front { font-weight: 600; }
"""


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
    def items(lines: Sequence[str]) -> str:
        return "".join(f"<li>{html.escape(line)}</li>" for line in lines)

    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
            f'content="width=device-width"><title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>'
            f"<h1>{html.escape(title)}</h1>{chart(points)}"
            f'<p class="faint">Ringed: on the front. Hatched: the error is below that of the limit itself and is not '
            f"ranked. Crossed out: the tier does not show what the scene needs. Point at a mark for its figures.</p>"
            f"<h2>What a goal costs</h2><ul>{items(sentences)}</ul>"
            f'<h2>All points</h2><div class="wide">{_table(points)}</div>'
            f"<h2>The limit</h2><ul>{items(about)}</ul>{f'<h2>Notes</h2><ul>{items(notes)}</ul>' if notes else ''}"
            f"</body></html>\n")


def by_tier(points: Sequence[Point]) -> dict[str, tuple[str, list[Point]]]:
    """Colour and points of each tier, by their time; those that have a place on logarithmic axes."""
    shown = [p for p in points if math.isfinite(p.error) and p.error > 0.0 and p.cpu > 0.0]
    return {tier: (COLOURS.get(tier, "#8c6bb1"), sorted((p for p in shown if p.tier == tier), key=lambda p: p.cpu))
            for tier in dict.fromkeys(p.tier for p in shown)}


_SIZE = re.compile(r"[\w-]+|[\w-]+, [\d.]+ mm|rod, \d+ beams? a segment|bubble, \d+ nodes")
"""Keys of settings that say a tier and the size of its elements alone, see `Setting.key`."""


def by_size(own: Sequence[Point]) -> list[Point]:
    """Those of a tier's points that differ in the size of their elements alone."""
    return [p for p in own if _SIZE.fullmatch(p.key)]


def chart(points: Sequence[Point]) -> str:
    """Error of the force against CPU time of a touch as SVG, a line through the points of each tier."""
    tiers = by_tier(points)
    shown = [p for _, own in tiers.values() for p in own]
    if not shown:
        return "<p>No setting found all equilibria.</p>"
    x = _Axis([p.cpu for p in shown], LEFT, WIDTH - RIGHT)
    y = _Axis([p.error for p in shown] + [p.bar for p in shown if p.bar > 0.0], HEIGHT - BOTTOM, TOP)
    out = [f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="Error of the '
           f'force against CPU time of a touch">'
           '<defs><pattern id="hatch" width="4" height="4" patternUnits="userSpaceOnUse" '
           'patternTransform="rotate(45)"><rect width="4" height="4" fill="var(--back)"/>'
           '<line x1="0" y1="0" x2="0" y2="4" stroke="var(--front)" stroke-width="1.6"/></pattern></defs>']
    for at, value in x.ticks():
        out.append(f'<line class="grid" x1="{at:.1f}" x2="{at:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
                   f'<text x="{at:.1f}" y="{HEIGHT - BOTTOM + 18}" text-anchor="middle">{value:g}</text>')
    for at, value in y.ticks():
        out.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>'
                   f'<text x="{LEFT - 8}" y="{at + 4:.1f}" text-anchor="end">{100 * value:g}</text>')
    out.append(f'<rect class="frame" x="{LEFT}" y="{TOP}" width="{WIDTH - LEFT - RIGHT}" '
               f'height="{HEIGHT - TOP - BOTTOM}"/>'
               f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 8}" text-anchor="middle">CPU time of a touch [s]'
               f'</text><text transform="translate(16 {(TOP + HEIGHT - BOTTOM) / 2}) rotate(-90)" '
               f'text-anchor="middle">error of the force [%], worst touch</text>')
    bar = max(p.bar for p in shown)
    if bar > 0.0:
        out.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y.at(bar):.1f}" y2="{y.at(bar):.1f}" '
                   f'stroke="var(--faint)" stroke-dasharray="6 4"/><text class="faint" x="{WIDTH - RIGHT - 6}" '
                   f'y="{y.at(bar) - 5:.1f}" text-anchor="end">error of the limit</text>')
    for number, (tier, (colour, own)) in enumerate(tiers.items()):
        line = by_size(own)
        if len(line) > 1:
            places = " ".join(f"{x.at(p.cpu):.1f},{y.at(p.error):.1f}" for p in line)
            out.append(f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
        out += [_dot(p, x.at(p.cpu), y.at(p.error), colour) for p in own]
        out.append(f'<circle cx="{WIDTH - RIGHT + 16}" cy="{TOP + 8 + 20 * number}" r="5" fill="{colour}"/>'
                   f'<text x="{WIDTH - RIGHT + 28}" y="{TOP + 12 + 20 * number}">{html.escape(tier)}</text>')
    return "".join(out) + "</svg>"


def _dot(p: Point, x: float, y: float, colour: str) -> str:
    fill = colour if p.ranked else "url(#hatch)"
    words = (f"{p.key}: error {100 * p.error:.2g} %, {p.cpu:.3g} s a touch, {p.frame:.2g} s a frame, "
             f"{100 * p.marked:.0f} % of the frames marked")
    out = (f'<g><title>{html.escape(words)}</title><circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="{fill}" '
           f'stroke="{colour}"/>')
    if p.front:
        out += f'<circle cx="{x:.1f}" cy="{y:.1f}" r="10" fill="none" stroke="var(--front)" stroke-width="1.5"/>'
    if not p.shows:
        out += f'<path d="M{x - 6:.1f} {y - 6:.1f}l12 12m0 -12l-12 12" stroke="var(--front)"/>'
    return out + "</g>"


class _Axis:
    """A logarithmic axis over values, from one place of the picture to another."""

    def __init__(self, values: Sequence[float], start: float, stop: float):
        self.low, self.high = math.log10(min(values)) - 0.12, math.log10(max(values)) + 0.12
        self.start, self.stop = start, stop

    def at(self, value: float) -> float:
        share = (math.log10(value) - self.low) / (self.high - self.low)
        return self.start + share * (self.stop - self.start)

    def ticks(self) -> list[tuple[float, float]]:
        """Places and values at 1, 2 and 5 times the powers of ten."""
        values = [m * 10.0**e for e in range(math.floor(self.low) - 1, math.ceil(self.high) + 1) for m in (1, 2, 5)]
        return [(self.at(v), v) for v in values if self.low <= math.log10(v) <= self.high]


def _table(points: Sequence[Point]) -> str:
    head, rows = front.cells(points)
    body = "".join(f"<tr{' class=front' if p.front else ''}>{''.join(f'<td>{html.escape(c)}</td>' for c in row)}</tr>"
                   for p, row in zip(points, rows, strict=True))
    top = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    return f"<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
