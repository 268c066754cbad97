"""The commands of `vsfsim measure` on how far a press is to be trusted."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import report, step
from vsfsim.cli.options import JsonFile, seconds_of

app = typer.Typer(rich_markup_mode=None)
Cores = Annotated[int | None, typer.Option(min=1, help="Processes; default: one a CPU core.")]


@app.command()
def trust(cells: Annotated[int, typer.Option(min=1, help="Random presses, the first ones of the seed.")] = 50,
          seed: Annotated[int, typer.Option(min=0, help="Of the presses.")] = 0,
          out: Annotated[Path | None, typer.Option(help="File that keeps each press as soon as it is done; a later "
                                                        "run goes on with it.")] = None,
          limit: Annotated[float, typer.Option(min=1.0, help="Processor time of a press, and of its reference [s]; a "
                                                             "cell that takes more is not judged, and "
                                                             "pressed again under a longer one.")] = 30.0,
          budget: Annotated[str | None, typer.Option(metavar="TIME", help="Begin no new press after this time, e.g. "
                                                                          "90s, 10m, 2h.")] = None,
          workers: Cores = None,
          json: JsonFile = None) -> None:
    """Random presses against the same on finer meshes and paths: which are within 5, 10, 30 %, told, or wrong."""
    from measurements.trust import measure

    found = measure(cells, seed, out, limit=limit, workers=workers or os.cpu_count() or 1, progress=step,
                    budget=None if budget is None else seconds_of("--budget", budget))
    report(found.text(), found.record(), json, indent=1)
