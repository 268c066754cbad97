"""Commands on datasets: verify, export, import."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import AtLeastOne, JsonFile, command

app = typer.Typer()


@command(app)
def verify(folder: Path, against: Path | None = None, json: JsonFile = None) -> None:
    """Check every byte, field and frame of a dataset.

    Hashes, schema, finite numbers, force balance. Exit code 2 if anything is wrong, with what to do about it.

    Args:
        folder (FOLDER): Folder of a dataset.
        against (FOLDER): The same dataset, made elsewhere: count touches that are bit-equal, equal to 1e-3, and other.
    """
    if against is not None:
        from vsfsim.data.verify import compare

        with Progress("verify") as progress:
            alike = compare(folder, against, progress)
        report(alike.text(), vars(alike), json)
        raise typer.Exit(0 if alike.other == 0 else 2)
    from vsfsim.data.verify import verify as run

    with Progress("verify") as progress:
        found = run(folder, progress)
    report(found.text(), found.table(), json)
    raise typer.Exit(0 if found.ok else 2)


@command(app)
def export(folder: str, to: Annotated[str, typer.Option()], out: Path | None = None, json: JsonFile = None) -> None:
    """Write a dataset in a format that others load, with its truth beside it.

    The new folder appears when it is whole; stopped before, there is none.

    Args:
        folder (DATASET): Folder of a dataset, or its address.
        to: lerobot, croissant, webdataset or openvsf.
        out: New folder; default: DATASET-FORMAT.
    """
    from vsfsim.data.formats.export import export as run

    with Progress("export") as progress:
        made = run(folder, to, out or Path(f"{Path(folder).name}-{to}"), progress)
    files = [path for path in made.rglob("*") if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    report(f"{made}: {to}, {len(files)} files, {size / 1e6:.1f} MB",
           {"out": str(made), "format": to, "files": len(files), "bytes": size}, json)


@command(app, "import")
def import_(folder: Path, origin: Annotated[str, typer.Option("--from")], out: Path | None = None,
            assets: Path | None = None, bubble: Path | None = None, pressure_unit: str = "hPa",
            tare: Annotated[int | None, typer.Option(min=0)] = None, every: AtLeastOne = 1,
            json: JsonFile = None) -> None:
    """Make a dataset without truth from recordings of a real robot, on which methods run and tasks score readings.

    The new folder appears when it is whole. Stiffness is unknown there, so that no metric of stiffness is given.

    Args:
        folder (FOLDER): Of one recorded object, or of several.
        origin: Its layout: openvsf.
        out: New folder; default: FOLDER-dataset.
        assets (FOLDER): Cloud and box of each object, where they do not lie beside its sequences.
        bubble (FILE): Mesh of the free bubble.
        pressure_unit: Of recorded pressures: hPa or Pa.
        tare: Frames without contact at the start of a sequence; default: 20 of torques, 10 of pressures.
        every: Keep each so many-th frame.
    """
    from vsfsim.core.errors import VsfsimError, did_you_mean

    if origin != "openvsf":
        raise VsfsimError(f"--from is '{origin}'. {did_you_mean(origin, ('openvsf',))}")
    from vsfsim.generate.recorded.openvsf import Options, import_openvsf

    made = import_openvsf(folder, out or Path(f"{folder.resolve().name}-dataset"),
                          Options(assets, bubble, pressure_unit, tare, every))
    touches, frames = (sum(getattr(e, key) for e in made.entries) for key in ("touches", "frames"))
    report(f"{made.path}: {len(made)} recorded objects, {touches} touches, {frames} frames, no truth",
           {"out": str(made.path), "objects": len(made), "touches": touches, "frames": frames}, json)
