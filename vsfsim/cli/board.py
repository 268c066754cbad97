"""Commands of those who keep or enter a leaderboard: submit, audit, seal."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from vsfsim.cli.console import Progress, report
from vsfsim.cli.options import DatasetFolder, JsonFile, TaskName, complete_task

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


@app.command()
def audit(task: Annotated[str, typer.Argument(metavar="TASK", autocompletion=complete_task,
                                              help="Name of a task (`vsfsim tasks`), or the path of its .toml file.")],
          results: Annotated[list[Path] | None, typer.Argument(metavar="RESULT", help="More result files, or folders; "
                                                                                      "default: results/TASK.")] = None,
          dataset: DatasetFolder = None,
          fresh: Annotated[list[Path] | None, typer.Option(metavar="DIR", help="Folder of results of the same methods "
                                                                               "on objects of another seed; may be "
                                                                               "given again.")] = None,
          source: Annotated[list[Path] | None, typer.Option(metavar="DIR", help="Folder of results of the same methods "
                                                                                "trained on another scene; may be "
                                                                                "given again.")] = None,
          ship: Annotated[Path | None, typer.Option(metavar="DIR", help="For developers: write what needs data or "
                                                                        "further rows to DIR/audits/TASK.json.")
                          ] = None, json: JsonFile = None) -> None:
    """Measure whether a task measures what it says.

    Four diagnostics: what methods reach that do not look at everything, which share of neighbouring ranks differ and
    the least difference that can be told, and whether the ranks hold on fresh objects and with other training data.
    """
    from vsfsim.bench.commands import audit as module
    from vsfsim.bench.task import load_task

    wanted = load_task(task)
    own = Path("results") / wanted.name
    with Progress("audit") as progress:
        found = module.audit(wanted, results or ([own] if own.is_dir() else []), dataset=dataset, fresh=fresh or (),
                             source=source or (), progress=progress)
    if ship is not None:
        found.ship(ship / "audits" / f"{wanted.name}.json", wanted.sha256)
    report(module.text(found, f"{wanted.primary} at {wanted.ranking_shot}-shot"), asdict(found), json)


@app.command()
def seal(dataset: Annotated[Path, typer.Argument(metavar="DATASET", help="Folder of the dataset to seal.")],
         task: TaskName,
         public: Annotated[Path, typer.Option(metavar="DIR", help="New folder for pictures, support touches and query "
                                                                  "paths.")],
         private: Annotated[Path, typer.Option(metavar="FILE", help="New file for the text that the commitment is of. "
                                                                    "Keep it with the dataset.")],
         json: JsonFile = None) -> None:
    """Divide a dataset into a public and a private part, with a commitment.

    The public part holds no query reading, no truth and no seed. Answers to it are scored against the private part:

    \b
      from pathlib import Path
      import numpy as np
      from vsfsim.bench.sealed import questions
      from vsfsim.bench.task import load_task
      answers = {}
      for q in questions(Path("public"), load_task("my-task-v1.toml")):
          method.adapt(q.view, q.support)                # after method.meta_fit(...) on other objects
          answers |= zip(q.keys, method.predict(q.actions))
      np.savez("predictions.npz", **answers)

    \b
      vsfsim score predictions.npz --task my-task-v1.toml --dataset DATASET --sealed private.json --name mine
    """
    from vsfsim.bench import sealed
    from vsfsim.bench.task import load_task, open_dataset

    data = open_dataset(wanted := load_task(task), dataset)
    commitment = sealed.seal(wanted, data, public, private)
    guess = f"\nnote: seed {data.recipe.seed} is found by trying; seal data of a seed with 12 digits or more" if (
        data.recipe.seed < sealed.FEWEST_SEEDS) else ""
    report(f"public part: {public}\nprivate part: {private} and {dataset}; keep both\ncommitment to publish: "
           f"{commitment}{guess}", {"public": str(public), "private": str(private), "commitment": commitment}, json)
