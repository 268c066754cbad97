"""The architecture of the code: which layer may import which, no import circles, sizes and names of files and folders.

The imports are read from the syntax tree, so those inside functions count too. Only `cli` may import other layers
there.
"""

import ast
import functools
import graphlib
import re
import sys
from collections import Counter
from pathlib import Path

import pytest
from pages import CONTRIBUTING

ROOT = Path(__file__).parents[1]
SHIPPED = ("vsfsim", "baselines", "scenes", "measurements", "papers", "references")
"""Folders with code; the last three stay in the checkout."""
CHECKOUT = ("measurements", "papers", "references")

MAY_IMPORT = {layer: set(given.split(", ")) - {"nothing"} for layer, given in re.findall(
    r"(\w+)  +(nothing|\w+(?:, \w+)*)(?=  |$)", re.findall(r"```\n(.*?)```", CONTRIBUTING, re.DOTALL)[1], re.MULTILINE)}
MAY_IMPORT |= {"cli": {"core"}, "scenes": {"core"}, "leaderboard": set(), "references": set(), "top": {"cli"},
               "measurements": {*MAY_IMPORT, "baselines", "scenes", "references", "cli"}}
"""Layers that a layer may import, besides itself, by the table of CONTRIBUTING; "top" is `vsfsim/__init__.py` and
`vsfsim/__main__.py`."""

LAZILY = {"cli": {"core", "data", "physics", "sensing", "generate", "press", "view", "bench", "baselines", "vsf",
                  "papers", "measurements"},
          "tasks": {"bench"}, "top": {"data", "bench", "generate", "press", "tasks"}}
"""Layers that a layer may import inside a function, or for types alone. `vsfsim.tasks()` is a function of `bench`."""

BY_NAME = {"physics": {"scenes"}}
"""Layers whose modules a layer loads by a name that a user gave: a family is a file of scenes/."""

PHYSICS = ({"laws", "elements"}, {"linear", "mesh"}, {"contact"}, {"solve"}, {"bubble", "inverse", "rods"})
"""Folders of `vsfsim/physics`: one imports those of its own row and of the rows before."""

HEAVY = {
    "core": {"numpy", "scipy", "filelock", "msgspec"},
    "data": {"numpy", "h5py", "msgspec", "filelock"},
    "physics": {"numpy", "scipy", "filelock", "warp", "torch", "trimesh", "pytetwild"},
    "robot": {"numpy", "scipy", "mujoco"},
    "sensing": {"numpy", "scipy", "warp", "trimesh", "pyrender", "matplotlib"},
    "vsf": {"numpy", "scipy", "warp", "torch", "trimesh", "sklearn"},
    "generate": {"numpy", "scipy", "warp"},
    "press": {"numpy", "scipy", "warp", "matplotlib", "PIL"},
    "view": {"numpy", "scipy", "jinja2"},
    "measurements": {"numpy", "scipy", "msgspec", "warp", "torch", "trimesh", "matplotlib", "typer", "skfem", "cvxopt",
                   "embreex", "open3d", "OpenGL", "pyrender"},
    "references": {"numpy", "scipy", "torch", "timm", "skfem"},
    "bench": {"numpy", "scipy", "h5py", "msgspec", "jinja2", "markupsafe"},
    "active": {"numpy", "gymnasium"},
    "papers": {"numpy", "scipy", "typer"},
    "baselines": {"numpy", "scipy", "torch"},
    "scenes": {"numpy", "msgspec"},
    "tasks": set(),
    "leaderboard": set(),
    "cli": {"typer"},
    "top": set(),
}
"""Packages from outside that a layer may import, besides the standard library."""

HEAVY_IN = {"vsfsim/data/torch_view.py": {"torch"}}
"""The same for one file, which nothing imports at its top: a class that inherits from one of the package's."""

HEAVY_LAZILY = {"core": {"rich", "matplotlib", "ray", "jinja2"},
                "data": {"matplotlib", "fsspec", "pyarrow", "PIL", "jinja2", "scipy"}, "generate": {"yaml", "matio"},
                "sensing": {"matplotlib"}}
"""The same, inside a function: rich would take half of the time of `vsfsim --help`."""

FORBIDDEN_NAMES = ("utils", "util", "common", "manager", "base", "helpers", "misc")
LONGEST = 400  # lines
MOST_MODULES = 20  # at one level of a folder
MOST_FLOORS = {"bench": 8}  # of a layer: modules that import one another in a row


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


def is_for_types(node: ast.AST) -> bool:
    """Whether this is ``if TYPE_CHECKING:``."""
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@functools.cache
def imports(text: str, module: str):
    """(line, imported module, inside a function or for types alone) of every import in a file's text; ``module``
    resolves relative ones and `from vsfsim import x`."""
    out = []
    todo = [(node, False) for node in ast.parse(text).body]
    while todo:
        node, inside = todo.pop()
        inside = (inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                  or is_for_types(node))
        todo += [(child, inside) for child in ast.iter_child_nodes(node)]
        if isinstance(node, ast.Import):
            out += [(node.lineno, alias.name, inside) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            origin = node.module or ""
            if node.level:
                origin = ".".join([*module.split(".")[: -node.level], *([origin] if origin else [])])
            out += [(node.lineno, f"{origin}.{alias.name}", inside) for alias in node.names]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
            if name in ("import_module", "__import__") and node.args:
                given = node.args[0].values[0] if isinstance(node.args[0], ast.JoinedStr) else node.args[0]
                if isinstance(given, ast.Constant):  # else the name is a user's
                    out.append((node.lineno, f"{given.value}{'*' * isinstance(node.args[0], ast.JoinedStr)}", inside))
    return tuple(sorted(out))


def violations(text: str, path: Path) -> list[str]:
    """What the file ``path`` with this text imports and may not."""
    layer = layer_of(path)
    module = module_name(path)
    out = []
    for line, imported, in_function in imports(text, module):
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
            allowed = HEAVY[layer] | HEAVY_IN.get(str(path), set()) | (HEAVY_LAZILY.get(layer, set()) if in_function
                                                                       else set())
            if top not in allowed:
                out.append(f"{path}:{line}: {layer} imports {top}; it may import "
                           f"{', '.join(sorted(allowed)) or 'nothing'} and the standard library")
    return out


def module_name(path: Path) -> str:
    """The dotted name under which a shipped file is imported; of a package, the package's."""
    root = path if path.parts[0] in ("vsfsim", *CHECKOUT) else Path("vsfsim") / path
    return ".".join(root.with_suffix("").parts).removesuffix(".__init__")


def below(texts: dict[str, str]) -> dict[str, set[str]]:
    """The modules that each module imports, at any depth of nesting and under TYPE_CHECKING as well.

    Args:
        texts: source of every module by its dotted name.
    """
    out = {}
    for name, text in texts.items():
        out[name] = set()
        for _, imported, _ in imports(text, name):
            while imported and imported not in texts:
                imported = imported.rpartition(".")[0]
            out[name] |= {imported} - {"", "vsfsim", name}
    return out


def floors(texts: dict[str, str]) -> dict[str, int]:
    """The most modules that import one another in a row, down from each of them; a circle is a `graphlib.CycleError`
    with its modules."""
    graph, out = below(texts), {}
    for name in graphlib.TopologicalSorter(graph).static_order():
        out[name] = 1 + max((out[other] for other in graph[name]), default=0)
    return out


def test_imports_follow_the_table():
    assert [v for path in files() for v in violations((ROOT / path).read_text(), path)] == []


def test_folders_of_physics_import_one_way():
    row = {folder: k for k, folders in enumerate(PHYSICS) for folder in folders}
    for path in files():
        own = row.get(path.parts[2]) if path.parts[:2] == ("vsfsim", "physics") else None
        if own is not None:
            given = [name.split(".")[2] for _, name, _ in imports((ROOT / path).read_text(), module_name(path))
                     if name.startswith("vsfsim.physics.")]
            assert [name for name in given if row.get(name, 0) > own] == [], path


def test_no_modules_import_one_another_and_no_layer_has_too_many_floors():
    texts = {module_name(path): (ROOT / path).read_text() for path in files()}
    floors(texts)
    for layer, most in MOST_FLOORS.items():
        own = {module_name(path) for path in files() if layer_of(path) == layer and path.name != "__init__.py"}
        high = {name: floor for name, floor in floors({name: texts[name] for name in own}).items() if floor > most}
        assert high == {}, f"{layer} has more than {most} floors; move down what a module takes from the one below"


def test_files_are_short_and_named_for_what_they_hold_and_no_folder_is_crowded():
    paths = [path.relative_to(ROOT) for top in (*SHIPPED, "tests") for path in sorted((ROOT / top).rglob("*.py"))]
    for path in paths:
        assert len((ROOT / path).read_text().splitlines()) <= LONGEST, f"{path} holds more than one idea"
        words = {word for part in path.with_suffix("").parts for word in part.strip("_").split("_")}
        assert not words & set(FORBIDDEN_NAMES), f"{path}: the name says nothing; name the idea"
    counts = Counter(path.parent for path in {*paths, *files()} if path.name != "__init__.py")
    assert {folder: n for folder, n in counts.items() if n > MOST_MODULES} == {}, "they need inner walls"


def test_the_table_knows_every_folder():
    assert {layer_of(path) for path in files()} <= set(MAY_IMPORT) == set(HEAVY)
    outside = {path.parent.name for path in ROOT.glob("*/*.py")} - {"vsfsim", "tests", "docs"}
    assert outside <= set(MAY_IMPORT), "a folder with code needs its row"
    packages = {p.parent.name for p in (ROOT / "vsfsim").glob("*/__init__.py")}
    assert packages <= set(MAY_IMPORT), "a new layer needs its row"


PLANTED = [
    ("vsfsim/core/shape.py", "import vsfsim.data.records", "core imports data"),
    ("vsfsim/bench/task.py", "def f():\n    from vsfsim.physics import model", "bench imports physics"),
    ("vsfsim/bench/task.py", "from ..physics import model", "bench imports physics"),
    ("vsfsim/bench/task.py", "import importlib\nimportlib.import_module('vsfsim.physics.model')",
     "bench imports physics"),
    ("vsfsim/physics/mesh/discretise.py", "import vsfsim.scenes.shoe", "physics imports scenes"),
    ("vsfsim/bench/task.py", "def f():\n    import warp as wp", "bench imports warp"),
    ("vsfsim/cli/main.py", "from vsfsim.bench.task import load_task", "cli imports bench"),
    ("vsfsim/__init__.py", "from vsfsim.bench.task import Task", "top imports bench"),
    ("baselines/x.py", "from vsfsim.generate.run import generate", "baselines imports generate"),
]
"""File, text and the violation that must be found in it."""

def test_planted_violations_are_found():
    for path, text, found in PLANTED:
        (problem,) = violations(text, Path(path))
        assert found in problem


def test_planted_circles_and_floors_are_found():
    straight = {"vsfsim.a": "from vsfsim import b", "vsfsim.b": "from vsfsim.c import x", "vsfsim.c": "import vsfsim"}
    assert floors(straight) == {"vsfsim.a": 3, "vsfsim.b": 2, "vsfsim.c": 1}
    for back in ("def f():\n    from vsfsim.a import x", "from . import a",
                 "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from vsfsim.a import x"):
        with pytest.raises(graphlib.CycleError, match=r"vsfsim\.a"):
            floors({**straight, "vsfsim.c": back})
