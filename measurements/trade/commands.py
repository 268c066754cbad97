"""The commands of `vsfsim measure` on speed against accuracy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import report, step
from vsfsim.cli.options import JsonFile, check_choice, seconds_of, share_of

app = typer.Typer(rich_markup_mode=None)


@app.command()
def promise(scene: Annotated[list[str] | None,
                             typer.Argument(metavar="[SCENE]...", help="Names or paths of scenes; default: a block, a "
                                                                       "shoe, a column, a bubble, a plant.")] = None,
            accuracy: Annotated[list[str] | None, typer.Option(help="That is asked for; may be given again. Default: "
                                                                    "5%, 2% and 1%.")] = None,
            objects: Annotated[int, typer.Option(min=1, help="That are held out.")] = 5,
            touches: Annotated[int, typer.Option(min=1, help="Of each of these.")] = 4,
            workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
            out: Annotated[Path, typer.Option(help="Folder of what was made; a later run goes on with it.")] =
            Path("promise"),
            budget: Annotated[str | None, typer.Option(metavar="TIME", help="Begin nothing new after this time, e.g. "
                                                                            "90s or 10m.")] = None,
            json: JsonFile = None) -> None:
    """Measure whether an accuracy that `generate --accuracy` buys is kept on fresh objects, and at what price."""
    from measurements.trade.promise import ACCURACIES, measure
    from vsfsim.generate.trade.buy import check_accuracy

    asked = tuple(share_of("--accuracy", text) for text in accuracy or ()) or ACCURACIES
    for one in asked:
        check_accuracy(one, None)
    found = measure(scene or (), accuracies=asked, objects=objects, touches=touches, workers=workers, out=out,
                    budget=None if budget is None else seconds_of("--budget", budget), progress=step)
    report(found.text(), found.record(), json, indent=1)


@app.command()
def ranking(fidelity: Annotated[list[str] | None, typer.Option(help="Only this one beside fem; may be given again.")] =
            None,
            objects: Annotated[int, typer.Option(min=4, help="Half of them to learn from.")] = 24,
            touches: Annotated[int, typer.Option(min=8, help="Of each.")] = 10,
            workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
            out: Annotated[Path, typer.Option(help="Folder of the data and scores; a later run goes on with it.")] =
            Path("ranking"), json: JsonFile = None) -> None:
    """What fidelity does to a ranking of methods: Kendall's tau against the ranking on fem."""
    from measurements.trade.ranking import FIDELITIES, measure

    for name in fidelity or []:
        check_choice("--fidelity", name, tuple(f.name for f in FIDELITIES))
    found = measure(fidelities=fidelity or (), objects=objects, touches=touches, workers=workers, out=out,
                    progress=step)
    report(found.text(), found.record(), json, indent=1)


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
    report(found.text(), found.record(), json, indent=1)
