"""`vsfsim info`: what this machine has, what is missing, and what to do about it."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import JsonFile
from vsfsim.core.errors import VsfsimError

app = typer.Typer()

Found = tuple[str, str]
"""What was found, and what to do about it, or ""."""


@app.command()
def info(json: JsonFile = None) -> None:
    """Show versions, devices and datasets of this machine, and what to do about each."""
    facts, lines = [], []
    with Progress("info") as progress:
        for number, group in enumerate(GROUPS):
            progress(number, len(GROUPS), group.__name__)
            lines.append(f"{group.__name__}:")
            for name, find in group():
                try:
                    value, todo = find() if callable(find) else find
                except (VsfsimError, ImportError) as error:
                    value, todo = "not usable here", " ".join(str(error).split())
                facts.append({"group": group.__name__, "name": name, "value": value, "todo": todo})
                lines += [f"  {name:<24}{value}", *([f"  {'':<24}-> {todo}"] if todo else [])]
    report("\n".join(lines), facts, json)


Group = Iterator[tuple[str, Found | Callable[[], Found]]]


def versions() -> Group:
    """vsfsim, Python, the system, and every package of the base and of the extras."""
    from vsfsim.core.extras import EXTRA_OF, install_command
    from vsfsim.data.provenance import made_by

    made = made_by()
    yield "vsfsim", (f"{made['vsfsim']}" + (f", commit {made['commit']}" if made["commit"] else ""), "")
    todo = "" if sys.platform == "linux" else ("only scoring, datasets and leaderboards are tested off Linux; "
                                               "docs/limits.md says what is supported")
    yield "system", (f"{platform.platform()}, Python {platform.python_version()}", todo)
    distributions = importlib.metadata.packages_distributions()
    for package in ("numpy", "scipy", "h5py", *EXTRA_OF):
        names = distributions.get(package)
        yield package, ((importlib.metadata.version(names[0]), "") if names else
                        ("not installed", install_command(EXTRA_OF.get(package, "all"))))


def devices() -> Group:
    """The CPU, and what Warp and torch can use."""
    def warp() -> Found:
        from vsfsim.physics.runtime import devices as names

        return "; ".join(names()), "" if len(names()) > 1 else ("no CUDA GPU is seen: the simulator runs on the CPU "
                                                                "(--device cpu, the default)")

    def torch() -> Found:
        from vsfsim.physics.runtime import torch_devices

        return "; ".join(torch_devices()), ""

    threads = os.environ.get("OMP_NUM_THREADS")
    yield "cpu", (f"{os.cpu_count()} cores" + (f", OMP_NUM_THREADS={threads}" if threads else ""), "")
    yield "Warp", warp
    yield "torch", torch


def datasets() -> Group:
    """The datasets of the tasks."""
    from vsfsim.bench.commands.catalogue import tasks

    for folder, task in sorted({task.dataset.folder: task for task in tasks().values()}.items()):
        path = task.dataset.path()
        yield folder, ((_size(path), "") if (path / "dataset.json").is_file() else
                       (f"not in {path.parent}", task.dataset.command()))


GROUPS = (versions, devices, datasets)


def _size(path: Path) -> str:
    return f"{path}, {sum(file.stat().st_size for file in path.rglob('*') if file.is_file()) / 1e6:.1f} MB"
