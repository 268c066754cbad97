"""Texts and pages by the templates of the folder `pages`. A page is plain HTML without a script or anything from
another machine. What strangers wrote is text in every place."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from vsfsim.core.plain_text import markdown, plain
from vsfsim.core.text_table import text_table

_PAGES = Path(__file__).parent / "pages"


@functools.cache
def _environment() -> Environment:
    out = Environment(loader=FileSystemLoader(_PAGES), autoescape=lambda name: str(name).endswith((".html", ".svg")),
                      undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True,
                      finalize=lambda value: plain(value) if type(value) is str else value)
    out.globals |= {"style": Markup((_PAGES / "style.css").read_text(encoding="utf-8")),
                    "text_table": lambda *given: Markup(text_table(*given))}
    out.filters["escaped"] = markdown
    return out


def filled(template: str, **given: Any) -> str:
    """A text or page of the folder `pages`, filled; texts are made `plain`, and escaped in a page."""
    return _environment().get_template(template).render(**given)
