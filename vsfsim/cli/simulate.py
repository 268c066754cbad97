"""Commands that simulate: scenes, press, inspect."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import (
    ArchiveFile,
    Device,
    GifFile,
    JsonFile,
    PageFile,
    SceneName,
    Seed,
    asks,
    picture_option,
)
from vsfsim.core.scene_tables.request import Request

app = typer.Typer()


@app.command()
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


@app.command()
@asks("tier", "device", "seed", "limit")
def press(request: Request, scene: SceneName, json: JsonFile = None,
          plot: Annotated[Path | None, picture_option("Write a plot of force against depth.")] = None,
          picture: Annotated[Path | None, picture_option("Write a picture of the deformed body at full depth.")] = None,
          gif: GifFile = None, save: ArchiveFile = None,
          refine: Annotated[int | None, typer.Option(min=3, max=6, metavar="MESHES",
                                                     help="Press 3 to 6 finer and finer meshes: observed order of "
                                                          "convergence, extrapolated force and its error.")] = None
          ) -> None:
    """Press a probe into an object: force against depth, and whether it can be trusted.

    What the scene leaves out is assumed and printed: without [press] the probe goes down in the middle, a tenth of the
    height deep. Prints a table, or JSON. Exit code 3 if a frame did not converge.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    loaded = load_scene(find_scene(scene))
    from vsfsim.press.command import press as run  # takes seconds; a mistake in the scene is reported before

    with Progress("press") as progress:
        made = run(loaded, request.but(progress=progress), refine=refine)
    words = [made.text()]
    if plot is not None:
        made.plot(plot)
        words.append(f"plot: {plot}")
    if picture is not None:
        made.picture(picture)
        words.append(f"picture: {picture}")
    if gif is not None:
        with Progress("press") as progress:
            made.gif(gif, progress=progress)
        words.append(f"animation: {gif}")
    if save is not None:
        made.save(save)
        words.append(f"saved: {save}")
    report("\n".join(words), made.table(), json)
    if not made.converged:
        raise typer.Exit(3)


@app.command()
def inspect(what: Annotated[str, typer.Argument(metavar="DATASET|SCENE|RESULT",
                                                help="Folder of a dataset, a scene, or a result file (.json).")],
            out: Annotated[Path | None, picture_option("File to write; default: NAME.png here.", "--out")] = None,
            seed: Seed = 0, device: Device = "cpu",
            shot: Annotated[str, typer.Option(help="Number of touches at which a result's errors are sorted; default: "
                                                   "the one that ranks.")] = "",
            json: JsonFile = None) -> None:
    """Draw a dataset, a scene's object, or where a method errs.

    A dataset: its summary and a contact sheet. A scene: a turntable of its object, coloured by Young's modulus. A
    result of `vsfsim evaluate`: errors by object and by touch, the worst first; `vsfsim view` draws them.
    """
    if Path(what).suffix == ".json":
        from vsfsim.bench.commands.inspect_result import inspect_result

        report(*inspect_result(Path(what), shot=shot), json)
        return
    from vsfsim.generate import inspect as look

    with Progress("inspect") as progress:
        lines, numbers = look.inspect(what, out, seed=seed, device=device, progress=progress)
    report("\n".join(lines), numbers, json)


@app.command()
def view(what: Annotated[str, typer.Argument(metavar="DATASET|SCENE|RESULT",
                                           help="Folder of a dataset, a scene, or a result file (.json).")],
         html: PageFile = None,
         objects: Annotated[int, typer.Option(min=1, help="Object views of a dataset or result shown, at most.")] = 12,
         rerun: Annotated[Path | None, typer.Option(metavar="FILE", help="Also write a recording (.rrd) for the Rerun "
                                                                        "viewer; needs the extra 'rerun'.")] = None,
         seed: Seed = 0, json: JsonFile = None) -> None:
    """Write a page to look at a dataset, a scene's object, or a result, in a browser.

    The page is one file that needs no network: the object coloured by Young's modulus, to be turned and cut; touches,
    forces and pressures frame by frame; the RGB-D picture. Of a scene it holds object 0 of the seed. Of a result of
    `vsfsim evaluate` it holds the true and the estimated stiffness side by side, and after `evaluate --keep
    predictions` the predicted readings over the true ones.
    """
    from vsfsim.view.command import view as run

    with Progress("view") as progress:
        lines, numbers = run(what, html, objects=objects, seed=seed, rerun=rerun, progress=progress)
    report("\n".join(lines), numbers, json)
