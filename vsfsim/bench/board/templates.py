"""Texts and pages by the templates of the folder `pages`. A page is plain HTML without a script or anything from
another machine. What strangers wrote is text in every place."""

from __future__ import annotations

import base64
import functools
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vsfsim.core.plain_text import markdown, plain
from vsfsim.core.text_table import text_table

_PAGES = Path(__file__).parent / "pages"


@functools.cache
def _environment() -> Environment:
    out = Environment(loader=FileSystemLoader(_PAGES), autoescape=lambda name: str(name).endswith(".html"),
                      undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
                      finalize=lambda value: plain(value) if type(value) is str else value)
    out.globals |= {"style": Markup((_PAGES / "style.css").read_text(encoding="utf-8")),
                    "text_table": lambda *given: Markup(text_table(*given))}
    out.filters["escaped"] = markdown
    return out


def filled(template: str, **given: Any) -> str:
    """A text or page of the folder `pages`, filled; texts are made `plain`, and escaped in a page."""
    return _environment().get_template(template).render(**given)


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
