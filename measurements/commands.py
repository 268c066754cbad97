"""The commands of `vsfsim measure`: their options, and the script of this folder that each of them calls."""

from __future__ import annotations

from dataclasses import replace
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
            fields: Annotated[bool | None,
                              typer.Option(help="Also fit the point VSF, the neural VSF and its fast variant to a "
                                                "buried rope; default: on a GPU.")] = None,
            iterations: Annotated[int | None, typer.Option(min=1,
                                                           help="Of the neural VSF; default: 2,000 on a GPU (1,000 to "
                                                                "3,000 in the paper), 400 on a CPU.")] = None,
            rate: Annotated[float | None, typer.Option(min=1e-6, max=1.0,
                                                       help="Of the neural VSF's training; default: 2e-4, "
                                                            "the paper's.")] = None,
            octaves: Annotated[int, typer.Option(min=1, max=12,
                                                 help="Of the neural VSF's encoding, with --fields.")] = 6,
            export: Annotated[Path | None, typer.Option(metavar="FOLDER",
                                                        help="Also write the workload here: observation matrices, "
                                                             "readings, noise and prior, for estimators "
                                                             "from elsewhere.")] = None,
            device: Annotated[str, typer.Option(help="Torch device: cpu or cuda:0.")] = "cpu",
            out: JsonFile = None) -> None:
    """Time and memory of every estimator beside its literal dense form, at equal answers; and of the fields, with F1
    and size on disk."""
    from measurements import estimators
    from measurements import fields as buried_rope
    from measurements.workload import Workload

    buried_rope.check_device(device)
    sizes = estimators.PAPER if paper else estimators.MINI
    load = Workload.of(*(one or default for one, default in zip((particles, touches, frames), sizes)))
    if export is not None:
        load.export(export)
    found = estimators.measure(load, literal=literal, device=device, progress=step)
    if fields if fields is not None else device != "cpu":
        learning = {"device": device, "iterations": iterations, **({} if rate is None else {"rate": rate})}
        more = buried_rope.measure(**learning, octaves=octaves, progress=step)
        found = replace(found, tables=[*found.tables, *more.tables])
    _report(found, out)
