"""The commands of `vsfsim measure`: their options, and the script of this folder that each of them calls."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from vsfsim.cli.console import Progress, report, step
from vsfsim.cli.options import Device, JsonFile, Workers, check_choice, seconds_of
from vsfsim.core.errors import TaskError, VsfsimError

app = typer.Typer(rich_markup_mode=None)


def _report(measurement: Any, out: Path | None) -> None:
    """Write a `measurements.measurement.Measurement`."""
    report(measurement.text(), measurement.record(), out, indent=1)


@app.command()
def solver(tier: Annotated[list[str] | None, typer.Option(help="Only this tier; may be given again.")] = None,
           without: Annotated[list[str] | None,
                              typer.Option(help="Press the gate's cells with and without this mechanism; given again: "
                                                "without all of them.")] = None,
           against: Annotated[Path | None,
                              typer.Option(metavar="FILE", help="Compare the gate's cells with a record of --cell "
                                                                "all --json FILE.")] = None,
           cell: Annotated[list[str] | None,
                           typer.Option(help="Press this cell of the gate alone, small for eight quick ones, or all "
                                             "for 40; may be given again.")] = None,
           out: JsonFile = None) -> None:
    """Force error, iterations and CPU time of S1 and S2; or what every mechanism of the solver buys on 40 fixed
    presses."""
    if without or cell or against is not None:
        from measurements.gate.compare import measure as measure_gate

        _report(measure_gate(cell or ("all",), names=without or (), against=against, progress=step), out)
        return
    from measurements.solver import TIERS, measure

    for name in tier or []:
        check_choice("--tier", name, TIERS)
    _report(measure(tier or TIERS, progress=step), out)


@app.command()
def trust(cells: Annotated[int, typer.Option(min=1, help="Presses, the first ones of the seed.")] = 300,
          seed: Annotated[int, typer.Option(min=0, help="Of the presses.")] = 0,
          limit: Annotated[float, typer.Option(min=1.0, help="Processor time of a press [s].")] = 60.0,
          workers: Annotated[int | None, typer.Option(min=1, help="Processes; default: one a CPU core.")] = None,
          out: JsonFile = None) -> None:
    """Random presses against forces that another solver computed: which frames are marked, and how far the others and
    the errors that they are told hold."""
    from measurements.trust import measure

    _report(measure(cells, seed, limit=limit, workers=workers or os.cpu_count() or 1, progress=step), out)


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
    from measurements.plant_ceilings import JITTERS, SHOTS, measure

    found = measure(scene=scene, objects=objects, first=first, touches=touches, shots=shots or SHOTS,
                    jitters=jitter or JITTERS, seed=seed, file=out, progress=step)
    _report(found, json)


@app.command()
def peers(peer: Annotated[list[str] | None, typer.Option(help="Only this one; may be given again.")] = None,
          case: Annotated[list[str] | None, typer.Option(help="S1, S2 or foam; may be given again.")] = None,
          tier: Annotated[str, typer.Option(help="Whose mesh all press: fem-coarse or fem.")] = "fem",
          out: Annotated[Path, typer.Option(help="Folder of their venvs, made on the first run.")] = Path("peers"),
          here: Annotated[bool, typer.Option("--here", help="Use this Python, which has the packages, in place of "
                                                            "venvs.")] = False,
          json: JsonFile = None) -> None:
    """Press S1, S2 and a block of foam in other simulators on our tetrahedra, each in a venv of its own."""
    from measurements.indent import CASES, PEERS, measure

    for name in peer or []:
        check_choice("--peer", name, PEERS)
    for name in case or []:
        check_choice("--case", name, CASES)
    check_choice("--tier", tier, ("fem-coarse", "fem"))
    found = measure(peer or (), case or (), tier=tier, folder=out, here=here, progress=step)
    _report(found, json)


@app.command()
def stability(out: Annotated[Path, typer.Option(help="Folder of the results; a run that was interrupted, or ended by "
                                                     "its budget, continues there.")] = Path("stability"),
              budget: Annotated[str | None, typer.Option(metavar="TIME",
                                                         help="Begin no new cell after this time, e.g. 90s, 10m, 2h; "
                                                              "default: make all cells.")] = None,
              limit: Annotated[float, typer.Option(min=0.1, help="Limit of a frame's processor time [s].")] = 10.0,
              seed: Annotated[int, typer.Option(min=0, help="Of the random cells and of the order.")] = 0,
              kind: Annotated[list[str] | None, typer.Option(help="Only this kind, solid, bubble or rod; may be "
                                                                  "given again.")] = None,
              cell: Annotated[list[str] | None, typer.Option(metavar="KEY",
                                                             help="Only the cell with this key; may be given "
                                                                  "again.")] = None,
              workers: Workers = None,
              device: Device = "cpu",
              json: JsonFile = None) -> None:
    """Press at the extremes of every quantity of a scene, and check every frame that is called converged.

    More than 500 presses: contrast to 1e8, moduli from 100 Pa to 100 GPa, nu from 0 to 0.4999, depth to 90 %, friction
    to 10, sizes from 1 mm to 10 m, all probes, thin and thick, every tier; bubbles, rods.
    Each is converged, not resolved by its mesh, marked with a reason, refused, over its limit, crashed, or wrong in
    silence by an independent check. Exit code 3 if a cell is one of the last three.
    """
    import vsfsim
    from measurements.stability import design, judge
    from measurements.stability import report as results
    from vsfsim.data.provenance import commit

    cells = design.design(seed)
    for name in kind or []:
        check_choice("--kind", name, design.KINDS)
    cells = [c for c in cells if not kind or c.kind in kind]
    for key in cell or []:
        check_choice("--cell", key, [c.key for c in cells])
    if cell:
        cells = [c for c in cells if c.key in cell]
    seconds = None if budget is None else seconds_of("--budget", budget)
    try:
        out.mkdir(parents=True, exist_ok=True)
        circumstances = {"limit": limit, "device": device, "version": vsfsim.__version__, "commit": commit()}
        with Progress("stability") as progress:
            verdicts = judge.run(cells, out / "cells.jsonl", limit=limit, workers=workers or 2, device=device,
                                    budget=seconds, progress=progress, circumstances=circumstances)
    except OSError as error:
        raise VsfsimError(f"--out is '{out}', where nothing can be written ({error.strerror}). Choose another "
                          f"folder.") from None
    verdicts = results.scaled(verdicts)
    settings = {"seed": seed, "limit": limit, "kind": kind, "cells_of_the_design": len(cells),
                "device": device}
    found = results.measurement(verdicts, settings)
    report(found.text(), found.record(), json or out / "stability.json", indent=1)
    if any(v.outcome in judge.BAD for v in verdicts):
        raise typer.Exit(3)


@app.command()
def record(dataset: Annotated[Path, typer.Argument(metavar="PATH", help="Folder of a dataset that a task reads; with "
                                                                        "--again also its record.")],
           task: Annotated[str | None, typer.Option(help="Name of the task; default: every one that reads a dataset of "
                                                         "this folder's name.")] = None,
           again: Annotated[bool, typer.Option("--again", help="The dataset was made on another machine: write into "
                                                               "the record of --task how many touches differ. Results "
                                                               "on data that differ no more are ranked.")] = False
           ) -> None:
    """Write the record of a dataset beside the tasks that it belongs to."""
    from vsfsim.bench.admission import fingerprint
    from vsfsim.bench.admission.admit import again as differing
    from vsfsim.bench.task import load_task, open_dataset
    from vsfsim.core import shelf
    from vsfsim.data.dataset import Dataset

    if again:
        if task is None:
            raise TaskError("--again needs the name of a task: give --task.")
        one = load_task(task)
        if (known := fingerprint.shipped_record(one)) is None:
            raise TaskError(f"task {task} has no record yet. Write one without --again.")
        found = (fingerprint.make_record(one, open_dataset(one, dataset)) if dataset.is_dir()
                 else fingerprint.load_record(dataset))
        measured = differing(found, known)
        fingerprint.save_record(known, path := fingerprint.record_path(one), again=measured)
        print(f"{path}: {100.0 * measured.touches:.3g} % of the touches come to another end, the readings of a view "
              f"are up to {100.0 * measured.size:.2g} % larger or smaller")
        return
    folder = Dataset.open(dataset).path.resolve().name
    wanted = [load_task(task)] if task else [one for one in map(load_task, shelf.tasks())
                                             if one.dataset.folder == folder]
    if not wanted:
        raise TaskError(f"no task reads a dataset called '{folder}'. Name the task with --task.")
    for one in wanted:
        path = fingerprint.record_path(one)
        fingerprint.save_record(made := fingerprint.make_record(one, open_dataset(one, dataset)), path)
        print(f"{path}: {len(made.entries)} views, {sum(len(e.of_touches) for e in made.entries)} touches, "
              f"{path.stat().st_size / 1e3:.0f} kB")
