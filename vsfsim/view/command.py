"""`vsfsim show WHAT --out NAME.html`: the page of a dataset, of a scene's object, or of a result."""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.generate.inspect import draw_scene, is_dataset
from vsfsim.view.scored import of_result
from vsfsim.view.subject import of_body, of_press, of_view

if TYPE_CHECKING:
    from vsfsim.generate.press_result import PressResult


def view(what: str, out: Path, *, objects: int = 12, seed: int = 0,
         progress: Callable[[int, int, str], None] = lambda *_: None) -> tuple[list[str], dict[str, Any]]:
    """Write the page of a dataset folder, of a scene or of a result.

    Args:
        what: folder of a dataset, name of a scene, path of its .toml file, or a result file (.json).
        out: the file.
        objects: object views of a dataset or result to show, at most.
        seed: of a scene's object.
        progress: called with (done, in all, what).

    Returns:
        The lines to print, and the same for JSON.

    Raises:
        DatasetError: neither a dataset nor a scene, a damaged dataset, or a file that cannot be written.
        TaskError: what ends in .json is no result, or has nothing to show.
        SceneError, MeshError: the scene's object cannot be built.
    """
    about: dict[str, Any] = {}
    if Path(what).suffix == ".json":
        title, words, shown, about = of_result(Path(what), objects, progress)
    elif is_dataset(what):
        data = Dataset.open(what, progress=progress)
        title = f"{data.recipe.scene}, tier {data.recipe.tier}, seed {data.recipe.seed}"
        shown = []
        for one in data[:objects]:
            progress(len(shown), min(len(data), objects), "object views")
            shown.append(of_view(data, one))
        more = f" (of {len(data)}; --objects shows more)" if len(shown) < len(data) else ""
        words = f"{len(shown)} object views{more}"
    else:
        name, drawing = draw_scene(what, seed)
        title, words = f"{name}, {drawing.subtitle or f'seed {seed}'}", drawing.lines[0]
        shown = [{"name": name, "about": drawing.lines[0], **of_body(drawing), "touches": [], "picture": None}]
    content = page(title, shown, **about)
    write_atomic(out, content)
    return ([f"{title}: {words}", f"page: {out}, {len(content) / 1e6:.1f} MB; open it in a browser"],
            {"page": str(out), "title": title, "objects": [one["name"] for one in shown], "bytes": len(content)})


def of_one(out: Path, scene: str, result: PressResult) -> None:
    """Write the page of a press."""
    write_atomic(out, page(f"{scene}: {result.model}", [of_press(scene, result)]))


def page(title: str, objects: Sequence[dict[str, Any]], **about: Any) -> bytes:
    """One HTML file that shows objects, without anything from outside.

    Args:
        title: of the page.
        objects: what `vsfsim.view.subject` makes of each.
        about: of all objects, see `vsfsim.view.scored`: ``map``, what their colours are and its unit.
    """
    part = {name: files(__package__).joinpath(name).read_text(encoding="utf-8")
            for name in ("page.html", "page.css", "page.js", "charts.js", "draw.js")}
    # No text of a dataset may end the element that holds it.
    data = json.dumps({"title": title, "objects": list(objects), **about}, separators=(",", ":"),
                      allow_nan=False).replace("<", "\\u003c")
    whole = jinja2.Template(part["page.html"], keep_trailing_newline=True)
    return whole.render(title=html.escape(title), data=data, part=part).encode()
