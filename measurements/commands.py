"""The commands of `vsfsim measure`: their options, and the script of this folder that each of them calls."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from vsfsim.cli.console import report, step
from vsfsim.cli.options import Device, JsonFile, check_choice

app = typer.Typer(rich_markup_mode=None)


def _report(measurement: Any, out: Path | None) -> None:
    """Write a `measurements.measurement.Measurement`."""
    report(measurement.text(), measurement.record(), out, indent=1)


@app.command()
def solver(device: Device = "cpu",
           tier: Annotated[list[str] | None, typer.Option(help="Only this tier; may be given again.")] = None,
           touches: Annotated[int | None, typer.Option(min=1,
                                                       help="Touches of a batch; default: 4 on a CPU, 256 (linear: "
                                                            "4096) on a GPU.")] = None,
           compare: Annotated[bool,
                              typer.Option(help="On a GPU: run a few touches on the CPU as well and compare "
                                                "the forces.")] = True,
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
    """Force error, iterations, back-solve and assembly times of every tier, and touches a second of a batch;
    or what every mechanism of the solver buys on 40 fixed presses."""
    if without or cell or against is not None:
        from measurements.gate.compare import measure as measure_gate

        _report(measure_gate(cell or ("all",), names=without or (), against=against, progress=step), out)
        return
    from measurements.solver import TIERS, measure

    for name in tier or []:
        check_choice("--tier", name, TIERS)
    _report(measure(device=device, tier=tuple(tier) if tier else None, touches=touches, compare=compare, progress=step),
            out)


@app.command()
def methods(paper: Annotated[bool,
                             typer.Option("--paper",
                                          help="The paper's size: 20,000 particles, 60 touches, 900 frames.")] = False,
            particles: Annotated[int | None, typer.Option(min=1,
                                                          help="Particles of the model, about; default 2,000.")] = None,
            touches: Annotated[int | None, typer.Option(min=1,
                                                        help="Touches of a dome of 217 vertices; default 100.")] = None,
            frames: Annotated[int | None, typer.Option(min=2, help="Frames of a touch; default 20.")] = None,
            literal: Annotated[bool,
                               typer.Option(help="Also run each estimator's literal dense form; it takes most "
                                                 "of the time.")] = True,
            device: Annotated[str, typer.Option(help="Torch device: cpu or cuda:0.")] = "cpu",
            out: JsonFile = None) -> None:
    """Time and memory of every estimator beside its literal dense form, at equal answers."""
    from measurements import estimators
    from measurements.workload import Workload

    sizes = estimators.PAPER if paper else estimators.MINI
    load = Workload.of(*(one or default for one, default in zip((particles, touches, frames), sizes)))
    _report(estimators.measure(load, literal=literal, device=device, progress=step), out)


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
