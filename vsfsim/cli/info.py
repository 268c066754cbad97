"""`vsfsim info`: what this machine has, what is missing, and what to do about it."""

from __future__ import annotations

import dataclasses
import os
import platform
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import JsonFile
from vsfsim.core.errors import VsfsimError

app = typer.Typer()


@dataclass(frozen=True)
class Fact:
    """One line."""

    group: str
    """"versions", "devices", "renderers", "caches", "weights" or "datasets"."""
    name: str
    """What it is about."""
    value: str
    """What was found."""
    todo: str = ""
    """What to do about it, or ""."""
    size: int | None = None
    """Bytes on disk, of caches and datasets."""


@app.command()
def info(json: JsonFile = None) -> None:
    """Show versions, devices, renderers, caches, weights and datasets of this machine, and what to do about each."""
    facts: list[Fact] = []
    with Progress("info") as progress:
        for number, group in enumerate(GROUPS):
            progress(number, len(GROUPS), group.__name__)
            facts += group()
    width = max(len(fact.name) for fact in facts) + 2
    lines: list[str] = []
    for fact in facts:
        if not any(fact.group == line.rstrip(":") for line in lines):
            lines.append(f"{fact.group}:")
        lines.append(f"  {fact.name:<{width}}{fact.value}")
        if fact.todo:
            lines.append(f"  {'':<{width}}-> {fact.todo}")
    report("\n".join(lines), [dataclasses.asdict(fact) for fact in facts], json)


def versions() -> Iterator[Fact]:
    """vsfsim, Python, the system, and every package of the base and of the extras."""
    import importlib.metadata

    from vsfsim.core.extras import EXTRA_OF, install_command
    from vsfsim.data.provenance import made_by

    made = made_by()
    yield Fact("versions", "vsfsim", f"{made['vsfsim']}" + (f", commit {made['commit']}" if made["commit"] else ""))
    todo = "" if sys.platform == "linux" else ("only scoring, datasets and leaderboards are tested off Linux; "
                                               "docs/limits.md says what is supported")
    yield Fact("versions", "system", f"{platform.platform()}, Python {platform.python_version()}", todo)
    distributions = importlib.metadata.packages_distributions()
    for package in ("numpy", "scipy", "h5py", *EXTRA_OF):
        names = distributions.get(package, [])
        if names:
            yield Fact("versions", package, importlib.metadata.version(names[0]))
        else:
            yield Fact("versions", package, "not installed", install_command(EXTRA_OF.get(package, "all")))


def devices() -> Iterator[Fact]:
    """The CPU, and what Warp and torch can use."""
    threads = os.environ.get("OMP_NUM_THREADS")
    yield Fact("devices", "cpu", f"{os.cpu_count()} cores" + (f", OMP_NUM_THREADS={threads}" if threads else ""))
    found = _try("devices", "Warp", _warp_devices)
    yield found
    yield _try("devices", "torch", _torch_devices)


def _warp_devices() -> Fact:
    from vsfsim.physics.runtime import devices as of_warp

    names = of_warp()
    todo = "" if len(names) > 1 else "no CUDA GPU is seen: the simulator runs on the CPU (--device cpu, the default)"
    return Fact("devices", "Warp", "; ".join(names), todo)


def _torch_devices() -> Fact:
    from vsfsim.physics.runtime import torch_devices

    return Fact("devices", "torch", "; ".join(torch_devices()))


def renderers() -> Iterator[Fact]:
    """The ray caster, and pyrender with its GL library."""
    def warp() -> Fact:
        from vsfsim.sensing import render_warp  # noqa: F401  (its import is the test)

        return Fact("renderers", "warp", "works; needs no GL library (--renderer warp, the default)")

    def pyrender() -> Fact:
        from vsfsim.sensing.render_pyrender import load_pyrender

        load_pyrender()
        return Fact("renderers", "pyrender", f"works, by {os.environ.get('PYOPENGL_PLATFORM', 'the default platform')}")

    yield _try("renderers", "warp", warp)
    yield _try("renderers", "pyrender", pyrender)


def caches() -> Iterator[Fact]:
    """Folders that may be deleted: compiled kernels, meshes and bubbles."""
    def meshes() -> Fact:
        from vsfsim.physics.disk_cache import folder

        return _folder("meshes", folder(), "may be deleted; $XDG_CACHE_HOME moves it")

    def kernels() -> Fact:
        from vsfsim.physics.runtime import kernel_cache

        return _folder("kernels", kernel_cache(), "may be deleted (the next run compiles, for minutes); "
                                                  "$WARP_CACHE_PATH moves it")

    yield _try("caches", "meshes", meshes)
    yield _try("caches", "kernels", kernels)


def weights() -> Iterator[Fact]:
    """DINOv2's, for the features of SBML."""
    for size in ("small", "base"):
        def found(size: str = size) -> Fact:
            from vsfsim.vsf.features.dinov2 import find_weights

            return Fact("weights", f"dinov2 {size}", str(find_weights(size)))

        yield _try("weights", f"dinov2 {size}", found, missing="not found (only --set features=dinov2-... needs it)")


def datasets() -> Iterator[Fact]:
    """The datasets of the tasks."""
    from vsfsim.bench.commands.catalogue import tasks

    wanted = {task.dataset.folder: task for task in tasks().values()}
    for folder, task in sorted(wanted.items()):
        path = task.dataset.path()
        if (path / "dataset.json").is_file():
            yield dataclasses.replace(_folder(folder, path, ""), group="datasets")
        else:
            yield Fact("datasets", folder, f"not in {path.parent}", task.dataset.command())


GROUPS = (versions, devices, renderers, caches, weights, datasets)


def _try(group: str, name: str, find: Callable[[], Fact], *, missing: str = "not usable") -> Fact:
    """What ``find`` says, or its error as what to do."""
    try:
        return find()
    except (VsfsimError, ImportError) as error:
        return Fact(group, name, missing, " ".join(str(error).split()))


def _folder(name: str, path: Path, todo: str) -> Fact:
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file()) if path.is_dir() else 0
    return Fact("caches", name, f"{path}, {size / 1e6:.1f} MB", todo if size else "", size)
