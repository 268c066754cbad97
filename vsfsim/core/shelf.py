"""Where named things lie: scenes, tasks and leaderboard rows are files, methods are entry points."""

from __future__ import annotations

import importlib.metadata
import importlib.resources
from pathlib import Path

from vsfsim.core.errors import SceneError, TaskError, VsfsimError, did_you_mean

METHOD_GROUP = "vsfsim.methods"
EFFECTOR_GROUP = "vsfsim.effectors"


def folder(name: str) -> Path:
    """The folder that holds ``name``: "scenes", "tasks", "baselines" or "leaderboard".

    In a wheel they lie inside the package; an editable install sees the live folders of the checkout.
    """
    return Path(str(importlib.resources.files(f"vsfsim.{name}").joinpath("")))


def checkout() -> Path:
    """The root of the repository that this package runs from.

    Raises:
        VsfsimError: the package was installed without its repository (from a wheel), which has no `benchmarks/`.
    """
    root = Path(__file__).resolve().parents[2]
    if not (root / "benchmarks" / "__init__.py").is_file():
        raise VsfsimError(f"`vsfsim measure` needs a checkout of the repository: its scripts are in the folder "
                          f"benchmarks/, which is not part of the installed "
                          f"package (looked for {root / 'benchmarks'}). Clone the repository and install it with `pip "
                          f"install -e .`.")
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
    """Names of the procedural families: Python files of ``scenes/`` with a function ``build``."""
    return sorted(p.stem for p in folder("scenes").glob("*.py") if not p.stem.startswith("_"))


def _find(given: str, shelf: dict[str, Path], kind: str, error: type[VsfsimError]) -> Path:
    path = Path(given)
    if path.suffix == ".toml":
        if path.is_file():
            return path
        raise error(f"{kind} file '{given}' does not exist. Give the path of a .toml file, or one of: "
                    f"{', '.join(shelf)}.")
    if given in shelf:
        return shelf[given]
    raise error(f"unknown {kind} '{given}'. {did_you_mean(given, shelf)} `vsfsim {kind}s` lists them; a path to a "
                f".toml file works too.")


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
    return {ep.name: ep for ep in importlib.metadata.entry_points(group=METHOD_GROUP)}


def effectors() -> list[str]:
    """Names of the effectors, of what can touch an object: the files of ``vsfsim/generate/effectors/`` (a ``_`` stands
    for a ``-`` of the name), and the entry points of the group ``vsfsim.effectors``."""
    files = (Path(__file__).parents[1] / "generate" / "effectors").glob("*.py")
    shipped = {path.stem.replace("_", "-") for path in files if not path.stem.startswith("_")}
    return sorted(shipped | {ep.name for ep in importlib.metadata.entry_points(group=EFFECTOR_GROUP)})
