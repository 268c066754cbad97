"""Options of the commands: a command is a function whose docstring says what its options are; and the checks of their
values before the work begins."""

from __future__ import annotations

import ast
import copy
import dataclasses
import functools
import inspect
import itertools
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer

from vsfsim.core.errors import MethodError, VsfsimError, one_of
from vsfsim.core.plain_text import file_stem
from vsfsim.core.scene_tables.request import Request

PICTURES = (".png", ".jpg", ".jpeg", ".pdf", ".svg", "")
"""Endings of a picture to write; without one it is a PNG."""
LONGEST_NAME = 200
"""Bytes of a name of a result: what is kept beside it has a longer one, and file systems allow 255."""


def _checked_device(device: str) -> str:
    if device != "cpu":
        from vsfsim.physics.runtime import check_device

        check_device(device)
    return device


def _known_tier(tier: str | None) -> str | None:
    if tier is not None:
        from vsfsim.core.scene_tables.object import Tier

        one_of(tier, [name for name in get_args(Tier) if name != "auto"], "--tier")
    return tier


def _writable(*suffixes: str) -> Callable[[typer.CallbackParam, Path | None], Path | None]:
    """A file that can be written after the work, or "-"; with the name of its format, one of several."""
    def check(param: typer.CallbackParam, path: Path | None) -> Path | None:
        option = param.opts[0]
        if path is None or (str(path) == "-" and not suffixes):
            return path
        if suffixes and path.suffix.lower() not in suffixes:
            raise VsfsimError(f"{option} is '{path}'; it must end in {' or '.join(filter(None, suffixes))}, the format "
                              f"that is written.")
        if not path.parent.is_dir():
            raise VsfsimError(f"{option} is '{path}', but there is no folder '{path.parent}'. Make it first, or choose "
                              f"another place.")
        if path.is_dir():
            raise VsfsimError(f"{option} is '{path}', which is a folder. Give the name of a file in it.")
        _check_unlike_input(option, path)
        return path

    return check


def _check_unlike_input(option: str, path: Path) -> None:
    """A file to write does not take the place of a scene, a task or a method.

    Raises:
        VsfsimError: its name has the ending of one.
    """
    if path.suffix in (".toml", ".py"):
        raise VsfsimError(f"{option} is '{path}', which has the ending of a file that is read, not written. Choose "
                          f"another name.")


def _names(of: str) -> Callable[[str], list[str]]:
    """Completes a word to names of the shelf: "scenes", "tasks" or "methods"."""
    def complete(incomplete: str) -> list[str]:
        from vsfsim.core import shelf

        return [name for name in getattr(shelf, of)() if name.startswith(incomplete)]

    return complete


def _share(text: str | None) -> float | None:
    """A share from "5%" or "0.05".

    Raises:
        VsfsimError: it is neither.
    """
    found = re.fullmatch(r"(\d+\.?\d*|\.\d+)\s*(%?)", text.strip()) if text is not None else None
    if text is not None and found is None:
        raise VsfsimError(f"--accuracy is '{text}'; give a share, e.g. 5% or 0.05.")
    return float(found[1]) * (0.01 if found[2] else 1.0) if found else None


complete_task, complete_method = _names("tasks"), _names("methods")
SceneName = Annotated[str, typer.Argument(metavar="SCENE", autocompletion=_names("scenes"),
                                          help="Name of a scene (`vsfsim list scenes`), or path of its .toml file.")]
Device = Annotated[str, typer.Option(help="Warp device: cpu or cuda:0.", callback=_checked_device)]
Seed = Annotated[int, typer.Option(min=0, help="Root of all random numbers.")]
AtLeastOne = Annotated[int, typer.Option(min=1)]
Several = Annotated[int | None, typer.Option(min=1)]
Workers = Annotated[int | None, typer.Option(min=1, help="Processes; default: one a CPU core, or up to 16 on a GPU.")]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", callback=_writable(), help=(
    "Write the numbers here as JSON; - for standard output, instead of the table."))]
Picture = Annotated[Path | None, typer.Option(metavar="PNG", callback=_writable(*PICTURES))]
ArchiveFile = Annotated[Path | None, typer.Option(metavar="FILE", callback=_writable(".npz"))]
GifFile = Annotated[Path | None, typer.Option(metavar="FILE", callback=_writable(".gif"))]
Shown = Annotated[Path | None, typer.Option(metavar="FILE", callback=_writable(*PICTURES, ".html", ".gif"))]
Folders = Annotated[list[Path] | None, typer.Option(metavar="DIR")]
MethodName = Annotated[str, typer.Argument(metavar="METHOD", autocompletion=complete_method,
                                           help="Name of a method (`vsfsim list methods`), or module:attribute.")]
TaskName = Annotated[str, typer.Option("--task", autocompletion=complete_task,
                                       help="Name of a task (`vsfsim list tasks`), or the path of its .toml file.")]
DatasetFolder = Annotated[Path | None, typer.Option(help=(
    "Folder of the dataset; default: the task's, under datasets/ or $VSFSIM_DATASETS."))]
Parameters = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE",
                                                      help="Parameter of the method; may be given again.")]
ASKED: dict[str, Any] = {
    "seed": Seed, "device": Device, "workers": Workers, "objects": Several, "views": Several, "touches": Several,
    "tier": Annotated[str | None, typer.Option(callback=_known_tier)],
    "allow": Annotated[list[str], typer.Option(metavar="WORD")],
    "limit": Annotated[float | None, typer.Option(min=0.1, metavar="SECONDS")],
    "accuracy": Annotated[str | None, typer.Option(metavar="SHARE", callback=_share)]}
"""What a command line asks of fields of `Request` besides their type."""


def command(app: typer.Typer, name: str | None = None, *, asks: Sequence[str] = (),
            **settings: Any) -> Callable[..., Any]:
    """A function as a command: its keywords are the options, and ``Args:`` of its docstring are their help, each
    ``name (METAVAR): text``. A parameter that is a dataclass has its fields as options, with the text below each.

    Args:
        app: the group. name: of the command, the function's by default. asks: fields of `Request` that are asked.
        settings: of the command, as typer takes them.
    """
    def add(function: Callable[..., None]) -> Callable[..., None]:
        text, _, args = inspect.cleandoc(function.__doc__ or "").partition("\n\nArgs:\n")
        parts = iter(re.split(r"^    (\w+)(?: \((.+?)\))?: ", args, flags=re.MULTILINE)[1:])
        told = {option: (metavar, words) for option, metavar, words in zip(parts, parts, parts, strict=True)}
        own, hints = inspect.signature(function), get_type_hints(function, include_extras=True)
        records = {p: hints[p] for p in own.parameters if dataclasses.is_dataclass(hints[p])}
        options: list[inspect.Parameter] = []
        fields: dict[str, list[Any]] = {}
        for p in own.parameters.values():
            if p.name not in records:
                options.append(_option(p.name, hints[p.name], p.default, *told.get(p.name, (None, ""))))
                continue
            asked, docs = get_type_hints(records[p.name], include_extras=True), field_docs(records[p.name])
            fields[p.name] = [field for field in dataclasses.fields(records[p.name])
                              if records[p.name] is not Request or field.name in asks]
            options += [_option(field.name, ASKED.get(field.name, asked[field.name]), field.default, None,
                                docs[field.name]) for field in fields[p.name]]

        @functools.wraps(function)
        def run(**given: Any) -> None:
            made = {key: records[key](**{field.name: given.pop(field.name) for field in own_fields})
                    for key, own_fields in fields.items()}
            function(**made, **given)

        run.__doc__ = text
        run.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in options}
        app.command(name, **settings)(run)
        return run

    return add


def _option(name: str, hint: Any, default: Any, metavar: str | None, words: str) -> inspect.Parameter:
    """A parameter with typer's description of it: required ones are operands, others options."""
    kind, *infos = get_args(hint) if hasattr(hint, "__metadata__") else (hint,)
    required = default in (inspect.Parameter.empty, dataclasses.MISSING)
    info: Any = copy.copy(infos[0]) if infos else typer.Argument() if required else typer.Option()
    info.metavar, info.help = metavar or info.metavar, " ".join(words.split()) or info.help
    if kind is bool and not infos:
        info.param_decls = (f"--{name}",)  # and no --no-NAME
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=Annotated[kind, info],
                             default=inspect.Parameter.empty if required else default)


def field_docs(kind: type) -> dict[str, str]:
    """What stands below each field of a dataclass."""
    (found,) = ast.parse(inspect.getsource(kind)).body
    assert isinstance(found, ast.ClassDef)
    return {ast.unparse(field.target): ast.literal_eval(text.value)
            for field, text in itertools.pairwise(found.body)
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr)}


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
        VsfsimError: it is a folder, lies below a file, or has the ending of a file that is read.
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
    return path
