"""The commands of `vsfsim measure` on datasets and scenes."""

from __future__ import annotations

from typing import Annotated

import typer

from vsfsim.cli.console import report, step
from vsfsim.cli.options import Device, JsonFile

app = typer.Typer(rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Datasets."""


@app.command()
def faults(kills: Annotated[int, typer.Option(min=1, help="At random moments, of a run and of a worker.")] = 3,
           seed: Annotated[int, typer.Option(help="Of the moments.")] = 0, json: JsonFile = None) -> None:
    """Faults that making a dataset survives: kills, SIGTERM, a full disk, a read-only place, two writers, the clock.

    Exit code 2 if one is not survived.
    """
    from measurements.datasets.faults import measure, text

    rows = measure(kills=kills, seed=seed, progress=step)
    report(text(rows), rows, json)
    raise typer.Exit(0 if all(row["survived"] for row in rows) else 2)


@app.command("compile")
def compiling(scene: Annotated[list[str] | None,
                               typer.Argument(metavar="[SCENE]...", help="Names or paths; default: a plant, a shoe and "
                                                                         "a bubble on a shoe.")] = None,
              card: Annotated[bool, typer.Option(help="Compile for a card, too, which needs none.")] = True,
              out: JsonFile = None) -> None:
    """Seconds to compile the kernels of a scene from nothing, module by module, for a CPU and for a card."""
    from measurements.datasets.compiling import measure

    found = measure(scene or (), card=card, progress=step)
    report(found.text(), found.record(), out, indent=1)


@app.command()
def gpu(scene: Annotated[str, typer.Argument(help="Name of a scene with [touches], or the path of its .toml file.")],
        device: Device = "cuda:0",
        objects: Annotated[int | None, typer.Option(min=1, help="Default: the scene's own number.")] = None,
        touches: Annotated[int | None, typer.Option(min=1, help="Of each view; default: the scene's.")] = None,
        workers: Annotated[int | None, typer.Option(min=1, help="Processes on the GPU; default: those of "
                                                                "`generate`.")] = None,
        cores: Annotated[int | None, typer.Option(min=0, help="Processes that make the same on the CPU; default: one a "
                                                              "core, 0: none.")] = None,
        json: JsonFile = None) -> None:
    """Frames a second of a scene on a GPU, its load, and the ratio to CPU cores of the same machine."""
    from measurements.datasets.card import measure

    found = measure(scene, device=device, objects=objects, touches=touches, workers=workers, cores=cores, progress=step)
    report(found.text(), found.record(), json, indent=1)
