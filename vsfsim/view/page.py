"""The page: `page.html` with the style, the script and the objects put in."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

START, END = '<script type="application/json" id="data">', "</script>"
"""What stands before and after the objects in a page."""


def page(title: str, objects: Sequence[dict[str, Any]], **about: Any) -> bytes:
    """One HTML file that shows objects, without anything from outside.

    Args:
        title: of the page.
        objects: what `vsfsim.view.subject` makes of each.
        about: of all objects, see `vsfsim.view.scored`: ``map``, what their colours are and its unit; ``reading``, name
            and unit of the predicted readings; ``shots``, their labels.
    """
    part = {name: files(__package__).joinpath(name).read_text(encoding="utf-8")
            for name in ("page.html", "page.css", "page.js", "charts.js", "draw.js")}
    # No text of a dataset may end the element that holds it.
    data = json.dumps({"title": title, "objects": list(objects), **about}, separators=(",", ":"),
                      allow_nan=False).replace("<", "\\u003c")
    out = part["page.html"]
    for key, text in (("TITLE", html.escape(title)), ("STYLE", part["page.css"]), ("DATA", START + data + END),
                      ("DRAW", part["draw.js"]), ("CHARTS", part["charts.js"]), ("SCRIPT", part["page.js"])):
        before, after = out.split(f"@{key}@", 1)
        out = before + text + after
    return out.encode()


def data_of(content: bytes) -> dict[str, Any]:
    """The title and objects that a page holds, as `page` was given them."""
    text = content.decode()
    begin = text.index(START) + len(START)
    return json.loads(text[begin:text.index(END, begin)])
