"""What a score is of, by content: the method's files, the parts of vsfsim that its answers pass through, and the
scorer."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Collection, Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import ceilings, methods
from vsfsim.core.system.content import file_sha256, files_sha256, named_files, named_folders, source_files

METHOD, SCORER = "the method", "the harness"
"""Names of the two digests in `contents_of`."""
_ANSWERS = ("vsfsim.baselines", "vsfsim.vsf", "vsfsim.physics", "vsfsim.generate", "vsfsim.robot",
            "vsfsim.sensing", "vsfsim.active", "vsfsim.core", "vsfsim.bench.observations")
_PLUMBING = ("vsfsim.core.shelf", "vsfsim.core.system", "vsfsim.core.errors", "vsfsim.core.extras",
             "vsfsim.core.plain_text", "vsfsim.core.text_table")
"""Modules of vsfsim, with all below them, that a method's answers pass through, and those of them that answer nothing:
the particle model and the solver count, a message does not."""
_SCORES = ("inclusions", "metrics", "noise", "observations", "protocol", "task", "trials.answers",
           "trials.score", "trials.training")
"""Modules of `vsfsim.bench` that decide what is asked and what an answer scores."""


def contents_of(name: str, parameters: Mapping[str, Any], *, folder: str | Path = "",
                opened: Collection[str] = ()) -> dict[str, str]:
    """What decides a method's answers, each a sha256 by name: `METHOD`, its source; `SCORER`; every file that a
    parameter names; and every other file that its process opened. Nothing of the method is imported.

    Args:
        name: as `vsfsim.bench.method.find_method` takes it, or of a ceiling; it exists. parameters: all of them, as
        JSON values. folder: in which modules and files are looked for; default: the working folder. opened: names of
        files, relative to ``folder`` or absolute, and folders as a parameter names them, of which every file counts;
        what is neither is left out.

    Raises:
        MethodError: a file of such a folder cannot be read; the name of a file is no text.
    """
    folder, here = folder or os.getcwd(), Path(__file__).parent
    files = files_of(name, folder)
    out = {METHOD: files_sha256(files),
           SCORER: files_sha256({part: here / f"{part.replace('.', '/')}.py" for part in _SCORES})}
    named = named_files(dict(parameters), folder)
    seen = {path.resolve() for path in (*named.values(), *files.values())}
    for path in map(Path.resolve, named_files(list(opened), folder).values()):
        if path not in seen:
            named[str(path.relative_to(folder)) if path.is_relative_to(folder) else str(path)] = path
    whole = named_folders(dict(parameters), folder)
    try:
        out |= {text: files_sha256({str(one.relative_to(whole[text])): one for one in named_files(
            list(map(str, whole[text].rglob("*"))), "").values()}) for text in opened if text in whole}
    except OSError as error:
        raise MethodError(f"a folder that a parameter of {name} names cannot be read whole: {error}. Name one whose "
                          f"files stay as they are, and can be read.") from error
    out |= {text: file_sha256(path) for text, path in named.items()}
    if bad := [text for text in out if text.encode(errors="replace").decode() != text]:
        raise MethodError(f"{name} reads {bad[0]!a}. The name is not UTF-8, so that no result can "
                          f"hold it. Rename the file.")
    return out


def changed(name: str, parameters: Mapping[str, Any], contents: Mapping[str, str]) -> list[str]:
    """What decided some answers and is another here, by name; all of a method that is not here.

    Args:
        name, parameters: as of `contents_of`. contents: as it was when the answers were given.
    """
    if ":" not in name and name not in methods() | ceilings():
        return [METHOD]
    here = contents_of(name, parameters, opened=contents)
    return [key for key in {**here, **contents} if here.get(key) != contents.get(key)]


def method_sha256(name: str, folder: str | Path = "") -> str:
    """sha256 of a method's source with the parts of vsfsim that its answers pass through; operands as of
    `contents_of`."""
    return files_sha256(files_of(name, folder))


def files_of(name: str, folder: str | Path = "") -> dict[str, Path]:
    """The files that `method_sha256` is of: modules by their names, and all other files of the method's packages."""
    files = source_files(_module(name), folder or os.getcwd(), of_vsfsim=_passes)
    for package in filter(Path.is_dir, packages_of(files)):
        files |= {f"{package.name}/{path.relative_to(package)}": path
                  for path in named_files(list(map(str, sorted(package.rglob("*")))), "").values()
                  if path.parent.name != "__pycache__"}
    return files


def packages_of(files: Mapping[str, Path]) -> list[Path]:
    """The folders of the packages, besides vsfsim, that modules by name belong to, and the files of other modules."""
    others = {name: path for name, path in files.items() if name.partition(".")[0] != "vsfsim" and "/" not in name}
    return list(dict.fromkeys(
        Path(*path.parts[:len(path.parts) - name.count(".") - (path.name == "__init__.py")])
        for name, path in others.items()))


def imports_of(name: str, folder: str | Path = "") -> dict[str, Path]:
    """The modules of vsfsim and of installed packages that a method's source names, and their files."""
    others: dict[str, Path] = {}
    found = source_files(_module(name), folder or os.getcwd(), of_vsfsim=_passes, others=others)
    return others | {module: path for module, path in found.items() if module.startswith("vsfsim.")}


def named_by(name: str, folder: str | Path = "") -> list[str]:
    """The modules of vsfsim and of installed packages that the files of a method name themselves; of one that ships,
    its own module."""
    others: dict[str, Path] = {}
    module = _module(name)
    source_files(module, folder or os.getcwd(), of_vsfsim=lambda _: False, others=others)
    return [module] if module.startswith("vsfsim.") else list(others)


def versions_of(name: str, folder: str | Path = "") -> dict[str, str]:
    """Versions of the installed packages that a method's source names; they count by these."""
    out = {}
    for top in dict.fromkeys(module.partition(".")[0] for module in imports_of(name, folder)):
        with contextlib.suppress(metadata.PackageNotFoundError):
            out[top] = metadata.version({"warp": "warp-lang", "sklearn": "scikit-learn", "PIL": "pillow"}.get(top, top))
    return out


def package_of(name: str) -> tuple[str, str]:
    """The installed package that a method is from and its version; ("", "") for a file that is not installed."""
    entry = methods().get(name)
    if entry is not None and entry.dist is not None:
        return entry.dist.name, entry.dist.version
    return _installed(_module(name).partition(".")[0])


@functools.cache  # a fifth of a second
def _installed(top: str) -> tuple[str, str]:
    for package in metadata.distributions():  # metadata.packages_distributions() would read every list of files
        called = package.metadata["Name"] or ""
        if top in (package.read_text("top_level.txt") or called.replace("-", "_")).split():
            return called, package.version
    return "", ""


def _module(name: str) -> str:
    return (name if ":" in name else (methods() | ceilings())[name].value).partition(":")[0]


def _passes(module: str) -> bool:
    return any(module == part or module.startswith(f"{part}.") for part in _ANSWERS) and not any(
        module == part or module.startswith(f"{part}.") for part in _PLUMBING)
