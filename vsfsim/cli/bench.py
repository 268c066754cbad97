"""Commands of the benchmark: methods, tasks, evaluate, score, leaderboard, check."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress
from vsfsim.cli.options import DatasetFolder, MethodName, Parameters, TaskName, parameters_of, result_path

app = typer.Typer()


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
        superseded = f" Superseded by {task.superseded_by}." if task.superseded_by else ""
        print(f"{name:<{2 + max(map(len, names))}}{task.description}{superseded}")


@app.command()
def evaluate(method: Annotated[str, typer.Option(help="Name of a method (`vsfsim methods`), or module:attribute.")],
             task: TaskName, dataset: DatasetFolder = None,
             out: Annotated[Path | None, typer.Option(help="Result file; default: results/TASK/METHOD.json.")] = None,
             seeds: Annotated[int | None, typer.Option(min=1, help="Draws of the support set; default: the task's "
                                                                   "number.")] = None,
             parameters: Parameters = None) -> None:
    """Score a method on a task.

    Prints a table; every number goes into a JSON file.
    """
    from vsfsim.bench.evaluate import evaluate as run
    from vsfsim.bench.leaderboard import score_table
    from vsfsim.bench.method import find_method
    from vsfsim.bench.method import parameters_of as checked_parameters
    from vsfsim.bench.task import load_task, open_dataset

    given = parameters_of(parameters)
    checked_parameters(find_method(method), given)  # a mistyped parameter is reported before the dataset is opened
    wanted = load_task(task)
    path = result_path(out, wanted.name, method)
    with Progress(f"evaluate {method}") as progress:
        result = run(method, wanted, open_dataset(wanted, dataset), parameters=given, seeds=seeds, progress=progress)
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
def score(predictions: Annotated[Path, typer.Argument(metavar="FILE", help="An .npz with one array (T, d) a query; its "
                                                                           "keys are OBJECT/SHOT/SEED/TOUCH.")],
          task: TaskName, name: Annotated[str, typer.Option(help="Name of the method in the result.")],
          dataset: DatasetFolder = None,
          out: Annotated[Path | None, typer.Option(help="Result file; default: results/TASK/NAME.json.")] = None
          ) -> None:
    """Score a file of predictions made elsewhere."""
    from vsfsim.bench.leaderboard import score_table
    from vsfsim.bench.predictions import score_predictions
    from vsfsim.bench.task import load_task, open_dataset

    wanted = load_task(task)
    path = result_path(out, wanted.name, name)
    result = score_predictions(predictions, wanted, open_dataset(wanted, dataset), name=name)
    result.save(path)
    print(score_table(result, wanted.primary))
    print(f"written to {path}")


@app.command()
def leaderboard(results: Annotated[list[Path] | None,
                                   typer.Argument(metavar="RESULT", help="More result files, or folders of them; "
                                                                         "default: results/TASK if there is one.")
                                   ] = None,
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
def check(method: MethodName, parameters: Parameters = None) -> None:
    """Try a method against the contract, in seconds.

    Runs on mock objects; no dataset is needed. Exit code 2 if the method does not conform.
    """
    from vsfsim.bench.check import check as run
    from vsfsim.bench.check import report

    findings = run(method, parameters=parameters_of(parameters))
    print(report(method, findings))
    raise typer.Exit(2 if any(f.outcome == "failed" for f in findings) else 0)
