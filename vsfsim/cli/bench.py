"""Commands of the benchmark: evaluate, leaderboard, check, submit; of `vsfsim lab` score, new-method, audit, seal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from vsfsim.cli import cluster
from vsfsim.cli.console import Progress, report, write_json
from vsfsim.cli.lab import lab
from vsfsim.cli.options import (
    AtLeastOne,
    DatasetFolder,
    Folders,
    JsonFile,
    MethodName,
    Parameters,
    Several,
    TaskName,
    command,
    complete_method,
    complete_task,
    parameters_of,
    result_path,
)
from vsfsim.core.errors import MethodError, TaskError
from vsfsim.core.system.engines import HERE

if TYPE_CHECKING:
    from vsfsim.bench.result import Result
    from vsfsim.bench.task import Task

app = typer.Typer()

KnownTask = Annotated[str | None, typer.Option(autocompletion=complete_task)]
KnownTasks = Annotated[list[str] | None, typer.Option(autocompletion=complete_task)]
Results = Annotated[list[Path] | None, typer.Argument(metavar="RESULT")]


@command(app)
def evaluate(task: TaskName,
             method: Annotated[list[str] | None, typer.Option(autocompletion=complete_method)] = None,
             every: Annotated[bool, typer.Option("--all")] = False, preset: str = "", dataset: DatasetFolder = None,
             out: Path | None = None, seeds: Several = None, parameters: Parameters = None, workers: AtLeastOne = 1,
             timeout: float | None = None, memory: float | None = None, sandbox: str = "",
             json: JsonFile = None) -> None:
    """Score methods on a task.

    Prints a table; every number goes into a JSON file. Finished parts are kept, and the same command goes on after an
    interruption.

    Args:
        method: Name of a method (`vsfsim list methods`), or module:attribute; may be given again. Ceilings: resim, the
            true object; fem-map, its mesh; rod-map, the skeleton of a plant.
        every: All methods that ship, with all their presets; results that are there already are kept. With --set
            device=cuda:0 those use the GPU that it makes faster; with device=cuda each training of several --workers
            uses one of all GPUs.
        preset: Settings of a method that ships: paper, exact or tuned; default those of its constructor.
        out: Result file, or with --all a folder of them; default: results/TASK/METHOD.json.
        seeds: Draws of the support set; default: the task's number. With cross-validation, of one training.
        workers: Trainings and trials that run at the same time, each in a process of its own.
        timeout: Seconds that one call of the method may take; default: no limit.
        memory: Memory that a process of the method may allocate [GiB]; default: what the machine has.
        sandbox: namespaces: in a container, which hides your files and the network; process: in a process of its own;
            default: $VSFSIM_SANDBOX, or the strongest that works here.
    """
    from vsfsim.bench.commands import catalogue
    from vsfsim.bench.commands.ceiling import ceiling_rows
    from vsfsim.bench.evaluate import data_of, evaluate_all
    from vsfsim.bench.task import load_task

    given, names = parameters_of(parameters), list(method or [])
    if every == bool(names):
        raise MethodError("give --method NAME, or --all for every method that ships.")
    if (every and given.keys() - {"device"}) or (len(names) > 1 and (given or out is not None)):
        raise MethodError("--out and --set belong to one method, but several are asked for. Give one --method, or "
                          "leave them away (--out FOLDER and --set device=cuda:0 go with --all).")
    if every and preset and preset not in catalogue.PRESETS:
        raise MethodError(f"--preset is '{preset}'; it is one of {', '.join(catalogue.PRESETS)}.")
    wanted, fan = load_task(task), cluster.asked()
    if cluster.by_shards(10):
        return
    reads, answer = wanted.observation.name, wanted.metric.answer.value
    if every:
        chosen = catalogue.choices(reads, str(given.get("device", "")), answer,
                                   chosen=wanted.protocol.support == "chosen")
        rows = [row for row in chosen if preset in ("", row.preset)]
        rows += ceiling_rows(wanted, data_of(wanted, dataset)) if not preset else []
        folder = out or Path("results") / wanted.name
        paths = {result_path(folder / f"{row.stem}.json", wanted.name, row.stem): row for row in rows}
    else:
        rows = [catalogue.preset(name, preset, reads, answer) for name in names]
        paths = {result_path(out, wanted.name, row.stem): catalogue.Choice(
            row.method, row.preset, {**row.parameters, **given}) for row in rows}
    made, show, tables = [], str(json) != "-", not every and fan == HERE
    with Progress(" ".join(["evaluate", *names])) as progress:
        for one in evaluate_all(wanted, paths, dataset=dataset, again=tables, seeds=seeds, workers=workers,
                                timeout=timeout, memory=memory, sandbox=sandbox, fan=fan, progress=progress):
            if one.failure is not None and tables and len(names) == 1:
                raise one.failure
            if show and not tables:
                print(f"{paths[one.path].stem:<28}{one.state}", flush=True)
            made.append(one)
    failed = [one for one in made if one.result is None]
    if tables:
        results = [(one.result, one.path) for one in made if one.result is not None]
        numbers = [{**result.summary(), "written": str(path)} for result, path in results]
        if results:
            report(_scored(results, wanted), numbers[0] if len(paths) == 1 else numbers, json)
        if failed:
            raise MethodError(" ".join(f"{paths[one.path].stem}: {one.failure}" for one in failed))
        return
    write_json([{"method": paths[one.path].method, "preset": paths[one.path].preset, "state": one.state,
                 "written": str(one.path)} for one in made], json)
    if failed:
        raise MethodError(f"{len(failed)} of {len(made)} rows could not be made: "
                          + ", ".join(paths[one.path].stem for one in failed) + ". The messages are above; the same "
                          "command tries them again.")
    if show:
        print(f"\nvsfsim leaderboard --task {wanted.name}   # shows them" if fan.shard is None else
              f"shard {fan.shard[0]}/{fan.shard[1]}: its trainings are made. When all shards are, the same command "
              f"without a --shard scores them.")


def _scored(results: Sequence[tuple[Result, Path]], task: Task) -> str:
    """What is printed of results: every metric of one, or of several the metric that ranks."""
    from vsfsim.bench.trials.jobs import log_of
    from vsfsim.core.text_table import text_table

    head, rows = results[0][0].table(task.primary)
    if len(results) > 1:
        head = [rows[0][0], *head[1:]]
        rows = [[path.stem, *result.table(task.primary)[1][0][1:]] for result, path in results]
    lines = [text_table(head, rows)]
    for result, path in results:
        t, log = result.timing, log_of(path)
        learns = f"meta-fit {t['meta_fit_s']:.1f} s, adapt {t['adapt_s'] / max(t['adapts'], 1):.2f} s, " if (
            "adapts" in t) else ""
        lines += ["", f"{learns}predict {t['predict_s'] / max(t['predicts'], 1):.3f} s a touch; {len(result.seeds)} "
                      f"seeds; peak memory {result.peak_memory_mib:.0f} MiB", *(f"note: {one}" for one in result.notes)]
        lines += [f"what the method printed is in {log}"] if log.exists() else []
        lines.append(f"written to {path}")
    return "\n".join(lines)


@command(lab)
def score(predictions: Path, task: TaskName, name: Annotated[str, typer.Option()], dataset: DatasetFolder = None,
          sealed: Path | None = None, out: Path | None = None, json: JsonFile = None) -> None:
    """Score a file of predictions made elsewhere.

    This Python makes the file; write the questions out for a method in another language:

    \b
      import numpy as np
      from vsfsim.bench.predictions import questions
      from vsfsim.bench.task import load_task, open_dataset
      task = load_task("fewshot-shoes-v3-mini-v1")
      answers = {}
      for q in questions(task, open_dataset(task)):      # one object, number of touches and seed
          # q.view is the image, q.support the touches that were made (each has .action, .value, .valid)
          for key, action in zip(q.keys, q.actions):     # touches to predict: action.poses (T, 4, 4), ...
              answers[key] = np.zeros((len(action.time), action.size))   # your prediction (T, d)
      np.savez("predictions.npz", **answers)

    \b
      vsfsim lab score predictions.npz --task fewshot-shoes-v3-mini-v1 --name mine

    Args:
        predictions (FILE): An .npz with one array (T, d) a query; its keys are OBJECT/SHOT/SEED/TOUCH.
        name: Name of the method in the result.
        sealed (FILE): Private part of a sealed set; --dataset is its dataset (`vsfsim lab seal`).
        out: Result file; default: results/TASK/NAME.json.
    """
    from vsfsim.bench.board.rows import row_sha256
    from vsfsim.bench.commands.score import score_predictions
    from vsfsim.bench.predictions import check_commitment, receipt
    from vsfsim.bench.task import load_task, open_dataset
    from vsfsim.core.text_table import text_table

    wanted = load_task(task)
    path = result_path(out, wanted.name, name)
    data = open_dataset(wanted, dataset)
    if sealed is not None:
        check_commitment(sealed, wanted, data)
    result = score_predictions(predictions, wanted, data, name=name)
    result.save(path)
    given = receipt(sealed, row_sha256(result)) if sealed is not None else {}
    report(f"{text_table(*result.table(wanted.primary))}\nwritten to {path}" + "".join(
        f"\n{key}: {value}" for key, value in given.items()), {**result.summary(), "written": str(path), **given}, json)


@command(app)
def leaderboard(results: Results = None, task: KnownTask = None, html: Path | None = None, json: JsonFile = None
                ) -> None:
    """Rank the methods of a task, from result files.

    The last column says which results came with vsfsim and which were made here.

    Args:
        results: More result files, or folders of them; default: results/TASK if there is one.
        task: Name of a task; default: all tasks.
        html (FILE): Write one page that works offline.
    """
    from vsfsim.bench import leaderboard as board
    from vsfsim.bench.task import load_task
    from vsfsim.core import shelf

    with Progress("leaderboard") as told:
        boards = [board.collect(wanted, results or _own(wanted))
                  for wanted in told.over([task] if task else shelf.tasks(), load_task)]
    text, tables = "\n\n".join(map(board.text, boards)), list(map(board.table, boards))
    if html is not None:
        from vsfsim.data.disk import write_atomic

        write_atomic(html, board.page(boards).encode(), error=TaskError)
        text = f"written to {html}"
    report(text, tables[0] if task else tables, json)


def _own(task: Task) -> list[Path]:
    """The folder of the results of a task that were made here, if there is one."""
    return [folder] if (folder := Path("results") / task.name).is_dir() else []


@command(app)
def check(method: MethodName, parameters: Parameters = None, json: JsonFile = None) -> None:
    """Try a method against the contract, in seconds.

    Runs on mock objects; no dataset is needed. Exit code 2 if the method does not conform.
    """
    from vsfsim.bench import check as contract

    findings = contract.check(method, parameters=parameters_of(parameters))
    report(contract.report(method, findings), contract.table(method, findings), json)
    raise typer.Exit(2 if any(f.outcome == "failed" for f in findings) else 0)


@command(lab, "new-method")
def new_method(name: str, out: Path | None = None) -> None:
    """Begin a method of your own: a package with its entry point and its test.

    It passes `vsfsim check` as it is. What it prints are the next steps.

    Args:
        name: Of the method: small letters, digits and dashes, e.g. my-method.
        out: Folder to make; default: NAME here.
    """
    from vsfsim.bench.commands.new_method import write_package

    print(write_package(name, out))


@command(app)
def submit(result: Path, out: Path = Path("submission"), task: KnownTask = None, json: JsonFile = None) -> None:
    """Check a result as the leaderboard does, and write its pull request.

    Says where the row would stand. Exit code 2, and nothing is written, if a check refuses it.

    Args:
        result: Result file of `vsfsim evaluate`.
        out (DIR): Folder for the row and the text of the pull request.
        task: Path of the task's .toml file, if it is no installed one.
    """
    from vsfsim.bench.commands.submit import submit as run
    from vsfsim.bench.task import load_task

    report(*run(result, out, task=None if task is None else load_task(task)), json)


@command(lab)
def audit(task: Annotated[str, typer.Argument(autocompletion=complete_task)], results: Results = None,
          dataset: DatasetFolder = None, fresh: Folders = None, json: JsonFile = None) -> None:
    """Measure whether a task measures what it says.

    For who keeps tasks, in a checkout. Three diagnostics: what methods reach that do not look at everything, which
    share of neighbouring ranks differ and the least difference that can be told, and whether the ranks hold on fresh
    objects.

    Args:
        task: Name of a task (`vsfsim list tasks`), or the path of its .toml file.
        results: More result files, or folders; default: results/TASK.
        fresh: Folder of results of the same methods on objects of another seed; may be given again.
    """
    from vsfsim.bench.task import load_task
    from vsfsim.core import shelf

    shelf.checkout()
    from measurements import audit as module

    wanted = load_task(task)
    with Progress("audit") as progress:
        found = module.audit(wanted, results or _own(wanted), dataset=dataset, fresh=fresh or (), progress=progress)
    report(module.text(found, f"{wanted.primary}, area under the curve"), asdict(found), json)


@command(lab)
def release(only: KnownTasks = None, dry: Annotated[bool, typer.Option("--dry-run")] = False,
            workers: AtLeastOne = 1, json: JsonFile = None) -> None:
    """Make every row, audit and study that ships, and the list of what made each.

    For developers, in a checkout: rows go to leaderboard/, results stay in results/. What is there and current is kept,
    and the same command goes on after an interruption, also on another machine.

    Args:
        only: Name of a task, may be given again; default: all of leaderboard/release.toml.
        dry: Print what is there and what is missing, with CPU minutes.
        workers: Trainings and trials at the same time.
    """
    from vsfsim.core import shelf

    shelf.checkout()
    from measurements import release as module

    with Progress("release") as progress:
        text, found = module.planned(only) if dry else module.release(only, workers, progress)
    report(text, found, json)


@command(lab)
def seal(dataset: Path, task: TaskName, public: Annotated[Path, typer.Option(metavar="DIR")],
         private: Annotated[Path, typer.Option(metavar="FILE")], json: JsonFile = None) -> None:
    """Divide a dataset into a public and a private part, with a commitment.

    The public part holds no query reading, no truth and no seed. Answers to it are scored against the private part:

    \b
      from pathlib import Path
      import numpy as np
      from vsfsim.bench.predictions import questions
      from vsfsim.bench.task import load_task
      answers = {}
      for q in questions(load_task("my-task-v1.toml"), Path("public")):
          method.adapt(q.view, q.support)                # after method.meta_fit(...) on other objects
          answers |= zip(q.keys, method.predict(q.actions))
      np.savez("predictions.npz", **answers)

    \b
      vsfsim lab score predictions.npz --task my-task-v1.toml --dataset DATASET --sealed private.json --name mine

    Args:
        dataset: Folder of the dataset to seal.
        public: New folder for pictures, support touches and query paths.
        private: New file for the text that the commitment is of. Keep it with the dataset.
    """
    from vsfsim.bench import predictions
    from vsfsim.bench.task import load_task, open_dataset

    wanted = load_task(task)
    data = open_dataset(wanted, dataset)
    commitment = predictions.seal(wanted, data, public, private)
    guess = f"\nnote: seed {data.recipe.seed} is found by trying; seal data of a seed with 12 digits or more" if (
        data.recipe.seed < predictions.FEWEST_SEEDS) else ""
    report(f"public part: {public}\nprivate part: {private} and {dataset}; keep both\ncommitment to publish: "
           f"{commitment}{guess}", {"public": str(public), "private": str(private), "commitment": commitment}, json)
