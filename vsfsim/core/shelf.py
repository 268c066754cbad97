"""Where named things lie: scenes, tasks and leaderboard rows are files, methods are entry points, and tables have rows
of both kinds."""

from __future__ import annotations

import contextlib
import hashlib
import importlib.metadata
import importlib.resources
import os
import sys
import tomllib
from collections import UserDict
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from vsfsim.core.errors import SceneError, TaskError, VsfsimError, did_you_mean, no_such_file, one_of
from vsfsim.core.plain_text import plain
from vsfsim.core.system.content import texts_of

METHOD_GROUP = "vsfsim.methods"
CEILING_GROUP = "vsfsim.ceilings"
FITTED_GROUP = "vsfsim.fitted_ceilings"
EFFECTOR_GROUP = "vsfsim.effectors"
FAMILY_GROUP = "vsfsim.families"
LAW_GROUP = "vsfsim.laws"
CONTACT_LAW_GROUP = "vsfsim.contact_laws"


def folder(name: str) -> Path:
    """The folder that holds ``name``: "scenes", "tasks", "baselines" or "leaderboard".

    In a wheel they lie inside the package; an editable install sees the live folders of the checkout.

    Raises:
        VsfsimError: they are those of another copy than the package.
    """
    found = Path(str(importlib.resources.files(f"vsfsim.{name}").joinpath("")))
    root = Path(__file__).resolve().parents[2]
    if (root / name).is_dir() and (root / "pyproject.toml").is_file() and found.resolve() != root / name:
        raise VsfsimError(f"two copies of vsfsim are mixed: the package is that of '{root}', and its {name} are those "
                          f"of '{found}'. Install the one that is meant (cd '{root}' && pip install -e .), or take it "
                          f"out of PYTHONPATH.")
    return found


def checkout() -> Path:
    """The root of the repository that this package runs from; its folders can be imported afterwards, also by worker
    processes.

    Raises:
        VsfsimError: the package was installed without its repository (from a wheel), which has no `measurements/`.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / "measurements" / "__init__.py").is_file():
        raise VsfsimError(f"This command needs a checkout of the repository, with measurements/ and papers/ in {root}. "
                          "Clone it and install it with `pip install -e .`.")
    sys.path[:] = [*dict.fromkeys([str(root), *sys.path])]
    return root


def _files(name: str) -> dict[str, Path]:
    return {path.stem: path for path in sorted(folder(name).glob("*.toml"))}


def scenes() -> dict[str, Path]:
    """Shipped scene files by name."""
    return _files("scenes")


def tasks() -> dict[str, Path]:
    """Shipped task files by name."""
    return _files("tasks")


def families() -> list[str]:
    """Names of the procedural families: Python files of ``scenes/`` with a function ``build``, and the entry points of
    the group ``vsfsim.families``, each a module with one."""
    return _modules(folder("scenes"), FAMILY_GROUP)


def _modules(place: Path, group: str) -> list[str]:
    """Names of the modules of a folder, but for those that begin with ``_``, and of a group of entry points."""
    shipped = {path.stem for path in place.glob("*.py") if not path.stem.startswith("_")}
    return sorted(shipped | {ep.name for ep in importlib.metadata.entry_points(group=group)})


def loaded(entry: importlib.metadata.EntryPoint, what: str, error: type[VsfsimError] = VsfsimError) -> Any:
    """What an entry point names; ``what`` begins the message.

    Raises:
        VsfsimError: of class ``error``; it cannot be loaded.
    """
    try:
        return entry.load()
    except Exception as problem:  # a module may raise anything while it is imported
        raise error(f"{what} '{plain(entry.name)}' ({plain(entry.value)}, entry point of {entry.group}) cannot be "
                    f"loaded: {type(problem).__name__}: {plain(problem)}. Install its package again, or remove "
                    f"it.") from problem


def family(name: str, where: str) -> ModuleType:
    """The module of a family: of the group ``vsfsim.families``, or a file of ``scenes/``; ``where`` begins messages.

    Raises:
        SceneError: there is none, or it cannot be imported.
    """
    one_of(name, families(), f"{where}: the family", SceneError)
    shipped = importlib.metadata.EntryPoint(name, f"vsfsim.scenes.{name}", FAMILY_GROUP)
    entry = next(iter(importlib.metadata.entry_points(group=FAMILY_GROUP, name=name)), shipped)
    return loaded(entry, f"{where}: the family", SceneError)


def plug_ins(scene: Mapping[str, Any], effector: str) -> list[importlib.metadata.EntryPoint]:
    """The entry points of other packages that a scene uses.

    Args:
        scene: its tables. effector: the name of its effector.
    """
    texts = {effector, *texts_of([scene.get("object", {}), scene.get("probe", {})])}
    return [entry for group in (EFFECTOR_GROUP, FAMILY_GROUP, LAW_GROUP, CONTACT_LAW_GROUP)
            for entry in importlib.metadata.entry_points(group=group) if entry.name in texts]


def _find(given: str, shelf: dict[str, Path], kind: str, error: type[VsfsimError]) -> Path:
    path = Path(given)
    if given in shelf:
        return shelf[given]
    if path.suffix == ".toml" and path.is_file():
        return path
    if path.suffix or len(path.parts) > 1:
        raise error(f"{no_such_file(f'{kind} file (.toml)', given)} Shipped {kind}s are given by name: "
                    f"{', '.join(shelf)}.")
    raise error(f"unknown {kind} '{given}'. {did_you_mean(given, shelf)} `vsfsim list {kind}s` lists them; a path to "
                f"a .toml file works too.")


def find_scene(given: str) -> Path:
    """The file of a scene, by shipped name or by path.

    Raises:
        SceneError: neither.
    """
    return _find(given, scenes(), "scene", SceneError)


def find_task(given: str) -> Path:
    """The file of a task, by shipped name or by path.

    Raises:
        TaskError: neither.
    """
    return _find(given, tasks(), "task", TaskError)


def methods() -> dict[str, importlib.metadata.EntryPoint]:
    """Installed methods by name: entry points of the group ``vsfsim.methods``."""
    with contextlib.suppress(ModuleNotFoundError):  # the sandbox of a method that does not ship shows it none that do
        folder("baselines")  # those that ship are of this copy
    return {**_entries(METHOD_GROUP, tuple(sys.path))}


def ceilings() -> dict[str, importlib.metadata.EntryPoint]:
    """What knows the true object, by name: the entry points of the group ``vsfsim.ceilings``, each a function like
    `vsfsim.generate.resim.again`, and of ``vsfsim.fitted_ceilings``, each like `vsfsim.generate.fem_map.fitted`."""
    shipped = (importlib.metadata.EntryPoint("resim", "vsfsim.generate.resim:again", CEILING_GROUP),
               importlib.metadata.EntryPoint("fem-map", "vsfsim.generate.fem_map:fitted", FITTED_GROUP),
               importlib.metadata.EntryPoint("rod-map", "vsfsim.generate.plants.rod_map:fitted", FITTED_GROUP))
    return {ep.name: ep for group in (CEILING_GROUP, FITTED_GROUP)
            for ep in (*_entries(group, tuple(sys.path)).values(), *(one for one in shipped if one.group == group))}


def effectors() -> list[str]:
    """Names of the effectors, of what can touch an object: the files of ``vsfsim/generate/effectors/``, and the entry
    points of the group ``vsfsim.effectors``."""
    return _modules(Path(__file__).parents[1] / "generate" / "effectors", EFFECTOR_GROUP)


def datasets() -> Path:
    """Where datasets are made and looked for: $VSFSIM_DATASETS, else the folder datasets/ of the current one."""
    return Path(os.environ.get("VSFSIM_DATASETS") or "datasets")


def dataset_folder(scene: str, *, text: str, **recipe: Any) -> Path:
    """Where a dataset goes if nobody says where: the folder in which a task looks for it, else `datasets` / SCENE.

    Args:
        scene: name of the scene.
        text: of the scene file.
        recipe: seed, objects, views, touches and tier of the dataset.
    """
    asked = {"scene": scene, "scene_sha256": hashlib.sha256(text.encode()).hexdigest(), **recipe}
    for path in tasks().values():
        want = tomllib.loads(path.read_text(encoding="utf-8"))["dataset"]
        if all(want.get(key) in (value, None, "", "auto") for key, value in asked.items()):
            return datasets() / want["folder"]
    return datasets() / scene


Row = TypeVar("Row")


class Registry(UserDict[str, Row]):
    """Rows by name. A row of another package is loaded when it is asked for.

    Args:
        group: of the entry points, e.g. "vsfsim.observations". Each is a row, with its ``name``.
        shipped: the rows of this package.

    Raises:
        VsfsimError: from an access, where an entry point cannot be loaded or names another row.
    """

    def __init__(self, group: str, shipped: Mapping[str, Row]):
        super().__init__(shipped)
        self.group = group

    def __missing__(self, name: str) -> Row:
        entry = _entries(self.group, tuple(sys.path))[name]
        row = loaded(entry, "the row")
        if getattr(row, "name", None) != entry.name:
            raise VsfsimError(f"'{plain(entry.name)}' ({plain(entry.value)}, entry point of {self.group}) is the row "
                              f"{plain(getattr(row, 'name', row), longest=80)!r}; the name of the entry point must be "
                              f"that of its row.")
        self.data[name] = row
        return row

    def __contains__(self, name: object) -> bool:
        return name in self.data or name in _entries(self.group, tuple(sys.path))

    def __iter__(self) -> Iterator[str]:
        return iter(dict.fromkeys([*self.data, *_entries(self.group, tuple(sys.path))]))

    def __len__(self) -> int:
        return sum(1 for _ in self)


@lru_cache(maxsize=64)
def _entries(group: str, path: tuple[str, ...]) -> dict[str, importlib.metadata.EntryPoint]:
    """Of a group, as long as the path is ``path``: the metadata of every package are read for it."""
    return {entry.name: entry for entry in importlib.metadata.entry_points(group=group)}
