"""The notebook of the first hour runs from top to bottom, and its method is the tutorial's."""

import ast
import json

import nbformat
import pytest
from pages import ROOT, TUTORIAL, named
from texts import changed

SMALLER = {"resolution = 0.006": "resolution = 0.012", "objects = 4": "objects = 2", "seeds = 3": "seeds = 1",
           "train = 2, test = 2": "train = 1, test = 1", "count = 8": "count = 6", "touches = 8": "touches = 6"}
"""What the cells have, and what runs in its place: the same steps in a third of the time."""
PATH = ROOT / "docs" / "notebooks" / "first_hour.ipynb"


@pytest.fixture(scope="module")
def notebook():
    return nbformat.read(PATH, as_version=4)


def held(folder):
    """What every way through the notebook must have made: a result of its method, to which touches help."""
    result = json.loads((folder / "results" / "blocks-v1" / "near-springs.json").read_text())
    score = {shot: row["mean"] for shot, row in result["scores"]["rmse"].items()}
    assert score["all"] < score["0"], "touches help"


def test_its_cells_run_one_after_the_other(notebook, tmp_path, monkeypatch, here):
    """In this process, as a notebook would run them: the value of a cell's last line is shown."""
    monkeypatch.delenv("VSFSIM_DATASETS", raising=False)
    monkeypatch.chdir(tmp_path)
    names, shown, cells = {}, [], "\0".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    for source in changed(cells, *SMALLER.items()).split("\0"):
        if source.startswith("%%writefile "):
            first, _, text = source.partition("\n")
            (tmp_path / first.split()[1]).write_text(text + "\n")
            continue
        body = ast.parse(source).body
        last = body.pop().value if isinstance(body[-1], ast.Expr) else ast.Constant(None)
        exec(compile(ast.Module(body, []), "cell", "exec"), names)
        shown.append(eval(compile(ast.Expression(last), "cell", "eval"), names))
    assert sum(hasattr(value, "_repr_png_") for value in shown) == 3
    assert sum(hasattr(value, "_repr_html_") for value in shown) >= 5
    held(tmp_path)


def test_it_holds_the_method_of_the_tutorial_and_no_outputs(notebook):
    texts = [cell.source for cell in notebook.cells]
    assert f"%%writefile mine.py\n{named(TUTORIAL, 'mine.py', 'python').rstrip()}" in texts
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in notebook.cells)
