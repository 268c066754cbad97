"""Functions of `vsfsim/physics` that no shipped scene and no cell of the gate runs: `vsfsim measure unused`.

Each scene is pressed, or touched once, in this process, while the interpreter tells of every call. What Warp compiles
it never calls: a kernel counts once it is launched, and a Warp function once a function that counts names it.
"""

from __future__ import annotations

import ast
import sys
import threading
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple
from unittest import mock

import warp as wp

import vsfsim
from measurements.gate.cells import CELLS, press
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene, scenes
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe

PHYSICS = Path(vsfsim.__file__).parent / "physics"


class Function(NamedTuple):
    """A function of a file."""

    file: str
    name: str
    """With the classes and functions that it stands in."""
    lines: int
    compiled: bool
    """Whether Warp compiles it."""
    names: frozenset[str]
    """What it and the functions in it name."""


def functions(folder: Path = PHYSICS) -> list[Function]:
    """All functions of a folder."""
    def inside(node: ast.AST, path: Path, above: str) -> Iterator[Function]:
        for child in ast.iter_child_nodes(node):
            whole = above
            if isinstance(child, (ast.FunctionDef, ast.ClassDef)):
                whole = f"{above}.{child.name}" if above else child.name
            if isinstance(child, ast.FunctionDef):
                used = {n.attr if isinstance(n, ast.Attribute) else n.id for n in ast.walk(child)
                        if isinstance(n, (ast.Name, ast.Attribute))}
                of_warp = any(ast.unparse(d).startswith(("wp.kernel", "wp.func")) for d in child.decorator_list)
                yield Function(str(path), whole, (child.end_lineno or 0) - child.lineno + 1, of_warp, frozenset(used))
            yield from inside(child, path, whole)

    return [one for path in sorted(folder.rglob("*.py")) for one in inside(ast.parse(path.read_text()), path, "")]


@contextmanager
def watched() -> Iterator[set[tuple[str, str]]]:
    """File and name of every function that is called in this block, and of every kernel that is launched."""
    ran = set[tuple[str, str]]()

    def note(code: Any) -> None:
        ran.add((code.co_filename, code.co_qualname.replace("<locals>.", "")))

    def hook(frame: FrameType, event: str, _: Any) -> None:
        if event == "call":
            note(frame.f_code)

    def noting(launch: Callable[..., Any]) -> Callable[..., Any]:
        def noted(kernel: Any, *operands: Any, **more: Any) -> Any:
            note(kernel.func.__code__)
            return launch(kernel, *operands, **more)

        return noted

    with mock.patch.object(wp, "launch", noting(wp.launch)), mock.patch.object(
            wp, "launch_tiled", noting(wp.launch_tiled)):
        threading.setprofile(hook)
        sys.setprofile(hook)
        try:
            yield ran
        finally:
            sys.setprofile(None)
            threading.setprofile(None)


def unused(found: Sequence[Function], ran: Collection[tuple[str, str]]) -> list[Function]:
    """Those of some functions that nobody ran."""
    used = {one for one in found if (one.file, one.name) in ran}
    new = used
    while new:
        names = frozenset().union(*(one.names for one in new))
        new = {one for one in found if one.compiled and one not in used and one.name.rpartition(".")[2] in names}
        used = used | new
    return [one for one in found if one not in used]


def measure(scene: Sequence[str] = (), *, progress: Progress = lambda _: None) -> Measurement:
    """What the scenes (all that ship, and the gate's cells, where none is named) leave unused."""
    failed = []
    with watched() as ran:
        for name in scene or scenes():
            progress(name)
            loaded = load_scene(find_scene(name))
            effector = effector_of(loaded.sample(0))
            try:
                if "press" in loaded.tree:
                    vsfsim.press(loaded)
                if "touches" in loaded.tree:
                    recipe = make_recipe(loaded, objects=1, views=1, touches=1)
                    effector.make_view(jobs_of(recipe, loaded.path, Path())[0], device="cpu")
            except VsfsimError as error:
                failed.append(f"{name}: {error}")
        for cell in () if scene else CELLS:
            progress(f"cell {cell.name}")
            press(cell)
    rows = [{"file": str(Path(one.file).relative_to(PHYSICS)), "name": one.name, "lines": one.lines,
             "compiled": "kernel" if one.compiled else ""} for one in unused(functions(), ran)]
    return Measurement.of("unused", {"scene": list(scene)}, [Table(
        f"{len(rows)} functions of vsfsim/physics that nobody ran, {sum(row['lines'] for row in rows)} lines", (
            Column("file", "file"), Column("name", "function"), Column("compiled", "by Warp"),
            Column("lines", "lines", "1")), rows, name="functions")], notes=failed)
