"""Pages and their charts, by the templates of the folder `pages`: plain HTML and SVG without anything from another
machine, and one short script that sorts and filters tables. A page's policy names the script by its digest, so that no
other runs, and without it the page is whole. What strangers wrote is text in every place."""

from __future__ import annotations

import base64
import functools
import hashlib
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vsfsim.core.plain_text import markdown, plain
from vsfsim.core.text_table import text_table

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#7f7f7f")
"""Of lines (Okabe and Ito 2008, which people with colour blindness tell apart)."""

_VIRIDIS = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)])
"""Viridis (van der Walt and Smith 2015) at five places."""
_LEVELS = 31  # colours of a map, less one
_GRID = 2  # pixels: places of a map are rounded to it, and those of one colour that meet are one dot
_PAGES = Path(__file__).parent / "pages"


@functools.cache
def _environment() -> Environment:
    out = Environment(loader=FileSystemLoader(_PAGES), autoescape=lambda name: str(name).endswith((".html", ".svg")),
                      undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
                      finalize=lambda value: plain(value) if type(value) is str else value)
    script = (_PAGES / "table.js").read_text(encoding="utf-8")
    out.globals |= {"style": Markup((_PAGES / "style.css").read_text(encoding="utf-8")), "script": Markup(script),
                    "text_table": lambda *given: Markup(text_table(*given)), "piped": _piped,
                    "digest": base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}
    out.filters["escaped"] = markdown
    return out


def render(template: str, **given: Any) -> Markup:
    """A template of the folder `pages`, filled; texts are escaped and made `plain`."""
    return Markup(_environment().get_template(template).render(**given))


def filled(template: str, **given: Any) -> str:
    """A text of the folder `pages` for a terminal or in Markdown, filled; texts are made `plain`, and not escaped."""
    return str(render(template, **given))


def _piped(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Markup:
    """A table in Markdown."""
    lines = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in (head, *rows)]
    return Markup("\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]]))


@dataclass(frozen=True)
class Line:
    """A line of a chart, or a point."""

    name: str
    """In the legend."""
    x: Sequence[float]
    """Places (n,)."""
    values: Sequence[tuple[float, float]]
    """(mean, half the width of its interval) at each place (n,); NaN where there is none."""


def chart(lines: Sequence[Line], span: tuple[float, float], *, across: str, axis: str, marks: Mapping[float, str],
          level: float | None = None) -> Markup:
    """Lines or points with their intervals; "" where no value is known.

    Args:
        lines: what is drawn. span: ends of the abscissa. across, axis: names of abscissa and values. marks: texts by
        place on the abscissa. level: a value that is marked by a dashed line.
    """
    means = np.array([mean for one in lines for mean, _ in one.values if math.isfinite(mean)])
    if not len(means):
        return Markup("")
    top = max(level or 0.0, *(np.nansum(pair) for one in lines for pair in one.values))
    ticks = round_numbers(0.0, min(top, 3.0 * float(means.max())))
    width, height, left, right, upper, lower = 760, 360, 56, 550, 12, 318

    def across_at(x: float) -> float:
        return round(left + (right - left) * (x - span[0]) / (span[1] - span[0]), 1)

    def up_at(y: float) -> float:
        return round(lower - (lower - upper) * min(max(y, 0.0), ticks[-1]) / ticks[-1], 1)

    drawn = []
    for n, one in enumerate(lines):
        points = [(across_at(x), up_at(mean), *((up_at(mean - half), up_at(mean + half)) if math.isfinite(half) else
                                                (up_at(mean),) * 2), f"{mean:.3f}")
                  for x, (mean, half) in zip(one.x, one.values, strict=True) if math.isfinite(mean)]
        drawn.append({"name": one.name, "colour": COLOURS[n % len(COLOURS)], "key": upper + 14 + 19 * n,
                      "points": points, "path": " ".join(f"{x},{y}" for x, y, *_ in points)})
    return render("chart.svg", lines=drawn, ticks=[(up_at(tick), f"{tick:g}") for tick in ticks], across=across,
                  marks=[(across_at(x), text) for x, text in marks.items()], axis=axis, left=left, right=right,
                  level=None if level is None else up_at(level), top=upper, bottom=lower, width=width, height=height)


def stiffness_map(places: np.ndarray, values: np.ndarray, *, low: float, high: float, name: str) -> Markup:
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
    level, dots = np.rint(_LEVELS * np.minimum(share, 1.0)).astype(int), []
    for one in np.unique(level):  # a path a colour, each place from the one before: a point is 6 letters and not 60
        at = np.unique(np.rint(np.column_stack([x, y])[level == one] / _GRID).astype(int), axis=0)
        dots.append((colour_of(one / _LEVELS), "".join(f"m{a}{'' if b < 0 else ' '}{b}z" for a, b in np.diff(
            at, axis=0, prepend=0).tolist())))
    return render("map.svg", dots=dots, grid=_GRID, dot=f"{2.0 * radius / _GRID:.1f}", name=name, width=int(size),
                  height=math.ceil(2 * margin + scale * spread[second] + 26.0), axes=["xyz"[first], "xyz"[second]])


def colour_of(share: float) -> str:
    """Colour at a share from 0 to 1 of the map; shares beyond it have the colour of its end."""
    at = np.linspace(0.0, 1.0, len(_VIRIDIS))
    return "#" + "".join(f"{round(float(np.interp(share, at, band))):02x}" for band in _VIRIDIS.T)


def png_uri(image: np.ndarray) -> str:
    """An image as the address of a PNG that it holds itself.

    Args:
        image: sRGB (H, W, 3), or grey and opacity (H, W, 2), uint8.
    """
    height, width, bands = image.shape
    rows = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], axis=1)
    head = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 2: 4}[bands], 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(rows.tobytes(), 9)), (b"IEND", b""))
    content = b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks)
    return "data:image/png;base64," + base64.b64encode(content).decode()


def round_numbers(low: float, high: float) -> list[float]:
    """About five round numbers from below ``low`` to beyond ``high``."""
    raw = max(high - low, 1e-12) / 4.0
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= raw * 0.999)
    first = math.floor(low / step + 1e-9)
    return [step * k for k in range(first, max(math.ceil(high / step - 1e-9), first + 1) + 1)]
