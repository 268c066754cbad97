"""`vsfsim stability`: presses at the extremes of every quantity, by `measurements/stability/` of a checkout."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import Device, JsonFile, Workers, check_choice, seconds_of
from vsfsim.core.errors import VsfsimError
from vsfsim.core.shelf import checkout

app = typer.Typer()


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
    checkout()
    import vsfsim
    from measurements.stability import campaign, design
    from measurements.stability import report as results
    from measurements.stability.judge import Outcome
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
            verdicts = campaign.run(cells, out / "cells.jsonl", limit=limit, workers=workers or 2, device=device,
                                    budget=seconds, progress=progress, circumstances=circumstances)
    except OSError as error:
        raise VsfsimError(f"--out is '{out}', where nothing can be written ({error.strerror}). Choose another "
                          f"folder.") from None
    verdicts = results.scaled(verdicts)
    settings = {"seed": seed, "limit": limit, "kind": kind, "cells_of_the_design": len(cells),
                "device": device}
    found = results.measurement(verdicts, settings)
    report(found.text(), found.record(), json or out / "stability.json", indent=1)
    if any(v.outcome in (Outcome.WRONG, Outcome.CRASHED, Outcome.LATE) for v in verdicts):
        raise typer.Exit(3)
