"""What decides a result, by content: the source of a piece of code, and the files that are named beside it.

The source of a module is its own file and every file that it imports, at any depth and also inside functions, as far as
they belong to the same installed package, to vsfsim, or to no installed package at all. Nothing is imported to find
them. Other packages count by their versions.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib.machinery import ModuleSpec, PathFinder
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

_INSTALLED = {"site-packages", "dist-packages"}
"""Folders of installed packages."""


def source_files(module: str, folder: str | Path = "", *, of_vsfsim: Callable[[str], bool] = lambda name: True,
                 others: dict[str, Path] | None = None) -> dict[str, Path]:
    """The files of the source of a module, by the names of their modules; {} if there is none of this name.

    Args:
        module: its dotted name. folder: where modules are looked for besides ``sys.path``. of_vsfsim: which modules of
        vsfsim belong to it, by name. others: filled with the modules of other packages that it names, and their files.
    """
    found: dict[str, Path] = {}
    waiting, top = [module], module.partition(".")[0]
    seen = set(waiting)
    while waiting:
        name = waiting.pop()
        first = name.partition(".")[0]
        look = _own_file if first == "vsfsim" else _file
        file = None if first in sys.stdlib_module_names else look(name, str(folder))
        if file is None or not _counts(file, first, top) or (first == "vsfsim" and not of_vsfsim(name)):
            if file is not None and others is not None:
                others[name] = file
            continue
        found[name] = file
        for used in _imports(file.read_bytes(), name, file.name == "__init__.py"):
            parts = used.split(".")
            for some in (".".join(parts[:k]) for k in range(1, len(parts) + 1)):
                if some not in seen:
                    seen.add(some)
                    waiting.append(some)
    return found


def source_sha256(module: str) -> str:
    """sha256 of the source of a module, "" if there is none of this name."""
    files = source_files(module)
    return files_sha256(files) if files else ""


def files_sha256(files: Mapping[str, Path]) -> str:
    """sha256 of the names and contents of files."""
    lines = "".join(f"{name} {file_sha256(path)}\n" for name, path in sorted(files.items()))
    return hashlib.sha256(os.fsencode(lines)).hexdigest()


def file_sha256(path: Path) -> str:
    """sha256 of a file, hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def named_files(values: Any, folder: str | Path) -> dict[str, Path]:
    """The files that texts in a tree of tables and lists name, by that text; none of /proc and /sys, which the kernel
    makes up as they are read, some without an end.

    Args:
        values: JSON or TOML values. folder: that relative paths are relative to.
    """
    found = {text: Path(folder, Path(text).expanduser()) for text in texts_of(values)}
    # isfile asks nothing of a text that is no name of a file, such as one of 300 letters
    return {text: path.absolute() for text, path in found.items()
            if os.path.isfile(path) and not os.path.realpath(path).startswith(("/proc/", "/sys/"))}


def named_folders(values: Any, folder: str | Path) -> dict[str, Path]:
    """The folders that texts with a slash name, by that text; operands as of `named_files`."""
    found = {one: Path(folder, Path(one).expanduser()) for one in texts_of(values) if "/" in one}
    return {text: path.absolute() for text, path in found.items() if os.path.isdir(path)}


def differences(there: Mapping[str, str], here: Mapping[str, str]) -> list[str]:
    """In words, how the contents ``here`` differ from those ``there``, each a sha256 by name."""
    out = [f"{name} has another content (sha256 {there[name][:12]} there, {here[name][:12]} here)"
           for name in here if name in there and there[name] != here[name]]
    out += [f"{name} was not recorded there" for name in here if name not in there]
    return out + [f"{name} is not found here" for name in there if name not in here]


def texts_of(values: Any) -> Iterator[str]:
    """The texts in a tree of tables and lists."""
    if isinstance(values, str):
        yield values
    elif isinstance(values, (Mapping, list, tuple)):
        for item in values.values() if isinstance(values, Mapping) else values:
            yield from texts_of(item)


def _file(name: str, folder: str) -> Path | None:
    """The source file of a module, found without importing anything; None for a module without one."""
    spec = _module(name, folder)
    return Path(spec.origin).resolve() if spec and spec.origin and spec.origin.endswith(".py") else None


def _module(name: str, folder: str) -> ModuleSpec | None:
    above, _, _ = name.rpartition(".")
    if not above:
        return _spec(name, None, folder)
    package = (_own_module if above.partition(".")[0] == "vsfsim" else _module)(above, folder)
    if package is None or package.submodule_search_locations is None:
        return None
    return _spec(name, package.submodule_search_locations, "")


# What belongs to vsfsim stays where it is while it runs.
_own_module, _own_file = functools.lru_cache(maxsize=8192)(_module), functools.lru_cache(maxsize=8192)(_file)


def _spec(name: str, path: Iterable[str] | None, folder: str) -> ModuleSpec | None:
    if folder:
        found = PathFinder.find_spec(name, [folder])
        if found is not None and found.origin:
            return found
    for finder in sys.meta_path:
        try:
            found = finder.find_spec(name, None if path is None else list(path))
        except Exception:  # a finder of another package may raise anything
            continue
        if found is not None:
            return found
    return None


def _counts(file: Path, package: str, top: str) -> bool:
    """Whether a file counts by its content; one of another installed package counts by the package's version."""
    return package in (top, "vsfsim") or not (_INSTALLED & set(file.parts) or package in _installed(tuple(sys.path)))


@functools.lru_cache(maxsize=8)
def _installed(search: tuple[str, ...]) -> frozenset[str]:
    """Names that packages installed in the folders of ``sys.path`` are imported by; another path has others."""
    return frozenset(packages_distributions())


@functools.lru_cache(maxsize=4096)
def _imports(text: bytes, name: str, is_package: bool) -> tuple[str, ...]:
    """Names of what a source imports; of ``from a import b`` both a and a.b, of which one may be no module."""
    try:
        tree = ast.parse(text)
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        return ()
    out: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            out += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                above = name.split(".")[:len(name.split(".")) - node.level + is_package]
                base = ".".join([*above, *([base] if base else [])])
            out += [base, *(f"{base}.{alias.name}" for alias in node.names if alias.name != "*")] if base else []
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.startswith("vsfsim."):
            named = node.value.partition(":")  # "module:function" of a table
            out += [named[0]] if named[1] else []
    return tuple(dict.fromkeys(out))
