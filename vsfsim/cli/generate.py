"""`vsfsim generate`: a dataset on this machine, as a shard beside other machines, or on a cluster."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from vsfsim.cli.cluster import Address, GpusPerTask, On, Printed, ShardOf, Shards, by_shards, check_engine
from vsfsim.cli.console import Progress, note, report
from vsfsim.cli.options import (
    Device,
    JsonFile,
    Objects,
    SceneName,
    Seed,
    Tier,
    Touches,
    Views,
    Workers,
    share_of,
)
from vsfsim.core.errors import Interrupted, Terminated, VsfsimError

app = typer.Typer()


@app.command()
def generate(scene: SceneName,
             out: Annotated[str | None, typer.Option(help="Folder of the dataset, or the address of an object store "
                                                          "(s3://...); default: where a task looks for it, "
                                                          "datasets/SCENE-v1 say, else datasets/SCENE "
                                                          "($VSFSIM_DATASETS in place of datasets).")] = None,
             objects: Objects = None, views: Views = None, touches: Touches = None, seed: Seed = 0, tier: Tier = None,
             device: Device = "cpu",
             renderer: Annotated[str, typer.Option(help="warp or pyrender.")] = "warp",
             arm: Annotated[str | None, typer.Option(help="Arm of a scene with [arm]: gen3 or menagerie; default: the "
                                                          "scene's.")] = None,
             accuracy: Annotated[str | None, typer.Option(metavar="SHARE",
                                                          help="Largest error of the force, e.g. 5%: a pilot on the "
                                                               "first objects chooses tier and element size, and one "
                                                               "touch in ten is audited one level finer.")] = None,
             workers: Workers = None,
             shard: ShardOf = None,
             finish: Annotated[bool, typer.Option("--finish", help="Check what shards have made, and write "
                                                                   "dataset.json.")] = False,
             mixed: Annotated[bool, typer.Option("--mixed", help="Allow machines of several kinds, which round "
                                                                 "otherwise.")] = False,
             poison: Annotated[bool, typer.Option("--poison", help="Leave out a view that fails twice and make the "
                                                                   "others; exit code 4.")] = False,
             on: On = None, address: Address = "auto", gpus_per_task: GpusPerTask = 0.0, shards: Shards = None,
             printed: Printed = False,
             dry_run: Annotated[bool, typer.Option("--dry-run", help="Make nothing: touches, bytes and time, from the "
                                                                     "views of this scene made here before.")] = False,
             machines: Annotated[int, typer.Option(min=1, help="With --dry-run: how many machines like this one.")] = 1,
             price: Annotated[float | None, typer.Option(min=0.0, help="With --dry-run: of an hour of a machine.")
                              ] = None,
             json: JsonFile = None) -> None:
    """Make a dataset from a scene, or finish one.

    Run the same command again after an interruption: it makes only what is missing, to the same bits.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    part = check_engine(on, shard, printed)
    if part and finish:
        raise VsfsimError("--shard and --finish do not go together. Each machine makes a --shard; --finish ends the "
                          "work.")
    loaded = load_scene(find_scene(scene))
    from vsfsim.generate.command import folder_of  # takes seconds; a mistake in the scene is reported before

    began = time.perf_counter()
    counts: dict[str, Any] = {"seed": seed, "objects": objects, "views": views, "touches": touches, "tier": tier,
                              "arm": arm}
    bound = None if accuracy is None else share_of("--accuracy", accuracy)
    folder = folder_of(loaded, out, accuracy=bound, **counts)
    if dry_run:
        from vsfsim.generate.costs import estimate
        from vsfsim.generate.recipe import make_recipe

        recipe = make_recipe(loaded, device=device, renderer=renderer, **counts)
        cost, processes = estimate(recipe, recipe.objects * recipe.views), workers or os.cpu_count() or 1
        report(cost.text(processes, machines, price), cost.table(processes, machines, price), json)
        return
    if on in ("slurm", "k8s"):
        from vsfsim.generate.recipe import make_recipe

        recipe = make_recipe(loaded, device=device, renderer=renderer, **counts)
        logs = Path("slurm-logs") if "://" in str(folder) else Path(folder).with_name(f"{Path(folder).name}-slurm")
        if not by_shards(on, shards or min(100, recipe.objects * recipe.views), logs, printed, int(gpus_per_task),
                         ["--finish"]):
            return
        finish = True
    from vsfsim.generate.command import make
    from vsfsim.generate.run import Share

    share = Share(part, finish, mixed, poison, address if on == "ray" else "", gpus_per_task)
    signal.signal(signal.SIGTERM, _terminated)
    try:
        with Progress("generate") as progress:
            made = make(loaded, folder, device=device, renderer=renderer, workers=workers,
                        share=share, accuracy=bound, progress=progress, note=note, **counts)
    except KeyboardInterrupt as stop:
        raise Interrupted(_kept(folder)) from stop
    seconds = time.perf_counter() - began
    dataset = made.dataset
    if dataset is None:
        report(f"{folder}: shard {part[0]}/{part[1]} made {len(made.names)} object views, {seconds:.0f} s; "  # type: ignore[index]
               f"{made.unfinished} of the dataset are missing"
               + ("" if made.unfinished else "; finish it with the same command and --finish instead of --shard"),
               {"dataset": str(folder), "shard": list(part or ()), "views": len(made.names),
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
    from vsfsim.data.lines import finished_names
    from vsfsim.data.store import open_store

    kept = len(finished_names(open_store(folder)))
    return (f"interrupted; {kept} finished object views are kept in {folder}. Run the same command again to make the "
            f"others." if kept else "interrupted; nothing was finished, so nothing is kept.")


def _terminated(*_: Any) -> NoReturn:
    raise Terminated
