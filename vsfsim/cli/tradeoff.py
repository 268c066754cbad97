"""`vsfsim tradeoff`: what a cheaper simulation of a scene costs its readings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import Device, JsonFile, SceneName, Seed, check_choice, picture_option, seconds_of

app = typer.Typer()


@app.command()
def tradeoff(scene: SceneName,
             out: Annotated[Path | None, typer.Option(help="Folder of the results; a run that was interrupted, or "
                                                           "ended by its budget, continues there; default: "
                                                           "tradeoff/SCENE.")] = None,
             touches: Annotated[int, typer.Option(min=1, help="Touches of each object, which cover depths and places; "
                                                              "seeds of a [press].")] = 4,
             objects: Annotated[int, typer.Option(min=1, help="The first so many objects of the scene.")] = 1,
             tier: Annotated[list[str] | None, typer.Option(help="Only this tier; may be given again.")] = None,
             axis: Annotated[list[str] | None, typer.Option(help="Vary only this: mesh, tolerance, frames, nodes, "
                                                                 "device or together; may be "
                                                                 "given again. Default: all that there are.")] = None,
             budget: Annotated[str | None, typer.Option(metavar="TIME",
                                                        help="Begin nothing new after this time, e.g. 90s, 10m, 2h; "
                                                             "default: make all points.")] = None,
             check: Annotated[Path | None, typer.Option(metavar="FILE", exists=True, dir_okay=False,
                                                        help="Compare with the points.jsonl of an earlier run, costs "
                                                             "by their ratios; exit code 3 where they differ.")] = None,
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
    seconds = None if budget is None else seconds_of("--budget", budget)
    from vsfsim.generate.trade import command  # takes seconds; a mistake in the scene is reported before
    from vsfsim.generate.trade.setting import AXES
    from vsfsim.physics.tiers import TIERS

    for name in tier or []:
        check_choice("--tier", name, TIERS)
    for name in axis or []:
        check_choice("--axis", name, AXES)
    folder = out or Path("tradeoff") / loaded.name
    with Progress("tradeoff") as progress:
        found, changed = command.tradeoff(loaded, folder, touches=touches, objects=objects, seed=seed,
                                          device=device, budget=seconds, tiers_only=tuple(tier or ()),
                                          axes=tuple(axis or ()), check=check, progress=progress)
    if picture is not None and found.points:
        from vsfsim.generate.trade.plot import draw

        draw(found.points, f"{found.scene}: {found.what}", picture)
    page = [f"page: {folder / 'tradeoff.html'}"] * bool(found.points)
    words = [found.text(), *page, *(f"changed: {sentence}" for sentence in changed)]
    report("\n".join(words), {**found.table(), "changed": changed}, json)
    if changed:
        raise typer.Exit(3)
