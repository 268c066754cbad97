"""Commands of those who keep or enter a leaderboard: submit."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import report
from vsfsim.cli.options import JsonFile, complete_task

app = typer.Typer()


@app.command()
def submit(result: Annotated[Path, typer.Argument(metavar="RESULT", help="Result file of `vsfsim evaluate`.")],
           out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the row and the text of the pull request."
                                             )] = Path("submission"),
           task: Annotated[str | None, typer.Option(autocompletion=complete_task,
                                                    help="Path of the task's .toml file, if it is no installed one.")
                           ] = None, json: JsonFile = None) -> None:
    """Check a result as the leaderboard does, and write its pull request.

    Says where the row would stand. Exit code 2, and nothing is written, if a check refuses it.
    """
    from vsfsim.bench.commands.submit import submit as run
    from vsfsim.bench.task import load_task

    report(*run(result, out, task=None if task is None else load_task(task)), json)
