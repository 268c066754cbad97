"""`vsfsim submit RESULT`: everything that the leaderboard checks of a row, and the pull request that brings it."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.bench.admission.admit import admit
from vsfsim.bench.admission.fingerprint import shipped_record
from vsfsim.bench.board.compare import interval, paired
from vsfsim.bench.board.named import PREDICTIONS, claimed, command_of
from vsfsim.bench.identity import contents_of
from vsfsim.bench.leaderboard import Board, Row, collect, score_table
from vsfsim.bench.result import Result
from vsfsim.bench.task import OTHERS, Task, load_task
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import file_stem, markdown
from vsfsim.core.shelf import methods
from vsfsim.data.disk import write_atomic


@dataclass(frozen=True)
class Finding:
    """One check."""

    what: str
    """What was looked at."""
    state: str
    """"ok"; "told", which the pull request says; or "refused"."""
    said: str
    """One sentence, "" where all is well."""


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
    task = task or load_task(result.task)
    board = collect(task, [path])
    row = _row_of(board, path, result)
    findings = list(_findings(result, task, row))
    refused = [one for one in findings if one.state == "refused"]
    listed = "\n".join(f"{one.state:<9}{one.what}" + (f": {one.said}" if one.said else "") for one in findings)
    if refused:
        raise TaskError(f"{path} is no row of {task.name} yet, and nothing was written:\n\n{listed}\n")
    assert row is not None
    name = file_stem(f"{result.method}.{result.preset}" if result.preset else result.method)
    target, text = out / "leaderboard" / task.name / f"{name}.json", out / "PULL_REQUEST.md"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TaskError(f"folder {target.parent} cannot be made: {error.strerror}. Choose another --out.") from error
    write_atomic(target, path.read_bytes(), error=TaskError)
    write_atomic(text, _pull_request(result, board, row, findings, target.relative_to(out)).encode(), error=TaskError)
    words = (f"{listed}\n\n{_place(board, row)}\n\nrow: {target}\npull request: {text}\n\nCopy the folder leaderboard/ "
             f"of {out} into a fork of the repository, answer the two questions at the end of the text, and send it.")
    return words, {"task": task.name, "method": result.method, "rank": row.rank, "row": str(target),
                   "pull_request": str(text),
                   "checks": [{"what": f.what, "state": f.state, "said": f.said} for f in findings]}


def _row_of(board: Board, path: Path, result: Result) -> Row | None:
    """The board's row of the result: its own, or the equal one that was there before."""
    mine = [row for row in board.rows if row.path == path]
    same = [row for row in board.rows if row.origin == "shipped, made again here" and (
        row.result.method, row.result.preset) == (result.method, result.preset)]
    return next(iter(mine + same), None)


def _findings(result: Result, task: Task, row: Row | None) -> Iterator[Finding]:
    def ok(what: str, refused: str) -> Finding:
        return Finding(what, "refused" if refused else "ok", refused)

    def told(what: str, said: str) -> Finding:
        return Finding(what, "told" if said else "ok", said)

    yield ok("the task is a current one", f"it is superseded by {task.superseded_by}; evaluate on that"
             if task.superseded_by else "")
    yield ok("complete, scored by its own rows, on the task's data", admit(result, task, shipped_record(task)).reason)
    yield ok("not on the board yet", "a row with the same scores ships already" if row is not None and
             row.origin != "made here" else "")
    yield ok("its name is its own", f"'{result.method}' is a method that ships, and this is another one, or another "
             f"version of it; give it a name of its own, or evaluate again" if claimed(result, task) else "")
    if result.entry == PREDICTIONS:
        yield told("others can run it again", "it is a file of predictions, so that nobody can: it stays unverified")
        return
    package = result.package.get("name", "")
    yield ok("others can run it again", "" if package else "the method is a file, not an installed package. `vsfsim "
             "new-method NAME` begins one; install it and evaluate again")
    yield ok("its source is the one that is here", _other_source(result))
    yield told("it ran in a container", "" if result.isolation not in ("", "process") else
               f"its sandbox was '{result.isolation or 'none'}', in which a method can see files of yours")
    commit = str(result.made_by.get("commit") or "")
    yield told("it was scored by committed code", f"vsfsim had changes over {commit[:7]}" if "+" in commit else "")
    data = str(result.dataset_made_by.get("commit") or "")
    yield told("its data was made by committed code", f"vsfsim had changes over {data[:7]}" if "+" in data else "")
    if row is not None:
        yield told("its data has the record's bits", "the dataset was made on a machine that rounds otherwise"
                   if row.other_bits else "")


def _other_source(result: Result) -> str:
    """Why the method that is installed here would not give these answers, or ""."""
    if not result.contents:
        return "the result does not say of which source it is; evaluate again"
    if result.method not in methods():
        return f"'{result.method}' is not installed here, so that its source cannot be compared; submit where it is"
    here = contents_of(result.method, result.parameters, opened=result.contents)
    odd = [key for key, value in result.contents.items() if key != "the harness" and here.get(key) != value]
    return f"{' and '.join(odd)} changed since; evaluate again" if odd else ""


def _place(board: Board, row: Row) -> str:
    """Where the row would stand."""
    ranked = [one for one in board.rows if one.rank is not None]
    shot, best = board.task.ranking_shot, ranked[0]
    if not row.objects:
        return f"rank {row.rank} of {len(ranked)} on {board.task.name}"
    mean, error = interval(row.objects[shot])
    words = (f"rank {row.rank} of {len(ranked)} on {board.task.name}: {board.task.primary} {mean:.3f} ± {error:.3f} at "
             f"{shot}-shot")
    if row is best:
        return words
    apart = paired(row.objects[shot], best.objects[shot])
    return f"{words}; {apart.mean:+.3f} ± {apart.error:.3f} from {best.result.method}, object by object"


def _pull_request(result: Result, board: Board, row: Row, findings: Sequence[Finding], file: Path) -> str:
    task, package = board.task, result.package
    lines = [f"# {markdown(result.method)} on {task.name}", "", f"{_place(board, row)}. The row is `{file}`.", "",
             "```", score_table(result, task.primary), "```", "", "## How to run it again", "", "```bash"]
    if package.get("name") and package["name"] != "vsfsim":
        lines.append(shlex.join(["pip", "install", f"{package['name']}=={package['version']}"])
                     + "   # or where its source is: ...")
    lines += [task.dataset.command(), command_of(result, whole=True), "```", "", "## What it rests on", "",
              "| | |", "|---|---|"]
    facts = {"entry": result.entry, "package": " ".join(package.values()), "preset": result.preset or "none",
             "parameters": json.dumps(dict(result.parameters), default=str), "task sha256": result.task_sha256,
             "dataset sha256": result.dataset_sha256, "sandbox": result.isolation or "none",
             "vsfsim": f"{result.made_by.get('vsfsim')} {result.made_by.get('commit') or ''}",
             "machine": f"{result.machine.get('cpu')}, {result.machine.get('cores')} cores",
             **{f"sha256 of {key}": value for key, value in result.contents.items()}}
    lines += [f"| {key} | {markdown(value)} |" for key, value in facts.items()]
    lines += ["", "## Checks of `vsfsim submit`", ""]
    lines += [f"- {one.state}: {one.what}" + (f" ({markdown(one.said)})" if one.said else "") for one in findings]
    lines += ["", "## For you to answer", "", "- On which objects were settings and preset chosen (training, "
              "development, test)?", "- Which paper or page describes the method?", ""]
    return "\n".join(lines)
