"""The commands of `vsfsim measure` on datasets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import report
from vsfsim.cli.options import JsonFile

app = typer.Typer(rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Datasets."""


@app.command()
def loading(folder: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of a dataset.")],
            workers: Annotated[list[int] | None, typer.Option(min=0, help="Processes that read; may be given again. "
                                                                          "Default: 0, 2 and 8.")] = None,
            item: Annotated[str, typer.Option(help="touch or view: what one item is.")] = "touch",
            shuffle: Annotated[bool, typer.Option("--shuffle", help="Read in random order.")] = False,
            json: JsonFile = None) -> None:
    """Read throughput of `dataset.torch()` in a DataLoader, and the memory that reading takes."""
    from benchmarks.datasets.loading import measure, text

    rows = measure(folder, workers or [0, 2, 8], item=item, shuffle=shuffle)
    report(text(rows), rows, json)
