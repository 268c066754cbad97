"""The commands of `vsfsim measure` on what can be won on plants."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import report, step
from vsfsim.cli.options import JsonFile

app = typer.Typer(rich_markup_mode=None)


@app.command(name="plant-ceilings")
def plant_ceilings(scene: Annotated[str, typer.Option(help="Scene of plants, with [arm].")] = "plants-v4-mini",
                   objects: Annotated[int | None, typer.Option(min=1, help="Plants; default: the scene's.")] = None,
                   first: Annotated[int, typer.Option(min=0, help="Number of the first plant.")] = 0,
                   touches: Annotated[int, typer.Option(min=26, help="Touches of each plant; the last 15 are "
                                                                     "predicted.")] = 26,
                   jitter: Annotated[list[float] | None, typer.Option(min=0.0, help="RMS displacement of the skeleton "
                                                                                    "[m]; may be given again. Default: "
                                                                                    "0, 0.002 and 0.005.")] = None,
                   shots: Annotated[list[int] | None, typer.Option(min=1, help="Touches that the moduli are fitted to; "
                                                                               "may be given again. Default: 5 and 10.")
                                    ] = None,
                   seed: Annotated[int, typer.Option(min=0, help="Of the dataset.")] = 0,
                   out: Annotated[Path | None, typer.Option(help="Keeps each row, from which a later run goes on; rows "
                                                                 "of other plants that it has are printed, too.")
                                  ] = None,
                   json: JsonFile = None) -> None:
    """The skeleton of a plant off by 0, 2, 5 mm: with its true moduli, and with a modulus a class fitted to touches."""
    from measurements.artificial_plants.ceilings import JITTERS, SHOTS, measure

    found = measure(scene=scene, objects=objects, first=first, touches=touches, shots=shots or SHOTS,
                    jitters=jitter or JITTERS, seed=seed, file=out, progress=step)
    report(found.text(), found.record(), json, indent=1)
