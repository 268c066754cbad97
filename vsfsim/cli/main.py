"""The command line: each command is a small function that calls one function of a layer, imported when it runs.

Nothing heavy is imported here: `vsfsim --help` must answer in under 0.3 s. A `VsfsimError` becomes one paragraph on
stderr and exit code 2; anything else is a bug of ours and keeps its traceback, exit code 1.
"""

from __future__ import annotations

import errno
import sys
import time
import traceback
from pathlib import Path
from typing import Annotated, Any

import typer

from vsfsim.cli.measure import app as measure_app
from vsfsim.core.arm_spec import ARM_MODELS
from vsfsim.core.errors import MethodError, VsfsimError, did_you_mean
from vsfsim.core.extras import missing

app = typer.Typer(name="vsfsim", no_args_is_help=True, add_completion=False, rich_markup_mode=None,
                  pretty_exceptions_enable=False,
                  help="""Simulated vision and touch of heterogeneous deformable objects, and a benchmark of stiffness estimators.

\b
A first look:
  vsfsim press indent                 press a sphere into a soft block
  vsfsim inspect shoes-mini           draw a shoe of the small data set
\b
Make data, score two methods, see the table:
  vsfsim generate shoes-mini --out datasets/shoes-mini-v1
  vsfsim evaluate --method gaussian --task fewshot-shoes-mini-v1
  vsfsim evaluate --method point-vsf --task fewshot-shoes-mini-v1
  vsfsim leaderboard --task fewshot-shoes-mini-v1
""", epilog="Exit codes: 0 fine, 1 a bug of ours, 2 a mistake in what was given, 3 a press that did not converge.")

app.add_typer(measure_app, name="measure")
app.add_typer(measure_app, name="bench", hidden=True)  # the old spelling, one release long

TaskName = Annotated[str, typer.Option("--task",
                                       help="Name of a task (`vsfsim tasks`), or the path of its .toml file.")]
DatasetFolder = Annotated[Path | None, typer.Option("--dataset",
                                                    help="Folder of the dataset; default: the task's, under datasets/ "
                                                         "or $VSFSIM_DATASETS.")]
SetOption = Annotated[list[str] | None, typer.Option("--set", metavar="KEY=VALUE",
                                                     help="Parameter of the method; may be given again.")]


def main() -> None:
    """Entry point of the `vsfsim` command."""
    # Taken out by hand, so that it works before and after the command.
    debug = "--debug" in sys.argv[1:]
    sys.argv[1:] = [word for word in sys.argv[1:] if word != "--debug"]
    commands = [name for name in (c.name or c.callback.__name__
                                  for c in (*app.registered_commands, *app.registered_groups))]
    word = next((w for w in sys.argv[1:] if not w.startswith("-")), None)
    try:
        if word is not None and word == sys.argv[1] and word not in commands:
            raise VsfsimError(f"unknown command '{word}'. {did_you_mean(word, commands)}")
        app()
    except (VsfsimError, ModuleNotFoundError) as error:
        found = error if isinstance(error, VsfsimError) else missing(error)
        if found is None:
            _report_bug()
        if debug:
            traceback.print_exc()
        print(f"error: {found}", file=sys.stderr)
        sys.exit(2)
    except BrokenPipeError:
        sys.stderr.close()  # the reader of a pipe left; nothing is wrong
        sys.exit(0)
    except OSError as error:
        if error.errno not in _DISK:
            _report_bug()
        if debug:
            traceback.print_exc()
        print(f"error: {error.filename or 'a file'} cannot be written: {error.strerror}. Free some space, or choose "
              f"another place, and run the same command again.", file=sys.stderr)
        sys.exit(2)
    except Exception:
        _report_bug()


_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES)
"""A disk that is full, or that may not be written: of pictures and temporary files, which others write for us."""


def _report_bug() -> None:
    traceback.print_exc()
    print("error: this is a bug in vsfsim, not in what you gave it. Please report it with the lines above.",
          file=sys.stderr)
    sys.exit(1)


@app.callback(invoke_without_command=True)
def _global(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
            version: Annotated[bool, typer.Option("--version", help="Show the version.")] = False) -> None:
    if version:
        import vsfsim

        print(f"vsfsim {vsfsim.__version__}")
        raise typer.Exit


# ------------------------------------------------------------------------------------------------- simulate


SceneName = Annotated[str, typer.Argument(metavar="SCENE",
                                          help="Name of a scene (`vsfsim scenes`), or the path of its .toml file.")]
Tier = Annotated[str | None, typer.Option("--tier",
                                          help="Fidelity: linear, fem-coarse, fem, fem-fine; default: the scene's.")]
Device = Annotated[str, typer.Option("--device", help="cpu or cuda:0.")]
Precision = Annotated[str, typer.Option("--precision", help="float64 or float32.")]


@app.command()
def scenes() -> None:
    """List the shipped scenes."""
    from vsfsim.core import shelf
    from vsfsim.core.scene import load_scene

    for name, path in shelf.scenes().items():
        scene = load_scene(path)
        kind = "dataset" if "touches" in scene.tree else "press"
        print(f"{name:<22}{kind:<9}{scene.tree.get('description', '')}")
    print(f"families: {', '.join(shelf.families())}")


@app.command()
def press(scene: SceneName, tier: Tier = None, device: Device = "cpu", precision: Precision = "float64",
          seed: Annotated[int, typer.Option(min=0, help="Fixes every distribution of the scene.")] = 0,
          json: Annotated[str | None, typer.Option("--json", metavar="FILE",
                                                   help="Write one JSON object; - for standard output.")] = None,
          plot: Annotated[Path | None, typer.Option(help="Write a plot of force against depth (PNG).")] = None,
          picture: Annotated[Path | None,
                             typer.Option(help="Write a picture of the deformed body at full depth (PNG).")] = None,
          save: Annotated[Path | None,
                          typer.Option(help="Write mesh, displacements and contact forces of every "
                                            "frame (.npz).")] = None,
          refine: Annotated[int | None, typer.Option(min=3, max=6, metavar="MESHES",
                                                     help="Press 3 to 6 finer and finer meshes: observed order of "
                                                          "convergence, extrapolated force "
                                                          "and its error.")] = None) -> None:
    """Press a probe into an object: force against depth, and whether it can be trusted.

    What the scene leaves out is assumed, and said: without [press] the probe goes down in the middle, a tenth of the
    height deep.
    Prints a table, or JSON. Exit code 3 if a frame did not converge.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    _check_device(device, precision)
    for option, path in (("--plot", plot), ("--picture", picture), ("--save", save),
                         ("--json", Path(json) if json not in (None, "-") else None)):
        _check_writable(option, path)
    if save is not None and save.suffix != ".npz":
        raise VsfsimError(f"--save is '{save}'; it must end in .npz, the format that is written.")
    loaded = load_scene(find_scene(scene))
    from vsfsim.press.command import press as run  # seconds; a mistake in the scene should not wait for it

    text, found, converged = run(loaded, seed=seed, tier=tier, device=device, precision=precision, refine=refine,
                                 plot=plot, picture=picture, save=save, progress=_Progress("press"))
    if json is not None:
        import json as encoder

        text = encoder.dumps(found)
    if json in (None, "-"):
        print(text)
    else:
        from vsfsim.data.disk import write_atomic

        write_atomic(Path(json), (text + "\n").encode())
    if not converged:
        raise typer.Exit(3)


@app.command()
def generate(scene: SceneName,
             out: Annotated[Path | None, typer.Option(help="Folder of the dataset; default: datasets/SCENE.")] = None,
             objects: Annotated[int | None, typer.Option(min=1, help="How many objects; default: the scene's.")] = None,
             views: Annotated[int | None, typer.Option(min=1, help="Views of each object.")] = None,
             touches: Annotated[int | None, typer.Option(min=1, help="Touches of each view.")] = None,
             seed: Annotated[int, typer.Option(min=0, help="Root of all random streams.")] = 0,
             tier: Tier = None, device: Device = "cpu", precision: Precision = "float64",
             renderer: Annotated[str, typer.Option(help="warp or pyrender.")] = "warp",
             arm: Annotated[str | None,
                            typer.Option(help="Arm of a scene with [arm]: gen3 or menagerie; default: "
                                              "the scene's.")] = None,
             workers: Annotated[int | None, typer.Option(min=1,
                                                         help="Processes; default: one a CPU core.")] = None) -> None:
    """Make a dataset from a scene, or finish one.

    Run the same command again after an interruption: it makes only what is missing, to the same bits.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene

    _check_device(device, precision)
    if renderer not in ("warp", "pyrender"):
        raise VsfsimError(f"--renderer is '{renderer}'. {did_you_mean(renderer, ('warp', 'pyrender'))}")
    if arm is not None and arm not in ARM_MODELS:
        raise VsfsimError(f"--arm is '{arm}'. {did_you_mean(arm, ARM_MODELS)}")
    loaded = load_scene(find_scene(scene))
    folder = out or Path("datasets") / loaded.name
    from vsfsim.generate.run import generate as run  # seconds; a mistake in the scene should not wait for it

    began = time.perf_counter()
    dataset = run(loaded, folder, seed=seed, objects=objects, views=views, touches=touches, tier=tier, device=device,
                  precision=precision,
                  renderer=renderer, workers=workers, arm=arm, progress=_Progress("generate"),
                  note=lambda text: print(f"note: {text}", file=sys.stderr))
    bad = sum(entry.unconverged for entry in dataset.entries)
    print(f"{folder}: {len(dataset)} object views, {sum(e.touches for e in dataset.entries)} touches, "
          f"{sum(e.frames for e in dataset.entries)} frames "
          f"({bad} not converged, marked), {time.perf_counter() - began:.0f} s")


@app.command()
def inspect(what: Annotated[str, typer.Argument(metavar="DATASET|SCENE", help="Folder of a dataset, or a scene.")],
            out: Annotated[Path | None, typer.Option(help="PNG to write; default: NAME.png here.")] = None,
            seed: Annotated[int, typer.Option(min=0, help="Fixes every distribution of a scene.")] = 0,
            device: Device = "cpu") -> None:
    """Draw a dataset, or a scene's object.

    A dataset: its summary and a contact sheet. A scene: a turntable of its object, coloured by Young's modulus.
    """
    from vsfsim.generate import inspect as look

    _check_device(device)
    _check_writable("--out", out)
    for line in look.inspect(what, out, seed=seed, device=device):
        print(line)


# ------------------------------------------------------------------------------------------------- data


@app.command()
def verify(folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder of a dataset.")]) -> None:
    """Check every byte, field and frame of a dataset.

    Hashes, schema, finite numbers, force balance. Exit code 2 if anything is wrong, with what to do about it.
    """
    from vsfsim.data.verify import verify as run

    report = run(folder)
    print(report.text())
    raise typer.Exit(0 if report.ok else 2)


# ------------------------------------------------------------------------------------------------- bench


@app.command()
def methods() -> None:
    """List the installed methods."""
    from vsfsim.core import shelf

    for name, entry in sorted(shelf.methods().items()):
        print(f"{name:<20}{entry.value}")


@app.command()
def tasks() -> None:
    """List the tasks."""
    from vsfsim.bench.task import load_task
    from vsfsim.core import shelf

    names = list(shelf.tasks())
    for name in names:
        task = load_task(name)
        print(f"{name:<{2 + max(map(len, names))}}{task.description}" + (f" Superseded by {task.superseded_by}."
                                                                         if task.superseded_by else ""))


@app.command()
def evaluate(method: Annotated[str, typer.Option(help="Name of a method (`vsfsim methods`), or module:attribute.")],
             task: TaskName,
             dataset: DatasetFolder = None,
             out: Annotated[Path | None, typer.Option(help="Result file; default: results/TASK/METHOD.json.")] = None,
             seeds: Annotated[int | None, typer.Option(min=1,
                                                       help="Draws of the support set, instead of the task's "
                                                            "own number.")] = None,
             parameters: SetOption = None) -> None:
    """Score a method on a task.

    Prints a table; every number goes into a JSON file.
    """
    from vsfsim.bench.evaluate import evaluate as run
    from vsfsim.bench.leaderboard import score_table
    from vsfsim.bench.method import find_method, parameters_of
    from vsfsim.bench.task import load_task, open_dataset

    given = _parameters(parameters)
    parameters_of(find_method(method), given)  # a typing error should not wait for the dataset
    wanted = load_task(task)
    path = _result_path(out, wanted.name, method)
    result = run(method, wanted, open_dataset(wanted, dataset), parameters=given, seeds=seeds,
                 progress=_Progress(f"evaluate {method}"))
    result.save(path)
    t = result.timing
    print(score_table(result, wanted.primary))
    print(f"\nmeta-fit {t['meta_fit_s']:.1f} s, adapt {t['adapt_s'] / max(t['adapts'], 1):.2f} s, predict "
          f"{t['predict_s'] / max(t['predicts'], 1):.3f} s a touch; "
          f"{len(result.seeds)} seeds; peak memory {result.peak_memory_mib:.0f} MiB")
    for note in result.notes:
        print(f"note: {note}")
    print(f"written to {path}")


@app.command()
def score(predictions: Annotated[Path, typer.Argument(metavar="FILE",
                                                      help="An .npz with one array (T, d) a query; its keys are "
                                                           "OBJECT/SHOT/SEED/TOUCH.")],
          task: TaskName, name: Annotated[str, typer.Option(help="What the method is called in the result.")],
          dataset: DatasetFolder = None, out: Annotated[Path | None,
                                                        typer.Option(help="Result file; default: "
                                                                          "results/TASK/NAME.json.")] = None) -> None:
    """Score a file of predictions made elsewhere."""
    from vsfsim.bench.leaderboard import score_table
    from vsfsim.bench.predictions import score_predictions
    from vsfsim.bench.task import load_task, open_dataset

    wanted = load_task(task)
    path = _result_path(out, wanted.name, name)
    result = score_predictions(predictions, wanted, open_dataset(wanted, dataset), name=name)
    result.save(path)
    print(score_table(result, wanted.primary))
    print(f"written to {path}")


@app.command()
def leaderboard(results: Annotated[list[Path] | None, typer.Argument(metavar="RESULT",
                                                                     help="More result files, or folders of them; "
                                                                          "default: results/TASK if "
                                                                          "there is one.")] = None,
                task: Annotated[str | None, typer.Option(help="Name of a task; default: all tasks.")] = None,
                markdown: Annotated[bool, typer.Option("--markdown", help="Print a Markdown page.")] = False) -> None:
    """Rank the methods of a task, from result files."""
    from vsfsim.bench import leaderboard as board
    from vsfsim.bench.task import load_task
    from vsfsim.core import shelf

    for index, name in enumerate([task] if task else list(shelf.tasks())):
        wanted = load_task(name)
        paths = list(results or [])
        if not paths and (Path("results") / wanted.name).is_dir():
            paths = [Path("results") / wanted.name]
        print("\n" * (index > 0) + (board.markdown if markdown else board.text)(board.collect(wanted, paths)))


@app.command()
def check(method: Annotated[str, typer.Argument(metavar="METHOD",
                                                help="Name of a method (`vsfsim methods`), or module:attribute.")],
          parameters: SetOption = None) -> None:
    """Try a method against the contract, in seconds.

    Runs on mock objects; no dataset is needed. Exit code 2 if the method does not conform.
    """
    from vsfsim.bench.check import check as run
    from vsfsim.bench.check import report

    findings = run(method, parameters=_parameters(parameters))
    print(report(method, findings))
    raise typer.Exit(2 if any(f.outcome == "failed" for f in findings) else 0)


# ------------------------------------------------------------------------------------------------- small helpers


def _parameters(words: list[str] | None) -> dict[str, Any]:
    """``--set key=value`` words as values: TOML where it is TOML, else text."""
    import tomllib

    out: dict[str, Any] = {}
    for word in words or []:
        key, equals, text = word.partition("=")
        if not equals or not key:
            raise MethodError(f"--set {word}: give KEY=VALUE, e.g. --set spacing=0.005.")
        try:
            out[key.strip()] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            out[key.strip()] = text
    return out


def _check_device(device: str, precision: str = "float64") -> None:
    if precision not in ("float32", "float64"):
        raise VsfsimError(f"--precision is '{precision}'. {did_you_mean(precision, ('float32', 'float64'))}")
    if device != "cpu":
        import warp

        names = [str(d.alias) for d in warp.get_devices()]
        if device not in names:
            raise VsfsimError(f"--device is '{device}', but this machine has {', '.join(names)}. Choose one of them.")


def _check_writable(option: str, path: Path | None) -> None:
    """Refuse before the work what could not be written after it."""
    if path is not None and not path.parent.is_dir():
        raise VsfsimError(f"{option} is '{path}', but there is no folder '{path.parent}'. Make it first, or choose "
                          f"another place.")
    if path is not None and path.is_dir():
        raise VsfsimError(f"{option} is '{path}', which is a folder. Give the name of a file in it.")


def _result_path(out: Path | None, task: str, method: str) -> Path:
    """Where a result goes; refused before the work if it cannot be a file."""
    path = out or Path("results") / task / f"{method.replace(':', '.')}.json"
    there = next(folder for folder in path.parents if folder.exists())  # the folders below it are made with the file
    if path.is_dir() or not there.is_dir():
        raise VsfsimError(f"--out is '{path}', but '{path if path.is_dir() else there}' is "
                          f"{'a folder' if path.is_dir() else 'no folder'}. Choose another place.")
    return path


class _Progress:
    """What is going on and the time that is left, on stderr: one line that is overwritten, or, in a log, one every 20
    s."""

    def __init__(self, label: str):
        self.label, self.start, self.told, self.total = label, time.perf_counter(), time.perf_counter(), 0

    def __call__(self, done: int, total: int, what: str) -> None:
        now = time.perf_counter()
        if total != self.total:  # another stage: compiling kernels says nothing about the frames after it
            self.start, self.total = now, total
        left = f", {(now - self.start) / done * (total - done):.0f} s left" if done else ""
        line = f"{self.label}: {done}/{total} {what}{left}"
        if sys.stderr.isatty():
            print(f"\r\x1b[K{line}", end="\n" if done >= total else "", file=sys.stderr, flush=True)
        elif now - self.told > 20.0:
            self.told = now
            print(line, file=sys.stderr, flush=True)
