"""Commands on what is there: show, list, verify; and `vsfsim lab export` and `import`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.lab import lab
from vsfsim.cli.options import AtLeastOne, Device, JsonFile, Parameters, Seed, Shown, command, parameters_of
from vsfsim.core.errors import TaskError, one_of

if TYPE_CHECKING:
    from vsfsim.bench.commands.catalogue import Catalogue

app = typer.Typer()


@command(app)
def show(what: str, out: Shown = None, objects: AtLeastOne = 12, method: str = "", settings: Parameters = None,
         seed: Seed = 0, device: Device = "cpu", json: JsonFile = None) -> None:
    """Show a dataset, a scene's object, or where a method errs: in words, as a picture, or as a page.

    A dataset: its summary and a contact sheet. A scene: its object from two sides, and cut open, coloured by
    Young's modulus. A result of `vsfsim evaluate`: errors by object and by touch, the worst first.

    A page (--out NAME.html) is one file for a browser that needs no network: the object, to be turned and cut; touches,
    forces and pressures frame by frame; the RGB-D picture. Of a result it has the true and the estimated stiffness side
    by side.

    Args:
        what (DATASET|SCENE|RESULT): Folder of a dataset, a scene, or a result file (.json).
        out: File to write: a picture (.png) or a page (.html); default: NAME.png here, and for a result no file.
        objects: Object views of a dataset or result on a page, at most.
        method: Of a dataset: draw what this method makes of the first test object, touch by touch, beside the truth,
            with --out NAME.gif.
        seed: Of a scene's object.
    """
    result = Path(what).suffix == ".json"
    if result and out is None:
        from vsfsim.bench.commands.inspect_result import inspect_result

        report(*inspect_result(Path(what)), json)
        return
    if (method != "") != (out is not None and out.suffix == ".gif"):
        raise TaskError("--method METHOD and --out NAME.gif belong together: the GIF shows what a method makes of an "
                        "object, touch by touch.")
    with Progress("show") as progress:
        if method and out is not None:
            from vsfsim.view.growth import growth

            lines, numbers = growth(what, out, method=method, settings=parameters_of(settings), device=device,
                                    progress=progress)
        elif out is not None and out.suffix == ".html":
            from vsfsim.view.command import view

            lines, numbers = view(what, out, objects=objects, seed=seed, progress=progress)
        elif result:
            raise TaskError(f"--out is '{out}', but a result is drawn on a page. Give --out NAME.html.")
        else:
            from vsfsim.generate.inspect import inspect

            lines, numbers = inspect(what, out, seed=seed, device=device, progress=progress)
    report("\n".join(lines), numbers, json)


ORIGINS = ("openvsf", "probings")
KINDS = ("scenes", "families", "tasks", "methods", "formats")


@command(app, "list")
def list_(what: Annotated[str, typer.Argument(autocompletion=lambda: list(KINDS))], json: JsonFile = None) -> None:
    """List scenes, families of objects, tasks, methods, or formats.

    Args:
        what (KIND): scenes, families, tasks, methods or formats.
    """
    one_of(what, KINDS, "KIND")
    from vsfsim.bench.commands import catalogue
    from vsfsim.core import shelf

    rows: list[tuple[str, ...]] = []
    found: Catalogue[Any] = catalogue.tasks() if what == "tasks" else catalogue.methods()
    if what == "scenes":
        from vsfsim.core.scene import load_scene

        trees = {name: load_scene(path).tree for name, path in shelf.scenes().items()}
        rows = [(name, "dataset" if "touches" in tree else "press", tree.get("description", ""))
                for name, tree in trees.items()]
    elif what == "families":
        rows = [(name, "family of objects", " ".join((shelf.family(name, "").__doc__ or "").split("\n\n")[0].split()))
                for name in shelf.families()]
    elif what == "formats":
        from vsfsim.data.formats.export import FORMATS

        rows = [*((name, "export", f"vsfsim lab export DATASET --to {name}") for name in FORMATS),
                *((name, "import", f"vsfsim lab import FOLDER --from {name}") for name in ORIGINS)]
    if rows:
        head = ("family" if what == "families" else what[:-1], "kind", "description")
        found = catalogue.Catalogue(what, {row[0]: row for row in rows}, head, rows)
    report(str(found), found.table(), json)


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


@command(lab)
def export(folder: str, to: Annotated[str, typer.Option()], out: Path | None = None, json: JsonFile = None) -> None:
    """Write a dataset in a format that others load, with its truth beside it, or as an archive.

    The new folder or archive appears when it is whole; stopped before, there is none. `generate` and `evaluate` take an
    archive in place of making the dataset if $VSFSIM_ARCHIVES names its folder, or an address that has it.

    Args:
        folder (DATASET): Folder of a dataset, or its address.
        to: lerobot, croissant, webdataset, openvsf or archive.
        out: New folder, or that of archives; default: DATASET-FORMAT.
    """
    from vsfsim.data.formats.export import export as run

    with Progress("export") as progress:
        made = run(folder, to, out or Path(f"{Path(folder).name}-{to}"), progress)
    files = [path for path in (made, *made.rglob("*")) if path.is_file()]
    size = sum(path.stat().st_size for path in files)
    report(f"{made}: {to}, {len(files)} files, {size / 1e6:.1f} MB",
           {"out": str(made), "format": to, "files": len(files), "bytes": size}, json)


@command(lab, "import")
def import_(folder: Path, origin: Annotated[str, typer.Option("--from")], out: Path | None = None,
            assets: Path | None = None, bubble: Path | None = None, pressure_unit: str = "hPa",
            tare: Annotated[int | None, typer.Option(min=0)] = None, every: AtLeastOne = 1,
            pitch: Annotated[float, typer.Option(min=0.0, max=0.02)] = 0.0007,
            contact_offset: Annotated[float, typer.Option(min=0.0, max=0.01)] = 0.0,
            touches: Annotated[int | None, typer.Option(min=1)] = None,
            again: Annotated[list[str] | None, typer.Option()] = None, json: JsonFile = None) -> None:
    """Make a dataset without truth from recordings of a real robot, on which methods run and tasks score readings.

    The new folder appears when it is whole. Stiffness is unknown there, so that no metric of stiffness is given.

    Args:
        folder (FOLDER): openvsf: of one recorded object, or of several. probings: with a file of presses of a ball for
            each object, .csv, .npz or .mat.
        origin: Its layout: openvsf or probings.
        out: New folder; default: FOLDER-dataset.
        assets (FOLDER): Cloud and box of each object, where they do not lie beside its sequences.
        bubble (FILE): Mesh of the free bubble.
        pressure_unit: Of recorded pressures: hPa or Pa.
        tare: Frames without contact at the start of a sequence; default: 20 of torques, 10 of pressures.
        every: Keep each so many-th frame.
        pitch: Of probings: edge of a pixel of the picture, interpolated between contact points [m]; 0: these alone.
        contact_offset: Of probings: how far the surface lies above the recorded contacts [m].
        touches: Of probings: presses of each object, drawn; default: all.
        again (NAME): Of probings: recording of places that another one touched too. It becomes no object; how well it
            repeats the other is told. May be given again.
    """
    new = out or Path(f"{folder.resolve().name}-dataset")
    if one_of(origin, ORIGINS, "--from") == "openvsf":
        from vsfsim.generate.recorded.openvsf import Options, import_openvsf

        made = import_openvsf(folder, new, Options(assets, bubble, pressure_unit, tare, every))
    else:
        from vsfsim.generate.recorded import probings

        made = probings.import_probings(folder, new, probings.Options(pitch, contact_offset, touches,
                                                                       tuple(again or ())))
    found, frames = (sum(getattr(e, key) for e in made.entries) for key in ("touches", "frames"))
    told = made.recipe.options
    report("\n".join([
        f"{made.path}: {len(made)} recorded objects, {found} touches, {frames} frames, no truth; sha256 {made.sha256}",
        *(f"{name}: left out {', '.join(f'{count} {why}' for why, count in of.items())}"
          for name, of in told.get("left_out", {}).items() if of),
        *(f"{name} repeats {of['places']} places of {of['of']}: error over that of predicting zero {of['rmse_ratio']}"
          for name, of in told.get("again", {}).items())]),
        {"out": str(made.path), "objects": len(made), "touches": found, "frames": frames, "sha256": made.sha256,
         **told}, json)
