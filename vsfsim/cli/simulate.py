"""Commands that simulate: press, generate, and `vsfsim lab tradeoff`."""

from __future__ import annotations

import dataclasses
import signal
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from vsfsim.cli import cluster
from vsfsim.cli.console import Progress, note, report
from vsfsim.cli.lab import lab
from vsfsim.cli.options import (
    ArchiveFile,
    AtLeastOne,
    Device,
    GifFile,
    JsonFile,
    Picture,
    SceneName,
    Seed,
    Shown,
    command,
)
from vsfsim.core.errors import Interrupted, Terminated, one_of
from vsfsim.core.scene_tables.request import Request

app = typer.Typer()


@command(app, asks=("tier", "device", "seed", "limit"))
def press(scene: SceneName, request: Request, json: JsonFile = None, plot: Picture = None, picture: Shown = None,
          gif: GifFile = None, save: ArchiveFile = None,
          refine: Annotated[int | None, typer.Option(min=3, max=6)] = None) -> None:
    """Press a probe into an object: force against depth, and whether it can be trusted.

    What the scene leaves out is assumed and printed: without [press] the probe goes down in the middle, a tenth of the
    height deep. Prints a table, or JSON. Exit code 3 if a frame did not converge.

    Args:
        plot: Write a plot of force against depth.
        picture: Write a picture of the deformed body at full depth (.png), or a page of all frames (.html).
        gif: Write the deformed body frame by frame (.gif).
        save: Write mesh, displacements and contact forces of every frame (.npz).
        refine (MESHES): Press 3 to 6 finer and finer meshes: observed order of convergence, extrapolated force and its
            error.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    loaded = load_scene(find_scene(scene))
    with Progress("press") as progress:
        from vsfsim.press.command import press as run  # takes seconds; a mistake in the scene is reported before

        made = run(loaded, request.but(progress=progress), refine=refine)
        words = [made.text()]
        for what, path, write in (("plot", plot, made.plot), ("picture", picture, made.picture),
                                  ("animation", gif, partial(made.gif, progress=progress)), ("saved", save, made.save)):
            if path is not None and path.suffix == ".html":
                from vsfsim.view.command import of_one

                of_one(path, made.scene, made.result)
            elif path is not None:
                write(path)
                words.append(f"{what}: {path}")
    report("\n".join(words), made.table(), json)
    if not made.converged:
        raise typer.Exit(3)


@command(app, asks=("objects", "views", "touches", "seed", "tier", "device", "renderer", "accuracy", "workers",
                    "allow"))
def generate(scene: SceneName, request: Request, out: str | None = None, json: JsonFile = None) -> None:
    """Make a dataset from a scene, or finish one.

    Run the same command again after an interruption: it makes only what is missing, to the same bits.

    Args:
        out: Folder of the dataset, or the address of an object store (s3://...); default: where a task looks for it,
            datasets/SCENE-v1 say, else datasets/SCENE ($VSFSIM_DATASETS in place of datasets).
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    fan = cluster.asked()
    part = list(fan.shard or ())
    loaded = load_scene(find_scene(scene))
    began = time.perf_counter()
    with Progress("generate"):
        from vsfsim.generate.run import make, planned  # takes seconds; a mistake in the scene is reported before

    plan = planned(loaded, out, request.but(note=note, fan=fan, allow=tuple(request.allow)))
    folder = plan.folder
    if cluster.by_shards(min(100, plan.recipe.objects * plan.recipe.views)):
        return
    signal.signal(signal.SIGTERM, _terminated)
    try:
        with Progress("generate") as progress:
            made = make(dataclasses.replace(plan, request=plan.request.but(progress=progress)))
    except KeyboardInterrupt as stop:
        raise Interrupted(_kept(folder)) from stop
    seconds = time.perf_counter() - began
    dataset = made.dataset
    if dataset is None:
        report(f"{folder}: shard {'/'.join(map(str, part))} made {len(made.names)} object views, {seconds:.0f} s; "
               f"{made.unfinished} of the dataset are missing"
               + ("" if made.unfinished else "; the same command without a --shard ends it"),
               {"dataset": str(folder), "shard": part, "views": len(made.names),
                "missing": made.unfinished, "left_out": list(made.left_out), "seconds": seconds}, json)
    else:
        numbers = {"dataset": dataset.origin or str(dataset.path), "sha256": dataset.sha256, "views": len(dataset),
                   "splits": {split: len(dataset.names(split)) for split in dataset.splits},
                   "touches": sum(e.touches for e in dataset.entries), "left_out": list(made.left_out),
                   "frames": sum(e.frames for e in dataset.entries),
                   "unconverged": sum(e.unconverged for e in dataset.entries), "seconds": seconds}
        report(f"{numbers['dataset']}: {len(dataset)} object views, {numbers['touches']} touches, {numbers['frames']} "
               f"frames ({numbers['unconverged']} not converged, marked), {seconds:.0f} s", numbers, json)
    for name, reason in made.left_out.items():
        note(f"{name} failed twice and is left out: {reason}")
    if made.left_out:
        raise typer.Exit(4)


def _kept(folder: Path | str) -> str:
    from vsfsim.data.disk import Store
    from vsfsim.data.lines import FOLDER, TOUCH, finished_names

    kept, tried = len(finished_names(Store(folder))), sum(name.endswith(TOUCH) for name in Store(folder).sizes(FOLDER))
    what = f"{kept} finished object views are" if kept else f"{tried} touches of the pilot are" if tried else ""
    return (f"interrupted; {what} kept in {folder}. Run the same command again to make the others." if what
            else "interrupted; nothing was finished, so nothing is kept.")


def _terminated(*_: Any) -> NoReturn:
    raise Terminated


@command(lab)
def tradeoff(scene: SceneName, out: Path | None = None, touches: AtLeastOne = 4, objects: AtLeastOne = 1,
             tier: list[str] | None = None, picture: Picture = None, seed: Seed = 0, device: Device = "cpu",
             workers: AtLeastOne = 1, json: JsonFile = None) -> None:
    """Measure what a cheaper simulation of a scene costs its readings, in a checkout.

    The same touches are made at every tier, element size, tolerance and number of frames, and each reading is compared
    with the limit of finer and finer meshes, whose own error is stated. Prints all points, the front among them, and
    what an error of 10 % to 0.2 % costs; keeps them in points.jsonl.

    Args:
        out: Folder of the results; a run that was interrupted continues there; default: tradeoff/SCENE.
        touches: Touches of each object, which cover depths and places.
        objects: The first so many objects of the scene.
        tier: Only this tier; may be given again.
        picture: Also draw error against time here.
        workers: Processes that make the limits, whose cost does not count.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import checkout, find_scene

    checkout()
    loaded = load_scene(find_scene(scene))
    from measurements import tradeoff as command  # takes seconds; a mistake in the scene is reported before
    from vsfsim.data.disk import write_figure
    from vsfsim.physics.tiers import TIERS

    for name in tier or []:
        one_of(name, TIERS, "--tier")
    folder = out or Path("tradeoff") / loaded.name
    with Progress("tradeoff") as progress:
        found = command.tradeoff(loaded, folder, touches=touches, objects=objects, seed=seed, device=device,
                                 workers=workers, tiers_only=tuple(tier or ()), progress=progress)
    if picture is not None:
        write_figure(command.draw(found.points, f"{found.scene}: {found.what}"), picture)
    report(found.text(), found.table(), json)
