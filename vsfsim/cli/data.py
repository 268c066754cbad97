"""Commands on datasets: verify."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import report
from vsfsim.cli.options import JsonFile

app = typer.Typer()


@app.command()
def verify(folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a dataset.")],
           json: JsonFile = None) -> None:
    """Check every byte, field and frame of a dataset.

    Hashes, schema, finite numbers, force balance. Exit code 2 if anything is wrong, with what to do about it.
    """
    from vsfsim.data.verify import verify as run

    found = run(folder)
    report(found.text(), found.table(), json)
    raise typer.Exit(0 if found.ok else 2)
