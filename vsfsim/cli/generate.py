"""`vsfsim generate`: a dataset on this machine, as a shard beside other machines, or on a cluster."""

from __future__ import annotations

import dataclasses
import signal
import time
from pathlib import Path
from typing import Any, NoReturn

import typer

from vsfsim.cli.cluster import Machines
from vsfsim.cli.console import Progress, note, report
from vsfsim.cli.options import JsonFile, SceneName, command
from vsfsim.core.errors import Interrupted, Terminated, VsfsimError
from vsfsim.core.scene_tables.request import Request

app = typer.Typer()


@command(app, asks=("objects", "views", "touches", "seed", "tier", "device", "renderer", "accuracy", "workers",
                    "finish", "mixed", "poison"))
def generate(scene: SceneName, request: Request, machines: Machines, out: str | None = None,
             json: JsonFile = None) -> None:
    """Make a dataset from a scene, or finish one.

    Run the same command again after an interruption: it makes only what is missing, to the same bits.

    Args:
        out: Folder of the dataset, or the address of an object store (s3://...); default: where a task looks for it,
            datasets/SCENE-v1 say, else datasets/SCENE ($VSFSIM_DATASETS in place of datasets).
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    fan = machines.fan()
    part = fan.shard
    if part and request.finish:
        raise VsfsimError("--shard and --finish do not go together. Each machine makes a --shard; --finish ends the "
                          "work.")
    loaded = load_scene(find_scene(scene))
    from vsfsim.generate.run import make, planned  # takes seconds; a mistake in the scene is reported before

    began = time.perf_counter()
    plan = planned(loaded, out, request.but(note=note, fan=fan))
    folder = plan.folder
    if machines.scheduled:
        if not machines.by_shards(min(100, plan.recipe.objects * plan.recipe.views), ["--finish"]):
            return
        request = request.but(finish=True)
    signal.signal(signal.SIGTERM, _terminated)
    try:
        with Progress("generate") as progress:
            made = make(dataclasses.replace(plan, request=plan.request.but(progress=progress, finish=request.finish)))
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
    from vsfsim.data.store import Store

    kept = len(finished_names(Store(folder)))
    return (f"interrupted; {kept} finished object views are kept in {folder}. Run the same command again to make the "
            f"others." if kept else "interrupted; nothing was finished, so nothing is kept.")


def _terminated(*_: Any) -> NoReturn:
    raise Terminated
