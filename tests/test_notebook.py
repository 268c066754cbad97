"""The notebook of the first hour runs from top to bottom, and its method is the README's."""

import copy
import json
import os
import sys

import nbformat
import pytest
from nbclient import NotebookClient
from pages import README, ROOT, named

PATH = ROOT / "docs" / "notebooks" / "first_hour.ipynb"


@pytest.fixture(scope="module")
def notebook():
    return nbformat.read(PATH, as_version=4)


def test_it_runs_from_top_to_bottom(notebook, tmp_path, monkeypatch):
    """In a minute once the kernels are compiled; the limit is that of one cell, with everything to compile."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(path for path in sys.path if path))
    where = {"metadata": {"path": str(tmp_path)}}
    done = NotebookClient(copy.deepcopy(notebook), timeout=170, resources=where).execute()
    outputs = [output for cell in done.cells if cell.cell_type == "code" for output in cell.outputs]
    kinds = [kind for output in outputs for kind in output.get("data", {})]
    assert kinds.count("image/png") == 3 and kinds.count("text/html") >= 5
    result = json.loads((tmp_path / "results" / "blocks-v1" / "near-springs.json").read_text())
    score = {shot: row["mean"] for shot, row in result["scores"]["rmse"].items()}
    print(score)
    assert score["all"] < score["0"], "touches help"


def test_it_holds_the_method_of_the_readme_and_no_outputs(notebook):
    texts = [cell.source for cell in notebook.cells]
    assert f"%%writefile mine.py\n{named(README, 'mine.py', 'python').rstrip()}" in texts
    assert all(not cell.get("outputs") and cell.get("execution_count") is None for cell in notebook.cells)
