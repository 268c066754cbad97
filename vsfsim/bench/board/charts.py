"""Charts of the leaderboard's pages as SVG: lines with intervals, points with names, maps of stiffness."""

from __future__ import annotations

import base64
import itertools
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.bench.board.markup import escape

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#7f7f7f")
"""Of lines (Okabe and Ito 2008, which people with colour blindness tell apart)."""

_MAP = ((0.0, (68, 1, 84)), (0.25, (59, 82, 139)), (0.5, (33, 145, 140)), (0.75, (94, 201, 98)), (1.0, (253, 231, 37)))
"""Viridis (van der Walt and Smith 2015) at five places."""
_LEVELS = 31  # colours of a map, less one
_GRID = 2  # pixels: places of a map are rounded to it, and those of one colour that meet are one dot


@dataclass(frozen=True)
class Series:
    """A line."""

    name: str
    """In the legend."""
    values: Sequence[tuple[float, float] | None]
    """(mean, half width of the interval) at each place; None where there is none."""


def lines(labels: Sequence[str], series: Sequence[Series], *, axis: str, below: str, level: float | None = None) -> str:
    """Lines over equally spaced places, with their intervals.

    Args:
        labels: of the places. series: the lines. axis: name of the values. below: name of the places. level: a value
        that is marked by a dashed line.
    """
    known = [v for s in series for v in s.values if v is not None and math.isfinite(v[0])]
    if not known:
        return ""
    top = max(max(m + (e if math.isfinite(e) else 0.0) for m, e in known), level or 0.0)
    ticks = round_numbers(0.0, min(top, 3.0 * max(m for m, _ in known)))
    width, height, left, right, up, down = 760, 360, 62, 210, 12, 46
    high = ticks[-1]

    def place(k: int, value: float) -> tuple[float, float]:
        across = left + (width - left - right) * (k + 0.5) / len(labels)
        return across, up + (height - up - down) * (1.0 - min(max(value, 0.0), high) / high)

    out = _frame(width, height, left, right, up, down, ticks, high, axis)
    for k, label in enumerate(labels):
        out.append(_text(place(k, 0.0)[0], height - down + 18, label, "middle"))
    out.append(_text((left + width - right) / 2, height - 6, below, "middle", soft=True))
    if level is not None:
        y = place(0, level)[1]
        out.append(f'<line class="axis" x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}" '
                   'stroke-dasharray="5 4"/>')
    for n, one in enumerate(series):
        colour, shift = COLOURS[n % len(COLOURS)], 4.0 * (n - 0.5 * (len(series) - 1))
        points = [(place(k, v[0])[0] + shift, place(k, v[0])[1], k, v) for k, v in enumerate(one.values)
                  if v is not None and math.isfinite(v[0])]
        dash = "" if n < len(COLOURS) else ' stroke-dasharray="6 3"'
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y, _, _ in points)
        out.append(f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.8"{dash}/>')
        for x, y, k, (mean, error) in points:
            if math.isfinite(error):
                y1, y2 = place(k, mean - error)[1], place(k, mean + error)[1]
                out.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y1:.1f}" y2="{y2:.1f}" stroke="{colour}"/>')
            out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.2" fill="{colour}"><title>{escape(one.name)}: '
                       f'{mean:.3f}</title></circle>')
        y = up + 14 + 19 * n
        out.append(f'<line x1="{width - right + 12}" x2="{width - right + 34}" y1="{y - 4}" y2="{y - 4}" '
                   f'stroke="{colour}" stroke-width="2.4"{dash}/>')
        out.append(_text(width - right + 40, y, one.name))
    need = max(height, up + 24 + 19 * len(series))
    return _svg(width, need, out, f"{axis} over {below}")


def points(values: Mapping[str, tuple[float, float, float]], *, across: str, axis: str) -> str:
    """Named points over a logarithmic abscissa.

    Args:
        values: by name, (abscissa > 0, ordinate, half width of its interval). across, axis: names of both.
    """
    known = {name: v for name, v in values.items() if v[0] > 0.0 and math.isfinite(v[1])}
    if not known:
        return ""
    width, height, left, right, up, down = 760, 360, 62, 150, 12, 46
    low, far = (math.floor(math.log10(min(v[0] for v in known.values()))),
                math.ceil(math.log10(max(v[0] for v in known.values())) + 1e-9))
    far = max(far, low + 1)
    ticks = round_numbers(0.0, max(v[1] + (v[2] if math.isfinite(v[2]) else 0.0) for v in known.values()))
    high = ticks[-1]
    out = _frame(width, height, left, right, up, down, ticks, high, axis)
    for power in range(low, far + 1):
        x = left + (width - left - right) * (power - low) / (far - low)
        out.append(f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="{up}" y2="{height - down}"/>')
        out.append(_text(x, height - down + 18, f"{10.0**power:g}", "middle"))
    out.append(_text((left + width - right) / 2, height - 6, across, "middle", soft=True))
    ordered = sorted(known.items(), key=lambda item: item[1][1])
    at = {name: (left + (width - left - right) * (math.log10(v[0]) - low) / (far - low),
                 up + (height - up - down) * (1.0 - min(max(v[1], 0.0), high) / high)) for name, v in ordered}
    taken = [(x - 5.0, y - 5.0, x + 5.0, y + 5.0) for x, y in at.values()]
    written: list[str] = []  # over all lines
    for n, (name, (_, _, error)) in enumerate(ordered):
        colour, (x, y) = COLOURS[n % len(COLOURS)], at[name]
        if math.isfinite(error):
            half = (height - up - down) * error / high
            out.append(f'<line x1="{x:.1f}" x2="{x:.1f}" y1="{y - half:.1f}" y2="{y + half:.1f}" stroke="{colour}"/>')
        out.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
        box = _free((x + 6.0, y - 7.0, x + 10.0 + 6.2 * len(name), y + 7.0), taken, up, height - down)
        taken.append(box)
        middle = (box[1] + box[3]) / 2.0
        if middle != y:  # a name that gave way is joined to its point
            out.append(f'<line x1="{x:.1f}" x2="{x + 7:.1f}" y1="{y:.1f}" y2="{middle:.1f}" stroke="{colour}"/>')
        written.append(_text(x + 8, middle + 4.0, name, over=True))
    return _svg(width, height, [*out, *written], f"{axis} over {across}")


Box = tuple[float, float, float, float]
"""Left, upper, right and lower edge."""


def _free(box: Box, taken: Sequence[Box], up: float, down: float) -> Box:
    """The box moved up or down as little as needed to meet none of others between two edges; as it is if there is no
    such place."""
    for step in range(1, int(down - up)):
        by = step // 2 * (-1.0 if step % 2 else 1.0)
        moved = (box[0], box[1] + by, box[2], box[3] + by)
        if moved[1] >= up and moved[3] <= down and not any(
                moved[0] < b[2] and b[0] < moved[2] and moved[1] < b[3] and b[1] < moved[3] for b in taken):
            return moved
    return box


def stiffness_map(places: np.ndarray, values: np.ndarray, *, low: float, high: float, name: str) -> str:
    """Stiffness at points of a surface, seen along the axis in which they extend least.

    Args:
        places: points (k, 3) [m]. values: stiffness (k,) > 0 or 0. low, high: of the colours, 0 < low < high.
        name: of the picture.
    """
    spread = np.ptp(places, axis=0)
    first, second = sorted(np.argsort(-spread)[:2])
    size, margin = 300.0, 10.0
    scale = (size - 2 * margin) / max(float(spread[first]), float(spread[second]), 1e-9)
    x = margin + scale * (places[:, first] - places[:, first].min())
    y = margin + scale * (places[:, second].max() - places[:, second])
    radius = min(14.0, max(2.0, 0.4 * size / math.sqrt(max(len(places), 1))))
    share = np.log(np.maximum(values, low) / low) / math.log(high / low)
    level = np.rint(_LEVELS * np.minimum(share, 1.0)).astype(int)
    out = []
    for one in np.unique(level):  # a path a colour, each place from the one before: a point is 6 letters and not 60
        at = np.unique(np.rint(np.column_stack([x, y])[level == one] / _GRID).astype(int), axis=0)
        steps = np.diff(at, axis=0, prepend=0)
        dots = "".join(f"m{a}{'' if b < 0 else ' '}{b}z" for a, b in steps.tolist())
        out.append(f'<path stroke="{colour_of(one / _LEVELS)}" d="{dots}"/>')
    out = [f'<g class="dots" transform="scale({_GRID})" stroke-width="{2.0 * radius / _GRID:.1f}">', *out, "</g>"]
    tall = float(2 * margin + scale * spread[second]) + 26.0
    axes = "xyz"
    out.append(_text(margin, tall - 8.0, f"{name} ({axes[first]} right, {axes[second]} up)"))
    return _svg(int(size), math.ceil(tall), out, name)


def scale_bar(low: float, high: float, unit: str) -> str:
    """The colours of `stiffness_map`."""
    step = 280 / (len(_MAP) - 1) / 4
    out = [f'<rect x="{10 + step * k:g}" y="6" width="{step + 0.5:g}" height="14" '
           f'fill="{colour_of(k / (4 * len(_MAP) - 5))}"/>' for k in range(4 * (len(_MAP) - 1))]
    out += [_text(10, 36, f"{low:.3g}"), _text(290, 36, f"{high:.3g} {unit}", "end"),
            _text(150, 36, "logarithmic", "middle", soft=True)]
    return _svg(300, 42, out, "colours")


def colour_of(share: float) -> str:
    """Colour at a share from 0 to 1 of the map; shares beyond it have the colour of its end."""
    at = min(max(share, 0.0), 1.0)
    for (a, one), (b, other) in itertools.pairwise(_MAP):
        if at <= b:
            part = (at - a) / (b - a)
            return "#" + "".join(f"{round(u + part * (v - u)):02x}" for u, v in zip(one, other, strict=True))
    return "#fde725"


def png(rgb: np.ndarray, name: str) -> str:
    """An image (H, W, 3) uint8 as an HTML element that holds it."""
    height, width = rgb.shape[:2]
    rows = b"".join(b"\0" + np.ascontiguousarray(row).tobytes() for row in rgb)

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    file = (b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
            + chunk(b"IDAT", zlib.compress(rows, 9)) + chunk(b"IEND", b""))
    return (f'<img alt="{escape(name)}" width="{min(width, 360)}" '
            f'src="data:image/png;base64,{base64.b64encode(file).decode()}">')


def round_numbers(low: float, high: float) -> list[float]:
    """About five round numbers from below ``low`` to beyond ``high``."""
    raw = max(high - low, 1e-12) / 4.0
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw * 0.999)
    first = math.floor(low / step + 1e-9)
    return [step * k for k in range(first, max(math.ceil(high / step - 1e-9), first + 1) + 1)]


def _frame(width: int, height: int, left: int, right: int, up: int, down: int, ticks: Sequence[float], high: float,
           axis: str) -> list[str]:
    out = []
    for tick in ticks:
        y = up + (height - up - down) * (1.0 - tick / high)
        out.append(f'<line class="grid" x1="{left}" x2="{width - right}" y1="{y:.1f}" y2="{y:.1f}"/>')
        out.append(_text(left - 8, y + 4, f"{tick:g}", "end"))
    middle = (up + height - down) / 2
    out.append(f'<text class="soft" transform="translate(14 {middle:.0f}) rotate(-90)" '
               f'text-anchor="middle">{escape(axis)}</text>')
    out.append(f'<line class="axis" x1="{left}" x2="{width - right}" y1="{height - down}" y2="{height - down}"/>')
    return out


def _text(x: float, y: float, text: str, anchor: str = "start", *, soft: bool = False, over: bool = False) -> str:
    kind = ' class="soft"' if soft else ' class="over"' if over else ""  # over lines, which end at its edge
    return f'<text{kind} x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _svg(width: int, height: int, parts: Sequence[str], name: str) -> str:
    return (f'<svg viewBox="0 0 {width} {height}" width="{width}" height="{height}" role="img" '
            f'aria-label="{escape(name)}">' + "".join(parts) + "</svg>")
