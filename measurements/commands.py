"""The commands of `vsfsim measure`: their options, and the script of this folder that each of them calls."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from vsfsim.cli.console import Progress, report, step
from vsfsim.cli.options import AtLeastOne, Device, JsonFile, Several, Workers, command
from vsfsim.core.errors import TaskError, one_of

app = typer.Typer(rich_markup_mode=None)
Number = Annotated[int, typer.Option(min=0)]
Names = list[str] | None


def _report(measurement: Any, out: Path | None) -> None:
    """Write a `measurements.measurement.Measurement`."""
    report(measurement.text(), measurement.record(), out, indent=1)


@command(app)
def solver(tier: Names = None, without: Names = None, against: Path | None = None, cell: Names = None,
           out: JsonFile = None) -> None:
    """Force error, iterations and CPU time of S1 and S2; or what every mechanism of the solver buys on 40 fixed
    presses.

    Args:
        tier: Only this tier; may be given again.
        without: Press the gate's cells with and without this mechanism; given again: without all of them.
        against (FILE): Compare the gate's cells with a record of --cell all --json FILE.
        cell: Press this cell of the gate alone, small for eight quick ones, or all for 40; may be given again.
    """
    if without or cell or against is not None:
        from measurements.gate.compare import measure as measure_gate

        _report(measure_gate(cell or ("all",), names=without or (), against=against, progress=step), out)
        return
    from measurements.solver import TIERS, measure

    for name in tier or []:
        one_of(name, TIERS, "--tier")
    _report(measure(tier or TIERS, progress=step), out)


@command(app)
def trust(cells: AtLeastOne = 300, seed: Number = 0, limit: Annotated[float, typer.Option(min=1.0)] = 60.0,
          workers: Several = None, out: JsonFile = None) -> None:
    """Random presses against forces that another solver computed: which frames are marked, and how far the others and
    the errors that they are told hold.

    Args:
        cells: Presses, the first ones of the seed.
        seed: Of the presses.
        limit: Processor time of a press [s].
        workers: Processes; default: one a CPU core.
    """
    from measurements.trust import measure

    _report(measure(cells, seed, limit=limit, workers=workers or os.cpu_count() or 1, progress=step), out)


@command(app)
def gpu(scene: str, device: Device = "cuda:0", objects: Several = None, touches: Several = None,
        workers: Several = None, cores: Annotated[int | None, typer.Option(min=0)] = None,
        out: JsonFile = None) -> None:
    """Frames a second of a scene on a GPU, operations and waits of its host, and the ratio to CPU cores of the same
    machine.

    Args:
        scene: Name of a scene with [touches], or the path of its .toml file.
        objects: Default: the scene's own number.
        touches: Of each view; default: the scene's.
        workers: Processes on the GPU; default: those of `vsfsim generate`.
        cores: Processes that make the same on the CPU; default: one a core, 0: none.
    """
    from measurements.gpu import measure

    _report(measure(scene, device=device, objects=objects, touches=touches, workers=workers, cores=cores,
                    progress=step), out)


@command(app)
def promise(scene: Names = None, touches: AtLeastOne = 61, goal: list[float] | None = None,
            out: Path = Path("promise"), workers: Several = None, json: JsonFile = None) -> None:
    """Whether touches keep an accuracy that was asked for, with the factor of a pilot, and what that costs beside one
    setting for all of them.

    Args:
        scene: Name of a scene with [touches], or the path of its .toml file; may be given again. Default: five.
        touches: Each of an object of its own, under all settings and with a reference.
        goal: Accuracy, 0.05 say; may be given again. Default: 5, 2 and 1 %.
        out: Folder of what was made, which is not made again.
        workers: Processes; default: one a CPU core.
    """
    from measurements.promise import GOALS, SCENES, measure

    _report(measure(scene or SCENES, touches, goals=goal or GOALS, out=out, workers=workers, progress=step), json)


@command(app)
def peers(case: Names = None, tier: str = "fem-coarse", out: Path = Path("peers"), json: JsonFile = None) -> None:
    """Eight presses of known force here and by a direct Newton method, scikit-fem with CHOLMOD, on our tetrahedra.

    Args:
        case: S1, S2, block of foam, box, ball, layered, foam or nu 0.49; may be given again.
        tier: Whose mesh all press: fem-coarse or fem.
        out: Folder of what was made, which is not made again.
    """
    from measurements.peers import CASES, measure

    for name in case or []:
        one_of(name, CASES, "--case")
    one_of(tier, ("fem-coarse", "fem"), "--tier")
    _report(measure(case or (), tier=tier, folder=out, progress=step), json)


@command(app)
def stability(out: Path = Path("stability"), budget: float | None = None,
              limit: Annotated[float, typer.Option(min=0.1)] = 10.0, seed: Number = 0, kind: Names = None,
              cell: Names = None, workers: Workers = None, device: Device = "cpu", json: JsonFile = None) -> None:
    """Press at the extremes of every quantity of a scene, and check every frame that is called converged.

    More than 500 presses: contrast to 1e8, moduli from 100 Pa to 100 GPa, nu from 0 to 0.4999, depth to 90 %, friction
    to 10, sizes from 1 mm to 10 m, all probes, thin and thick, every tier; bubbles, rods.
    Each is converged, not resolved by its mesh, marked with a reason, refused, over its limit, crashed, or wrong in
    silence by an independent check. Exit code 3 if a cell is one of the last three.

    Args:
        out: Folder of the results; a run that was interrupted, or ended by its budget, continues there.
        budget (SECONDS): Begin no new cell after this time; default: make all cells.
        limit: Limit of a frame's processor time [s].
        seed: Of the random cells and of the order.
        kind: Only this kind, solid, bubble or rod; may be given again.
        cell (KEY): Only the cell with this key; may be given again.
    """
    import vsfsim
    from measurements.stability import design, judge
    from measurements.stability import report as results
    from vsfsim.data.provenance import commit

    cells = design.design(seed)
    for name in kind or []:
        one_of(name, design.KINDS, "--kind")
    cells = [c for c in cells if not kind or c.kind in kind]
    for key in cell or []:
        one_of(key, [c.key for c in cells], "--cell")
    if cell:
        cells = [c for c in cells if c.key in cell]
    circumstances = {"limit": limit, "device": device, "version": vsfsim.__version__, "commit": commit()}
    with Progress("stability") as progress:
        verdicts = judge.run(cells, out / "cells.jsonl", circumstances, workers=workers or 2, budget=budget,
                             progress=progress)
    verdicts = results.scaled(verdicts)
    settings = {"seed": seed, "limit": limit, "kind": kind, "cells_of_the_design": len(cells),
                "device": device}
    found = results.measurement(verdicts, settings)
    report(found.text(), found.record(), json or out / "stability.json", indent=1)
    if any(v.outcome in judge.BAD for v in verdicts):
        raise typer.Exit(3)


@command(app)
def record(dataset: Path, task: str | None = None, again: bool = False) -> None:
    """Write the record of a dataset beside the tasks that it belongs to.

    Args:
        dataset (PATH): Folder of a dataset that a task reads; with --again also its record.
        task: Name of the task; default: every one that reads a dataset of this folder's name.
        again: The dataset was made on another machine: write into the record of --task how many touches differ.
            Results on data that differ no more are ranked.
    """
    import msgspec

    from vsfsim.bench.admission import fingerprint
    from vsfsim.bench.admission.admit import apart
    from vsfsim.bench.result_file import read_record, write_record
    from vsfsim.bench.task import load_task, open_dataset
    from vsfsim.core import shelf
    from vsfsim.data.dataset import Dataset

    if again:
        one = load_task(task) if task else None
        if one is None or (known := fingerprint.shipped_record(one)) is None:
            raise TaskError(f"--again needs a task that has a record, and --task is {task}. Write one without --again.")
        found = (fingerprint.make_record(one, open_dataset(one, dataset)) if dataset.is_dir()
                 else read_record(dataset, fingerprint.Record, fingerprint.KIND))
        wrong, _, share = apart(found, known)
        if wrong:
            raise TaskError(f"the two datasets of task {task} are not of the same planned touches: {wrong[0]}. Give "
                            f"one that `vsfsim generate` made on another machine with the operands of the task.")
        write_record(path := fingerprint.record_path(one), msgspec.structs.replace(known, again=share))
        print(f"{path}: {100.0 * share:.3g} % of the touches read otherwise")
        return
    folder = Dataset.open(dataset).path.resolve().name
    wanted = [load_task(task)] if task else [one for one in map(load_task, shelf.tasks())
                                             if one.dataset.folder == folder]
    if not wanted:
        raise TaskError(f"no task reads a dataset called '{folder}'. Name the task with --task.")
    for one in wanted:
        path = fingerprint.record_path(one)
        write_record(path, made := fingerprint.make_record(one, open_dataset(one, dataset)))
        print(f"{path}: {len(made.entries)} views, {path.stat().st_size / 1e3:.0f} kB")
