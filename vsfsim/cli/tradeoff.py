"""`vsfsim tradeoff`: what a cheaper simulation of a scene costs its readings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import Device, JsonFile, SceneName, Seed, check_choice, picture_option

app = typer.Typer()


@app.command()
def tradeoff(scene: SceneName,
             out: Annotated[Path | None, typer.Option(help="Folder of the results; a run that was interrupted "
                                                           "continues there; default: tradeoff/SCENE.")] = None,
             touches: Annotated[int, typer.Option(min=1, help="Touches of each object, which cover depths and "
                                                              "places.")] = 4,
             objects: Annotated[int, typer.Option(min=1, help="The first so many objects of the scene.")] = 1,
             tier: Annotated[list[str] | None, typer.Option(help="Only this tier; may be given again.")] = None,
             picture: Annotated[Path | None, picture_option("Also draw error against time here.")] = None,
             seed: Seed = 0, device: Device = "cpu", json: JsonFile = None) -> None:
    """Measure what a cheaper simulation of a scene costs its readings.

    The same touches are made at every tier, element size, tolerance and number of frames, and each reading is compared
    with the limit of finer and finer meshes, whose own error is stated. Prints all points, the front among them, and
    what an error of 10 % to 0.2 % costs; writes points.jsonl and the page tradeoff.html.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    loaded = load_scene(find_scene(scene))
    from vsfsim.data.disk import write_figure  # takes seconds; a mistake in the scene is reported before
    from vsfsim.generate.trade import command
    from vsfsim.generate.trade.page import draw
    from vsfsim.physics.tiers import TIERS

    for name in tier or []:
        check_choice("--tier", name, TIERS)
    folder = out or Path("tradeoff") / loaded.name
    with Progress("tradeoff") as progress:
        found = command.tradeoff(loaded, folder, touches=touches, objects=objects, seed=seed, device=device,
                                 tiers_only=tuple(tier or ()), progress=progress)
    if picture is not None:
        write_figure(draw(found.points, f"{found.scene}: {found.what}"), picture)
    report(f"{found.text()}\npage: {folder / 'tradeoff.html'}", found.table(), json)
