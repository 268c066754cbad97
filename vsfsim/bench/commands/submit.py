"""`vsfsim submit RESULT`: everything that the leaderboard checks of a row, and the pull request that brings it."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from vsfsim.bench.admission.admit import Row
from vsfsim.bench.board.rows import CEILING, CLAIMED, PREDICTIONS, command_of
from vsfsim.bench.board.templates import filled
from vsfsim.bench.identity import SCORER, changed
from vsfsim.bench.leaderboard import collect
from vsfsim.bench.result import Result
from vsfsim.bench.task import OTHERS, Task, load_task, retired
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import file_stem
from vsfsim.core.shelf import methods, tasks
from vsfsim.data.disk import write_atomic


def submit(path: Path, out: Path, *, task: Task | None = None) -> tuple[str, dict[str, Any]]:
    """Check a result and write its pull request.

    Args:
        path: of the result. out: folder for the row, leaderboard/TASK/NAME.json, and PULL_REQUEST.md. task: whose row
        it is; None for the installed task of the result's name.

    Returns:
        The text to print, and the same for JSON.

    Raises:
        TaskError: the file is not a result, its task is unknown, or a check refuses it; nothing is written then.
    """
    result = Result.load(path)
    others = OTHERS.fullmatch(result.task)
    if others is not None:
        raise TaskError(f"{path} is a result of {result.task}, which has other objects than {others[1]}; it is no row. "
                        f"Evaluate the method on {others[1]} with the settings that were chosen.")
    if task is None and result.task not in {*tasks(), *retired()}:
        raise TaskError(f"{path} is a result of task '{result.task}', which is not installed here. Give the task's "
                        f"file: vsfsim submit {shlex.quote(str(path))} --task FILE.toml")
    task = task or load_task(result.task)
    board = collect(task, [path])
    mine = [row for row in board.rows if row.path == path]
    same = [row for row in board.rows if row.origin == "shipped, made again here" and (
        row.result.method, row.result.preset) == (result.method, result.preset)]
    row = (mine + same)[0]
    checks = [{"what": what, "state": weight if said else "ok", "said": said}
              for what, weight, said in _findings(result, task, row)]
    told = "\n".join(f"{one['state']:<9}{one['what']}" + (f": {one['said']}" if one["said"] else "") for one in checks)
    if any(one["state"] == "refused" for one in checks):
        raise TaskError(f"{path} is no row of {task.name} yet, and nothing was written:\n\n{told}\n")
    name = file_stem(f"{result.method}.{result.preset}" if result.preset else result.method)
    target, text = out / "leaderboard" / task.name / f"{name}.json", out / "PULL_REQUEST.md"
    write_atomic(target, path.read_bytes(), error=TaskError)
    package, ranked = result.package, [one for one in board.rows if one.rank is not None]
    place = f"rank {row.rank} of {len(ranked)} on {task.name}"
    install = shlex.join(["pip", "install", f"{package['name']}=={package['version']}"]) if (
        package.get("name") not in (None, "", "vsfsim")) else ""
    page = filled("pull_request.md", result=result, task=task, place=place, file=str(target.relative_to(out)),
                  scores=replace(result, scores=row.scores).table(task.primary),
                  install=install, again=command_of(result, whole=True), findings=checks)
    write_atomic(text, f"{page}\n".encode(), error=TaskError)
    words = (f"{told}\n\n{place}\n\nrow: {target}\npull request: {text}\n\nCopy the folder leaderboard/ of {out} into "
             f"a fork of the repository, answer the two questions at the end of the text, and send it.")
    return words, {"task": task.name, "method": result.method, "rank": row.rank, "row": str(target),
                   "pull_request": str(text), "checks": checks}


def _findings(result: Result, task: Task, row: Row) -> Iterator[tuple[str, str, str]]:
    """What was looked at, what becomes of the row where something is wrong, and what is wrong, or ""."""
    refused, told = "refused", "told"
    yield ("complete, scored by its own rows, on the task's data", refused,
           row.mark if row.mark not in (CLAIMED, CEILING) else "")
    yield ("not on the board yet", refused, "a row with the same scores ships already" if row.origin != "made here" else
           "")
    yield ("its name is its own", refused, f"'{result.method}' is a method that ships, and this is another one, or "
           f"another version of it; give it a name of its own, or evaluate again" if row.mark == CLAIMED else "")
    if result.entry == PREDICTIONS:
        yield ("others can run it again", told, "it is a file of predictions, so that nobody can: it stays unverified")
        return
    yield ("others can run it again", refused, "" if result.package.get("name") else "the method is a file, not an "
           "installed package. `vsfsim lab new-method` begins one; install it and evaluate again")
    yield ("its source is the one that is here", refused, _other_source(result))
    yield ("it ran in a container", told, "" if result.isolation not in ("", "process") else
           f"its sandbox was '{result.isolation or 'none'}', in which a method can see files of yours")
    for what, made_by in (("it was scored", result.made_by), ("its data was made", result.dataset_made_by)):
        commit = str(made_by.get("commit") or "")
        yield f"{what} by committed code", told, f"vsfsim had changes over {commit[:7]}" if "+" in commit else ""
    yield ("its data has the record's bits", told,
           "the dataset was made on a machine that rounds otherwise" if row.other_bits else "")


def _other_source(result: Result) -> str:
    """Why the method that is installed here would not give these answers, or ""."""
    if not result.contents:
        return "the result does not say of which source it is; evaluate again"
    if result.method not in methods():
        return f"'{result.method}' is not installed here, so that its source cannot be compared; submit where it is"
    odd = [key for key in changed(result.method, result.parameters, result.contents) if key != SCORER]
    return f"{' and '.join(odd)} changed since; evaluate again" if odd else ""
