"""`vsfsim view`: the page of a dataset, of a scene's object, or of a result."""

from __future__ import annotations

import html
import json
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError
from vsfsim.core.extras import require
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_atomic
from vsfsim.generate.inspect import draw_scene, is_dataset
from vsfsim.view.rerun_file import write_rerun
from vsfsim.view.scored import of_result
from vsfsim.view.subject import of_drawing, of_view


def view(what: str, out: Path | None = None, *, objects: int = 12, seed: int = 0,
         rerun: Path | None = None, progress: Callable[[int, int, str], None]
         | None = None) -> tuple[list[str], dict[str, Any]]:
    """Write the page of a dataset folder, of a scene or of a result.

    Args:
        what: folder of a dataset, name of a scene, path of its .toml file, or a result file (.json).
        out: the HTML file, which must not exist; None for the name of the dataset, scene or result here.
        objects: object views of a dataset or result to show, at most.
        seed: of a scene's object.
        rerun: file of a recording for the Rerun viewer, written as well; None for none.
        progress: called with (done, in all, what).

    Returns:
        The lines to print, and the same for JSON.

    Raises:
        DatasetError: neither a dataset nor a scene, a damaged dataset, or a file that exists or cannot be written.
        TaskError: what ends in .json is no result, or has nothing to show.
        SceneError, MeshError: the scene's object cannot be built.
    """
    about: dict[str, Any] = {}
    if rerun is not None:
        require("rerun", "rerun")
        _new(rerun, "--rerun")
    if Path(what).suffix == ".json":
        path = _new(out or Path(f"{Path(what).stem}.html"))
        title, words, shown, about = of_result(Path(what), objects, progress)
    elif is_dataset(what):
        path = _new(out or Path(f"{Path(what).resolve().name}.html"))
        data = Dataset.open(what)
        title = f"{data.recipe.scene}, tier {data.recipe.tier}, seed {data.recipe.seed}"
        names, shown = data.names()[:objects], []
        for number, one in enumerate(names):
            shown.append(of_view(data.load(one)))
            if progress is not None:
                progress(number + 1, len(names), "object views")
        more = f" (of {len(data)}; --objects shows more)" if len(names) < len(data) else ""
        words = f"{len(names)} object views{more}"
    else:
        path = _new(out or Path(f"{Path(what).stem}.html"))
        name, drawing = draw_scene(what, seed)
        title, words = f"{name}, {drawing.subtitle or f'seed {seed}'}", drawing.lines[0]
        shown = [of_drawing(name, drawing)]
    content = page(title, shown, **about)
    if rerun is not None:
        write_rerun(rerun, title, shown, about)
    write_atomic(path, content)
    return ([f"{title}: {words}", f"page: {path}, {len(content) / 1e6:.1f} MB; open it in a browser",
             *([f"recording: {rerun}; open it with `rerun {rerun}`"] if rerun else [])],
            {"page": str(path), "title": title, "objects": [one["name"] for one in shown], "bytes": len(content)})


def _new(path: Path, option: str = "--html") -> Path:
    if path.exists():
        raise DatasetError(f"{path} exists already. Choose another name with {option}, or remove it first.")
    return path


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
    for key, text in (("TITLE", html.escape(title)), ("STYLE", part["page.css"]), ("DATA", data),
                      ("DRAW", part["draw.js"]), ("CHARTS", part["charts.js"]), ("SCRIPT", part["page.js"])):
        before, after = out.split(f"@{key}@", 1)
        out = before + text + after
    return out.encode()
