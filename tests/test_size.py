"""What a reader has to read, room by room, may only fall.

`size.json` has a row for each room: files, functions, and lines of code (without docstrings, comments and blank
lines; a long line counts once for every 100 characters that it begins). `python tests/test_size.py` lowers the rows
to what stands now; it never raises one.
"""

import ast
import json
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TABLE = Path(__file__).with_name("size.json")
PHYSICS = ("contact", "solve", "linear", "rods", "mesh")
"""Folders of physics that are rooms of their own."""
HAS_DOCSTRING = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


def count(text: str) -> tuple[int, int]:
    """Functions and lines of code of a module's text."""
    rows, functions, prose = text.splitlines(), 0, set()
    code = {k for k, row in enumerate(rows, start=1) if row.strip() and not row.lstrip().startswith("#")}
    for node in ast.walk(ast.parse(text)):
        functions += isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef))
        if isinstance(node, HAS_DOCSTRING) and ast.get_docstring(node, clean=False) is not None:
            prose |= set(range(node.body[0].lineno, node.body[0].end_lineno + 1))
        elif isinstance(node, (ast.Constant, ast.JoinedStr)):  # an empty line of a text is one
            code |= set(range(node.lineno, node.end_lineno + 1))
    return functions, sum(1 + max(len(rows[k - 1]) - 1, 0) // 100 for k in code - prose)


def room(path: str) -> str:
    """The room of a file: its top folder, a folder of `vsfsim`, or a large folder of physics."""
    parts = path.split("/")
    if parts[0] != "vsfsim" or len(parts) < 3:
        return parts[0] if len(parts) > 1 else "top"
    deep = len(parts) > 3 and parts[1] == "physics" and parts[2] in PHYSICS
    return "/".join(parts[:3 if deep else 2])


def sizes() -> dict[str, list[int]]:
    """Room -> files, functions and lines of code of the files that git knows."""
    listed = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("not a git checkout")
    table = defaultdict(lambda: [0, 0, 0])
    for name in listed.stdout.split():
        if (ROOT / name).exists():
            for k, amount in enumerate((1, *count((ROOT / name).read_text(encoding="utf-8")))):
                table[room(name)][k] += amount
    return dict(sorted(table.items()))


def grown(now: dict[str, list[int]], rows: dict[str, list[int]]) -> list[str]:
    """What is above its row, a sentence each."""
    names = ("files", "functions", "lines of code")
    return [f"{place}: {is_now} {name}, and its row in tests/size.json allows {row}; take as much out of it as goes in"
            for place, counts in now.items()
            for name, is_now, row in zip(names, counts, rows.get(place, [0, 0, 0])) if is_now > row]


def test_no_room_grows():
    assert grown(sizes(), json.loads(TABLE.read_text())) == []


def test_a_room_that_grew_is_named_and_prose_is_not_counted():
    text = '"""Module."""\n\n# why\ndef f():\n    """Doc\n    string."""\n    return [1,\n            2]\n'
    assert count(text) == (1, 3)
    assert count("x = '" + "a" * 200 + "'\n") == (0, 3)
    assert room("vsfsim/physics/solve/newton.py") == "vsfsim/physics/solve" and room("vsfsim/__init__.py") == "vsfsim"
    assert grown({"a": [1, 2, 30], "new": [1, 0, 0]}, {"a": [1, 2, 29]}) == [
        "a: 30 lines of code, and its row in tests/size.json allows 29; take as much out of it as goes in",
        "new: 1 files, and its row in tests/size.json allows 0; take as much out of it as goes in"]


if __name__ == "__main__":
    old = json.loads(TABLE.read_text()) if TABLE.exists() else {}
    lowered = {k: [min(a, b) for a, b in zip(v, old.get(k, v))] for k, v in sizes().items()}
    TABLE.write_text("{\n" + ",\n".join(f"  {json.dumps(k)}: {json.dumps(v)}" for k, v in lowered.items()) + "\n}\n")
