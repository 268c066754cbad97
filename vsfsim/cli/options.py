"""Options that several commands share, and the checks of their values before the work begins."""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from vsfsim.core.errors import MethodError, VsfsimError, did_you_mean
from vsfsim.core.plain_text import file_stem
from vsfsim.core.scene_tables.request import Request

PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg", "")
"""Endings of a picture to write; without one it is a PNG."""
LONGEST_NAME = 200
"""Bytes of a name of a result: what is kept beside it has a longer one, and file systems allow 255."""


def check_choice(option: str, value: str, allowed: Iterable[str]) -> None:
    """Raises:
        VsfsimError: the value of an option is not among the allowed ones.
    """
    allowed = tuple(allowed)
    if value not in allowed:
        raise VsfsimError(f"{option} is '{value}'. {did_you_mean(value, allowed)}")


def _checked_device(device: str) -> str:
    if device != "cpu":
        from vsfsim.physics.runtime import check_device

        check_device(device)
    return device


def _writable(param: typer.CallbackParam, path: Path | None) -> Path | None:
    """A file that can be written after the work, or "-"."""
    if path is None or str(path) == "-":
        return path
    option = param.opts[0]
    if not path.parent.is_dir():
        raise VsfsimError(f"{option} is '{path}', but there is no folder '{path.parent}'. Make it first, or choose "
                          f"another place.")
    if path.is_dir():
        raise VsfsimError(f"{option} is '{path}', which is a folder. Give the name of a file in it.")
    _check_unlike_input(option, path)
    return path


def _check_unlike_input(option: str, path: Path) -> None:
    """A file to write does not take the place of a scene, a task or a method.

    Raises:
        VsfsimError: its name has the ending of one.
    """
    if path.suffix in (".toml", ".py"):
        raise VsfsimError(f"{option} is '{path}', which has the ending of a file that is read, not written. Choose "
                          f"another name.")


def _ends_in(*suffixes: str) -> Callable[[typer.CallbackParam, Path | None], Path | None]:
    """A file that can be written after the work and has the name of its format, one of several."""
    def check(param: typer.CallbackParam, path: Path | None) -> Path | None:
        if path is not None and path.suffix.lower() not in suffixes:
            raise VsfsimError(f"{param.opts[0]} is '{path}'; it must end in {' or '.join(filter(None, suffixes))}, "
                              f"the format that is written.")
        return _writable(param, path)

    return check


def picture_option(help: str, *names: str, more: Iterable[str] = ()) -> Any:
    """An option for a picture to write, or for a file with one of ``more`` endings."""
    return typer.Option(*names, metavar="PNG", help=help, callback=_ends_in(*PICTURES, *more))


def _names(of: str) -> Callable[[str], list[str]]:
    """Completes a word to names of the shelf: "scenes", "tasks" or "methods"."""
    def complete(incomplete: str) -> list[str]:
        from vsfsim.core import shelf

        return [name for name in getattr(shelf, of)() if name.startswith(incomplete)]

    return complete


complete_task, complete_method = _names("tasks"), _names("methods")

SceneName = Annotated[str, typer.Argument(metavar="SCENE", autocompletion=_names("scenes"),
                                          help="Name of a scene (`vsfsim scenes`), or the path of its .toml file.")]
Tier = Annotated[str | None, typer.Option("--tier",
                                          help="Fidelity, from the cheapest: vsf, linear, fem-coarse, "
                                                         "fem, fem-fine; default: the scene's.")]
Device = Annotated[str, typer.Option("--device", help="Warp device: cpu or cuda:0.", callback=_checked_device)]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Root of all random numbers.")]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", callback=_writable,
                                               help="Write the numbers here as JSON; - for standard output, instead of "
                                                    "the table.")]
ArchiveFile = Annotated[Path | None, typer.Option("--save", metavar="FILE", callback=_ends_in(".npz"),
                                                  help="Write mesh, displacements and contact forces of every frame "
                                                       "(.npz).")]
GifFile = Annotated[Path | None, typer.Option("--gif", metavar="FILE", callback=_ends_in(".gif"),
                                              help="Write the deformed body frame by frame (.gif).")]
PageFile = Annotated[Path | None, typer.Option("--html", metavar="FILE", callback=_writable,
                                               help="File to write, which must not exist; default: NAME.html here.")]
Objects = Annotated[int | None, typer.Option("--objects", min=1, help="How many objects; default: the scene's.")]
Views = Annotated[int | None, typer.Option("--views", min=1, help="Views of each object; default: the scene's.")]
Touches = Annotated[int | None, typer.Option("--touches", min=1, help="Touches of each view; default: the scene's.")]
Workers = Annotated[int | None, typer.Option("--workers", min=1, rich_help_panel="Machines",
                                             help="Processes; default: one a CPU core, or up to 16 on a GPU.")]
Limit = Annotated[float | None, typer.Option("--limit", min=0.1, metavar="SECONDS",
                                             help="Processor time of a frame; one that takes more is marked. Default: "
                                                  "the tier's own, 120, and 1,500 conjugate gradients.")]
Accuracy = Annotated[str | None, typer.Option("--accuracy", metavar="SHARE",
                                              callback=lambda text: text and share_of("--accuracy", text),
                                              help="Largest error of the force, e.g. 5%: a pilot on the first objects "
                                                   "chooses tier and element size, and one touch in ten is audited one "
                                                   "level finer.")]
ASKED: dict[str, Any] = {
    "seed": Seed, "tier": Tier, "device": Device, "objects": Objects, "views": Views, "touches": Touches,
    "workers": Workers, "limit": Limit, "accuracy": Accuracy,
    "renderer": Annotated[str, typer.Option("--renderer", help="warp or pyrender.")],
    "finish": Annotated[bool, typer.Option("--finish", rich_help_panel="Machines",
                                           help="Check what shards have made, and write dataset.json.")],
    "mixed": Annotated[bool, typer.Option("--mixed", rich_help_panel="Machines",
                                          help="Allow machines of several kinds, which round otherwise.")],
    "poison": Annotated[bool, typer.Option("--poison", rich_help_panel="Machines",
                                           help="Leave out a view that fails twice and make the others; exit code "
                                                "4.")]}
"""The option of each field of `Request` that a command may have."""
MethodName = Annotated[str, typer.Argument(metavar="METHOD", autocompletion=complete_method,
                                           help="Name of a method (`vsfsim methods`), or module:attribute.")]
TaskName = Annotated[str, typer.Option("--task", autocompletion=complete_task,
                                       help="Name of a task (`vsfsim tasks`), or the path of its .toml file.")]
DatasetFolder = Annotated[Path | None, typer.Option("--dataset",
                                                    help="Folder of the dataset; default: the task's, under datasets/ "
                                                         "or $VSFSIM_DATASETS.")]
Parameters = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE",
                                                      help="Parameter of the method; may be given again.")]


def asks(*names: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A command whose first operand is a `Request` has the fields ``names`` of it as options."""
    fields = {field.name: field for field in dataclasses.fields(Request)}

    def give(command: Callable[..., None]) -> Callable[..., None]:
        own, hints = inspect.signature(command), get_type_hints(command, include_extras=True)
        options = [inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=fields[name].default,
                                     annotation=ASKED[name]) for name in names]

        @functools.wraps(command)
        def asked(**given: Any) -> None:
            command(Request(**{name: given.pop(name) for name in names}), **given)

        (first, *others) = own.parameters.values()
        asked.__signature__ = own.replace(parameters=[  # type: ignore[attr-defined]
            *(p.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=hints[p.name]) for p in others), *options])
        asked.__annotations__ = {**{name: hint for name, hint in hints.items() if name != first.name},
                                 **{p.name: p.annotation for p in options}}
        return asked

    return give


def share_of(option: str, text: str) -> float:
    """A share from "5%" or "0.05".

    Raises:
        VsfsimError: it is neither.
    """
    found = re.fullmatch(r"(\d+(?:\.\d*)?|\.\d+)\s*(%?)", text.strip())
    if found is None:
        raise VsfsimError(f"{option} is '{text}'; give a share, e.g. 5% or 0.05.")
    return float(found[1]) / (100.0 if found[2] else 1.0)


def seconds_of(option: str, text: str) -> float:
    """A time [s] from a number with s, m or h.

    Raises:
        VsfsimError: it is none, or not over 0.
    """
    found = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([smh])", text.strip())
    if found is None or float(found[1]) <= 0.0:
        raise VsfsimError(f"{option} is '{text}'; give a time with its unit: 90s, 10m or 2h.")
    return float(found[1]) * {"s": 1.0, "m": 60.0, "h": 3600.0}[found[2]]


def parameters_of(words: list[str] | None) -> dict[str, Any]:
    """Values of ``--set key=value``: TOML where it is TOML, else text.

    Raises:
        MethodError: a word without key or equals sign, or with a value that is nested too deep.
    """
    import tomllib

    out: dict[str, Any] = {}
    for word in words or []:
        key, equals, text = word.partition("=")
        if not equals or not key:
            raise MethodError(f"--set {word}: give KEY=VALUE, e.g. --set spacing=0.005.")
        try:
            out[key.strip()] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            out[key.strip()] = text
        except RecursionError:
            raise MethodError(f"--set {key.strip()}: its value is nested too deep.") from None
    return out


def result_path(out: Path | None, task: str, method: str) -> Path:
    """The file of a result; default: results/TASK/METHOD.json.

    Raises:
        VsfsimError: it is a folder, lies below a file, has the ending of a file that is read, or cannot be written.
    """
    path = out or Path("results") / task / f"{file_stem(method)}.json"
    _check_unlike_input("--out", path)
    long = max(path.parts, key=lambda part: len(part.encode(errors="surrogateescape")))
    if len(long.encode(errors="surrogateescape")) > LONGEST_NAME:
        raise VsfsimError(f"--out is '{long[:40]}...', a name of {len(long)} letters; a file name has at most "
                          f"{LONGEST_NAME} bytes here. Choose a shorter one.")
    there = next(folder for folder in path.parents if folder.exists())  # The folders below it are made with the file.
    if path.is_dir() or not there.is_dir():
        raise VsfsimError(f"--out is '{path}', but '{path if path.is_dir() else there}' is "
                          f"{'a folder' if path.is_dir() else 'no folder'}. Choose another place.")
    if not os.access(path if path.exists() else there, os.W_OK) or (path.exists() and not os.access(there, os.W_OK)):
        raise VsfsimError(f"--out is '{path}', but '{there}' cannot be written. Choose another place.")
    return path
