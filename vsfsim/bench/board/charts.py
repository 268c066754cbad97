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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vsfsim.core.plain_text import markdown, plain
from vsfsim.core.text_table import text_table

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6bb1", "#7f7f7f")
"""Of lines (Okabe and Ito 2008, which people with colour blindness tell apart)."""
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


def chart(lines: Sequence[tuple[str, Sequence[tuple[float, float]]]], labels: Sequence[str], *, across: str, axis: str,
          level: float | None = None) -> Markup:
    """Points over some numbers of touches with their intervals, joined by lines; "" where no value is known.

    Args:
        lines: name of each, and at each label its mean and half the width of its interval; NaN where there is none.
        labels: of the places on the abscissa. across, axis: names of abscissa and values. level: a value that is marked
        by a dashed line.
    """
    means = np.array([mean for _, values in lines for mean, _ in values if math.isfinite(mean)])
    if not len(means):
        return Markup("")
    top = max(level or 0.0, *(np.nansum(pair) for _, values in lines for pair in values))
    ticks = round_numbers(min(top, 3.0 * float(means.max())))
    width, height, left, right, upper, lower = 760, 360, 56, 550, 12, 318

    def across_at(x: float) -> float:
        return round(left + (right - left) * (x + 0.5) / len(labels), 1)

    def up_at(y: float) -> float:
        return round(lower - (lower - upper) * min(max(y, 0.0), ticks[-1]) / ticks[-1], 1)

    drawn = []
    for n, (name, values) in enumerate(lines):
        aside = 0.04 * (n - 0.5 * (len(lines) - 1))  # so that intervals stand beside one another
        known = [(k, mean, half if math.isfinite(half) else 0.0) for k, (mean, half) in enumerate(values)
                 if math.isfinite(mean)]
        points = [(across_at(k + aside), up_at(mean), up_at(mean - half), up_at(mean + half), f"{mean:.3f}")
                  for k, mean, half in known]
        drawn.append({"name": name, "colour": COLOURS[n % len(COLOURS)], "key": upper + 14 + 19 * n,
                      "points": points, "path": " ".join(f"{x},{y}" for x, y, *_ in points)})
    return render("chart.svg", lines=drawn, ticks=[(up_at(tick), f"{tick:g}") for tick in ticks], across=across,
                  marks=[(across_at(x), text) for x, text in enumerate(labels)], axis=axis, left=left, right=right,
                  level=None if level is None else up_at(level), top=upper, bottom=lower, width=width, height=height)


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


def round_numbers(high: float) -> list[float]:
    """About five round numbers from 0 to beyond ``high``."""
    high = max(high, 1e-12)
    power = 10.0 ** math.floor(math.log10(high / 4.0))
    step = next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= high / 4.0 * 0.999)
    return [step * k for k in range(math.ceil(high / step - 1e-9) + 1)]
