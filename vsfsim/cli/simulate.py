"""Commands that simulate: scenes, press, generate, inspect."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, note, report
from vsfsim.cli.options import (
    ArchiveFile,
    Device,
    JsonFile,
    Objects,
    Precision,
    SceneName,
    Seed,
    Tier,
    Touches,
    Views,
    Workers,
    check_choice,
    picture_option,
)
from vsfsim.core.arm_spec import ARM_MODELS

app = typer.Typer()


@app.command()
def scenes() -> None:
    """List the shipped scenes."""
    from vsfsim.core import shelf
    from vsfsim.core.scene import load_scene

    for name, path in shelf.scenes().items():
        scene = load_scene(path)
        kind = "dataset" if "touches" in scene.tree else "press"
        print(f"{name:<22}{kind:<9}{scene.tree.get('description', '')}")
    print(f"families: {', '.join(shelf.families())}")


@app.command()
def press(scene: SceneName, tier: Tier = None, device: Device = "cpu", precision: Precision = "float64", seed: Seed = 0,
          json: JsonFile = None,
          plot: Annotated[Path | None, picture_option("Write a plot of force against depth.")] = None,
          picture: Annotated[Path | None, picture_option("Write a picture of the deformed body at full depth.")] = None,
          save: ArchiveFile = None,
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
        text, numbers, converged = run(loaded, seed=seed, tier=tier, device=device, precision=precision, meshes=refine,
                                       plot=plot, picture=picture, save=save, progress=progress)
    report(text, numbers, json)
    if not converged:
        raise typer.Exit(3)


@app.command()
def generate(scene: SceneName,
             out: Annotated[Path | None, typer.Option(help="Folder of the dataset; default: datasets/SCENE.")] = None,
             objects: Objects = None, views: Views = None, touches: Touches = None, seed: Seed = 0, tier: Tier = None,
             device: Device = "cpu", precision: Precision = "float64",
             renderer: Annotated[str, typer.Option(help="warp or pyrender.")] = "warp",
             arm: Annotated[str | None, typer.Option(help="Arm of a scene with [arm]: gen3 or menagerie; default: the "
                                                          "scene's.")] = None,
             workers: Workers = None) -> None:
    """Make a dataset from a scene, or finish one.

    Run the same command again after an interruption: it makes only what is missing, to the same bits.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    check_choice("--renderer", renderer, ("warp", "pyrender"))
    if arm is not None:
        check_choice("--arm", arm, ARM_MODELS)
    loaded = load_scene(find_scene(scene))
    folder = out or Path("datasets") / loaded.name
    from vsfsim.generate.run import generate as run  # takes seconds; a mistake in the scene is reported before

    began = time.perf_counter()
    with Progress("generate") as progress:
        dataset = run(loaded, folder, seed=seed, objects=objects, views=views, touches=touches, tier=tier,
                      device=device, precision=precision, renderer=renderer, workers=workers, arm=arm,
                      progress=progress, note=note)
    bad = sum(entry.unconverged for entry in dataset.entries)
    print(f"{folder}: {len(dataset)} object views, {sum(e.touches for e in dataset.entries)} touches, "
          f"{sum(e.frames for e in dataset.entries)} frames ({bad} not converged, marked), "
          f"{time.perf_counter() - began:.0f} s")


@app.command()
def inspect(what: Annotated[str, typer.Argument(metavar="DATASET|SCENE", help="Folder of a dataset, or a scene.")],
            out: Annotated[Path | None, picture_option("File to write; default: NAME.png here.", "--out")] = None,
            seed: Seed = 0, device: Device = "cpu") -> None:
    """Draw a dataset, or a scene's object.

    A dataset: its summary and a contact sheet. A scene: a turntable of its object, coloured by Young's modulus.
    """
    from vsfsim.generate import inspect as look

    for line in look.inspect(what, out, seed=seed, device=device):
        print(line)
