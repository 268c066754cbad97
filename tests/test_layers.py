"""The house keeps its floor plan: who may import whom (design.md, section 2), how long a file may be, what it may be
called.

The imports are read from the syntax tree, so those inside functions count too. Only `cli.py` may reach down from there.
"""

import ast
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHIPPED = ("vsfsim", "baselines", "scenes", "benchmarks", "references")
"""Folders with code; the last two stay in the checkout."""
CHECKOUT = ("benchmarks", "references")

MAY_IMPORT = {
    "core": set(),
    "data": {"core"},
    "physics": {"core"},
    "robot": {"core", "data"},
    "sensing": {"core", "data", "physics"},
    "vsf": {"core", "data", "physics"},
    "generate": {"core", "data", "physics", "robot", "sensing", "vsf"},
    "press": {"core", "data", "physics", "robot", "sensing", "generate"},
    "bench": {"core", "data"},
    "baselines": {"core", "data", "bench", "vsf"},
    "scenes": {"core"},
    "tasks": set(),
    "leaderboard": set(),
    "cli": {"core"},  # at the top of the file; see LAZILY
    "benchmarks": {"core", "data", "physics", "robot", "sensing", "vsf", "generate", "press", "bench", "baselines",
                   "references"},
    "references": set(),
    "top": set(),  # vsfsim/__init__.py
}
"""Layers that a layer may import, besides itself."""

LAZILY = {"cli": {"core", "data", "generate", "press", "bench", "baselines", "vsf", "benchmarks"}}
"""Layers that a layer may import inside a function."""

BY_NAME = {"physics": {"scenes"}}
"""Layers whose modules a layer loads by a name that a user gave: a family is a file of scenes/."""

HEAVY = {
    "core": {"numpy"},
    "data": {"numpy", "h5py"},
    "physics": {"numpy", "scipy", "warp", "torch", "trimesh", "pytetwild", "cholespy"},
    "robot": {"numpy", "mujoco"},
    "sensing": {"numpy", "scipy", "warp", "pyrender", "matplotlib"},
    "vsf": {"numpy", "scipy", "warp", "torch"},
    "generate": {"numpy", "scipy", "warp", "matplotlib"},
    "press": {"numpy", "scipy", "warp", "matplotlib"},
    "benchmarks": {"numpy", "scipy", "warp", "torch", "matplotlib"},
    "references": {"numpy", "scipy"},
    "bench": {"numpy", "h5py"},
    "baselines": {"numpy", "scipy", "torch"},
    "scenes": {"numpy"},
    "tasks": set(),
    "leaderboard": set(),
    "cli": {"typer"},
    "top": set(),
}
"""Packages from outside that a layer may import, besides the standard library."""

HEAVY_LAZILY = {"cli": {"warp"}, "robot": {"mujoco_menagerie"}}
"""The same, inside a function: `--device` is checked against the devices that Warp sees; Menagerie's arm is an option,
not a dependency."""

FORBIDDEN_NAMES = ("utils", "util", "common", "manager", "base", "helpers", "misc")
LONGEST = 440  # lines; design.md, house rule 1


def files():
    """Every shipped Python file, relative to the root."""
    return [p.relative_to(ROOT) for top in (*SHIPPED, "tasks", "leaderboard")
            for p in sorted((ROOT / top).rglob("*.py"))]


def layer_of(path: Path) -> str:
    """The row of the table that a file belongs to."""
    if path.parts[0] != "vsfsim":
        return path.parts[0]
    if len(path.parts) > 2:
        return path.parts[1]
    return "top"


def layer_of_module(module: str) -> str:
    """The row of the table that ``vsfsim.x.y`` belongs to."""
    return module.split(".")[1] if "." in module else "top"


def imports(tree: ast.Module, module: str):
    """(line, imported module, inside a function) of every import; ``module`` resolves relative ones and
    `from vsfsim import x`."""
    inside = {id(node) for f in ast.walk(tree) if isinstance(f, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
              for node in ast.walk(f)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield node.lineno, alias.name, id(node) in inside
        elif isinstance(node, ast.ImportFrom):
            origin = node.module or ""
            if node.level:
                origin = ".".join([*module.split(".")[: -node.level], *([origin] if origin else [])])
            for alias in node.names:
                yield node.lineno, f"{origin}.{alias.name}", id(node) in inside
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
            if name in ("import_module", "__import__") and node.args:
                given = node.args[0].values[0] if isinstance(node.args[0], ast.JoinedStr) else node.args[0]
                if isinstance(given, ast.Constant):  # else the name is a user's
                    yield (node.lineno, f"{given.value}{'*' * isinstance(node.args[0], ast.JoinedStr)}",
                           id(node) in inside)


def violations(text: str, path: Path) -> list[str]:
    """What the file ``path`` with this text imports and may not."""
    layer = layer_of(path)
    module = ".".join((path if path.parts[0] in ("vsfsim", *CHECKOUT)
                       else Path("vsfsim") / path).with_suffix("").parts)
    out = []
    for line, imported, in_function in imports(ast.parse(text), module):
        top = imported.split(".")[0]
        if top in ("vsfsim", *CHECKOUT):
            target = layer_of_module(imported) if top == "vsfsim" else top
            if target == "top" or target.startswith("__"):
                continue
            allowed = MAY_IMPORT[layer] | {layer} | (BY_NAME.get(layer, set()) if imported.endswith("*")
                                                     else set()) | (LAZILY.get(layer, set()) if in_function else set())
            if target not in allowed:
                out.append(f"{path}:{line}: {layer} imports {target} ({imported}); it may import "
                           f"{', '.join(sorted(allowed - {layer})) or 'nothing'}")
        elif top not in sys.stdlib_module_names:
            allowed = HEAVY[layer] | (HEAVY_LAZILY.get(layer, set()) if in_function else set())
            if top not in allowed:
                out.append(f"{path}:{line}: {layer} imports {top}; it may import "
                           f"{', '.join(sorted(allowed)) or 'nothing'} and the standard library")
    return out


@pytest.mark.parametrize("path", files(), ids=str)
def test_imports_follow_the_table(path):
    assert violations((ROOT / path).read_text(), path) == []


def test_the_table_knows_every_folder():
    assert {layer_of(path) for path in files()} <= set(MAY_IMPORT) == set(HEAVY)
    assert {p.parent.name for p in (ROOT
                                    / "vsfsim").glob("*/__init__.py")} <= set(MAY_IMPORT), "a new layer needs its row"


@pytest.mark.parametrize(("path", "text", "found"), [
    ("vsfsim/core/shape.py", "import vsfsim.data.records", "core imports data"),
    ("vsfsim/bench/task.py", "def f():\n    from vsfsim.physics import model", "bench imports physics"),
    ("vsfsim/bench/task.py", "from vsfsim import physics", "bench imports physics"),
    ("vsfsim/bench/task.py", "from ..physics import model", "bench imports physics"),
    ("vsfsim/bench/task.py", "import importlib\nimportlib.import_module('vsfsim.physics.model')",
     "bench imports physics"),
    ("vsfsim/bench/task.py", "def f(x):\n    return importlib.import_module(f'vsfsim.physics.{x}')",
     "bench imports physics"),
    ("vsfsim/physics/discretise.py", "import vsfsim.scenes.shoe", "physics imports scenes"),
    ("vsfsim/bench/task.py", "def f():\n    import warp as wp", "bench imports warp"),
    ("vsfsim/physics/model.py", "from vsfsim.data.records import View", "physics imports data"),
    ("vsfsim/vsf/dynamics.py", "from vsfsim.sensing.camera import render", "vsf imports sensing"),
    ("vsfsim/cli/main.py", "from vsfsim.bench.task import load_task", "cli imports bench"),
    ("vsfsim/cli/main.py", "import warp", "cli imports warp"),
    ("scenes/shoe.py", "from vsfsim.physics import sdf", "scenes imports physics"),
    ("baselines/x.py", "from vsfsim.generate.run import generate", "baselines imports generate"),
    ("baselines/x.py", "import requests", "baselines imports requests"),
])
def test_a_violation_is_found(path, text, found):
    (problem,) = violations(text, Path(path))
    assert found in problem


@pytest.mark.parametrize(("path", "text"), [
    ("vsfsim/cli/main.py", "def f():\n    from vsfsim.bench.task import load_task\n    import warp"),
    ("vsfsim/vsf/dynamics.py", "from vsfsim.physics.sdf import reach\nimport warp as wp\nimport json"),
    ("baselines/x.py", "from .vsf_object import Posterior\nimport torch\nfrom vsfsim.bench.method import Action"),
    ("vsfsim/data/hdf5.py", "import vsfsim\nfrom vsfsim import __version__\nimport h5py"),
])
def test_what_is_allowed_passes(path, text):
    assert violations(text, Path(path)) == []


@pytest.mark.parametrize("top", [*SHIPPED, "tests"])
def test_files_are_short_and_named_for_what_they_hold(top):
    for path in sorted((ROOT / top).rglob("*.py")):
        lines = len(path.read_text().splitlines())
        assert lines <= LONGEST, (f"{path.relative_to(ROOT)} has {lines} lines, over {LONGEST}: it holds more "
                                  f"than one idea")
        for part in path.relative_to(ROOT).with_suffix("").parts:
            assert not set(part.strip("_").split("_")) & set(FORBIDDEN_NAMES), (f"{path.relative_to(ROOT)}: '{part}' "
                                                                                f"says nothing; name the idea")
