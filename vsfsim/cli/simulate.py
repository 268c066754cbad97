"""Commands that simulate or show: scenes, press, inspect, view, tradeoff."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import (
    ArchiveFile,
    AtLeastOne,
    Device,
    GifFile,
    JsonFile,
    PageFile,
    Picture,
    SceneName,
    Seed,
    check_choice,
    command,
)
from vsfsim.core.scene_tables.request import Request

app = typer.Typer()


@command(app)
def scenes(json: JsonFile = None) -> None:
    """List the shipped scenes."""
    from vsfsim.core import shelf
    from vsfsim.core.scene import load_scene

    rows = []
    for name, path in shelf.scenes().items():
        tree = load_scene(path).tree
        rows.append({"scene": name, "kind": "dataset" if "touches" in tree else "press",
                     "description": tree.get("description", "")})
    lines = [f"{row['scene']:<22}{row['kind']:<9}{row['description']}" for row in rows]
    families = shelf.families()
    report("\n".join([*lines, f"families: {', '.join(families)}"]), {"scenes": rows, "families": families}, json)


@command(app, asks=("tier", "device", "seed", "limit"))
def press(scene: SceneName, request: Request, json: JsonFile = None, plot: Picture = None, picture: Picture = None,
          gif: GifFile = None, save: ArchiveFile = None,
          refine: Annotated[int | None, typer.Option(min=3, max=6)] = None) -> None:
    """Press a probe into an object: force against depth, and whether it can be trusted.

    What the scene leaves out is assumed and printed: without [press] the probe goes down in the middle, a tenth of the
    height deep. Prints a table, or JSON. Exit code 3 if a frame did not converge.

    Args:
        plot: Write a plot of force against depth.
        picture: Write a picture of the deformed body at full depth.
        gif: Write the deformed body frame by frame (.gif).
        save: Write mesh, displacements and contact forces of every frame (.npz).
        refine (MESHES): Press 3 to 6 finer and finer meshes: observed order of convergence, extrapolated force and its
            error.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    loaded = load_scene(find_scene(scene))
    from vsfsim.press.command import press as run  # takes seconds; a mistake in the scene is reported before

    with Progress("press") as progress:
        made = run(loaded, request.but(progress=progress), refine=refine)
        words = [made.text()]
        for what, path, write in (("plot", plot, made.plot), ("picture", picture, made.picture),
                                  ("animation", gif, partial(made.gif, progress=progress)), ("saved", save, made.save)):
            if path is not None:
                write(path)
                words.append(f"{what}: {path}")
    report("\n".join(words), made.table(), json)
    if not made.converged:
        raise typer.Exit(3)


@command(app)
def inspect(what: str, out: Picture = None, seed: Seed = 0, device: Device = "cpu", shot: str = "",
            json: JsonFile = None) -> None:
    """Draw a dataset, a scene's object, or where a method errs.

    A dataset: its summary and a contact sheet. A scene: a turntable of its object, coloured by Young's modulus. A
    result of `vsfsim evaluate`: errors by object and by touch, the worst first; `vsfsim view` draws them.

    Args:
        what (DATASET|SCENE|RESULT): Folder of a dataset, a scene, or a result file (.json).
        out: File to write; default: NAME.png here.
        shot: Number of touches at which a result's errors are sorted; default: the one that ranks.
    """
    if Path(what).suffix == ".json":
        from vsfsim.bench.commands.inspect_result import inspect_result

        report(*inspect_result(Path(what), shot=shot), json)
        return
    from vsfsim.generate import inspect as look

    with Progress("inspect") as progress:
        lines, numbers = look.inspect(what, out, seed=seed, device=device, progress=progress)
    report("\n".join(lines), numbers, json)


@command(app)
def view(what: str, html: PageFile = None, objects: AtLeastOne = 12, rerun: Path | None = None, seed: Seed = 0,
         json: JsonFile = None) -> None:
    """Write a page to look at a dataset, a scene's object, or a result, in a browser.

    The page is one file that needs no network: the object coloured by Young's modulus, to be turned and cut; touches,
    forces and pressures frame by frame; the RGB-D picture. Of a scene it holds object 0 of the seed. Of a result of
    `vsfsim evaluate` it holds the true and the estimated stiffness side by side, and after `evaluate --keep
    predictions` the predicted readings over the true ones.

    Args:
        what (DATASET|SCENE|RESULT): Folder of a dataset, a scene, or a result file (.json).
        html: File to write, which must not exist; default: NAME.html here.
        objects: Object views of a dataset or result shown, at most.
        rerun (FILE): Also write a recording (.rrd) for the Rerun viewer; needs the extra 'rerun'.
    """
    from vsfsim.view.command import view as run

    with Progress("view") as progress:
        lines, numbers = run(what, html, objects=objects, seed=seed, rerun=rerun, progress=progress)
    report("\n".join(lines), numbers, json)


@command(app)
def tradeoff(scene: SceneName, out: Path | None = None, touches: AtLeastOne = 4, objects: AtLeastOne = 1,
             tier: list[str] | None = None, picture: Picture = None, seed: Seed = 0, device: Device = "cpu",
             json: JsonFile = None) -> None:
    """Measure what a cheaper simulation of a scene costs its readings.

    The same touches are made at every tier, element size, tolerance and number of frames, and each reading is compared
    with the limit of finer and finer meshes, whose own error is stated. Prints all points, the front among them, and
    what an error of 10 % to 0.2 % costs; writes points.jsonl and the page tradeoff.html.

    Args:
        out: Folder of the results; a run that was interrupted continues there; default: tradeoff/SCENE.
        touches: Touches of each object, which cover depths and places.
        objects: The first so many objects of the scene.
        tier: Only this tier; may be given again.
        picture: Also draw error against time here.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    loaded = load_scene(find_scene(scene))
    from vsfsim.data.disk import write_figure  # takes seconds; a mistake in the scene is reported before
    from vsfsim.generate.trade import command
    from vsfsim.physics.tiers import TIERS

    for name in tier or []:
        check_choice("--tier", name, TIERS)
    folder = out or Path("tradeoff") / loaded.name
    with Progress("tradeoff") as progress:
        found = command.tradeoff(loaded, folder, touches=touches, objects=objects, seed=seed, device=device,
                                 tiers_only=tuple(tier or ()), progress=progress)
    if picture is not None:
        write_figure(command.draw(found.points, f"{found.scene}: {found.what}"), picture)
    report(f"{found.text()}\npage: {folder / 'tradeoff.html'}", found.table(), json)
