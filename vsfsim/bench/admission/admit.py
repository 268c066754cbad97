"""Whether a result may be ranked: its scores are computed again, and its data are compared with the task's record.

A result file is a text that anybody can write. These checks find mistakes, old files and other data; they cannot tell
an honest file from one that was written by hand to pass them. Who ranks rows of strangers runs their methods again.

Two records are of the same dataset up to what rounding decides. Rounding alone changes a touch with a unique
equilibrium by 1e-8. Where an object has several, as a plant whose branches snap off a link of the arm, the last digit
decides which one it comes to, and from there on the touch is another one: the same code makes other readings of a large
share of the same touches on another machine. How large this share is was measured for such a task and stands in its
record (`Record.again`); a dataset is the task's if it differs no more than that.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import msgspec
import numpy as np

from vsfsim.bench.admission.fingerprint import IMAGES, READING, SCALE, Record
from vsfsim.bench.board.compare import Runs, curve
from vsfsim.bench.board.rows import CEILING, CLAIMED, UNLISTED, Entry, claimed, is_ceiling, row_sha256
from vsfsim.bench.metrics import Score
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import as_rows
from vsfsim.bench.task import Task
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import plain

OTHER_TEXT = "other text of the task"
LONGEST_NAME = 100
"""Characters of the name of a method, a preset or a parameter, which a table is as wide as."""


@dataclass(frozen=True)
class Row:
    """One method on a board."""

    result: Result
    """The result."""
    path: Path
    """Its file."""
    mark: str
    """Why it is not ranked, or ""."""
    scores: Mapping[str, Mapping[str, Score]]
    """Its scores by metric and shot, computed from its rows."""
    other_bits: bool
    """Its dataset is the board's, made on a machine that rounds otherwise."""
    entry: Entry | None
    """What the repository's list says of it; None where it is not listed."""
    origin: str
    """"shipped", "made here", or "shipped, made again here"."""
    values: Mapping[str, Runs] = field(default_factory=dict)
    """The task's metric of each object in each run, by shot, and the area under it (`compare.curve`)."""
    rank: int | None = None
    """From 1; None where the result may not be ranked."""
    wins: float = math.nan
    """Share of the objects on which it errs less than another ranked row, mean over these (`compare.wins`)."""

    @property
    def evidence(self) -> str:
        """What the repository's list says that it rests on (`vsfsim.bench.board.rows.Entry`)."""
        return self.entry.evidence if self.entry else "open"

    def admitted(self) -> Result:
        """The result with the scores of its rows.

        Raises:
            TaskError: it may not ship.
        """
        if self.mark not in ("", CEILING):
            raise TaskError(f"{self.path} is no row: {self.mark}.")
        return replace(self.result, scores=self.scores)

    @property
    def signs(self) -> str:
        """Behind the name: * not ranked, ~ other bits."""
        return " *" if self.mark else " ~" if self.other_bits else ""


def admit(result: Result, path: Path, task: Task, record: Record | None, reference: str,
          entries: Mapping[str, Entry], *, made_here: bool) -> Row:
    """Look at a result before it is ranked: is it of the task, are its rows complete and its data the task's, and is it
    of the method whose name it has? Its scores are computed from its rows; what it says of them is not read.

    Args:
        result: the result. path: of its file. task: of the board. record: of the task's dataset; None if the task has
        none, so that only the same bits are ranked. reference: sha256 of the board's dataset. entries: the repository's
        list. made_here: it does not ship, so that it is on no list.
    """
    origin = "made here" if made_here else "shipped"
    packed = bool(result.values)  # without its rows; its data were looked at before it was listed
    if packed:
        scores, reason = result.scores, "" if result.task_sha256 == task.sha256 else OTHER_TEXT
    else:
        try:
            scores, other = result.computed(), result.dataset_sha256 != reference
        except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
            return Row(result, path, "its rows cannot be scored", {}, False, None, origin)
        reason = (_other_task(result, task) or _wrong_rows(result, task, record)
                  or "; ".join(f"no {task.primary} at {label}-shot" for label in task.protocol.labels
                               if label not in scores.get(task.primary, {}))
                  or (_other_data(result, record) if other else ""))
    entry = None if made_here else entries.get(row_sha256(replace(result, scores=scores)))
    if packed:
        other = entry is not None and entry.other_bits
    if not reason and entry is None and (packed or claimed(result, task)):
        reason = UNLISTED if packed else CLAIMED
    elif not reason and is_ceiling(result):
        reason = CEILING
    values = curve(result, task) if reason in ("", CEILING) else {}
    return Row(result, path, reason, scores, other and not reason, entry, origin, values)


def _other_task(result: Result, task: Task) -> str:
    if result.task_sha256 != task.sha256:
        return OTHER_TEXT
    names = (result.method, result.preset or "none", *result.parameters)
    if any(shlex.quote(name) != name or len(name) > LONGEST_NAME for name in names):
        return (f"a name of it is empty, too long or means something to a shell: give up to {LONGEST_NAME} letters, "
                f"digits and . _ - : +")
    if result.study:
        return "a study's, which learned from other objects than the task's"
    if (result.shots, result.observation) != (task.protocol.labels, task.observation.name):
        return "other shots or another observation than the task's"
    wanted = set(task.protocol.runs(seeded="seed" in result.parameters))
    if wanted - set(result.seeds):
        return f"{len(wanted & set(result.seeds))} of the task's {len(wanted)} seeds"
    if len(result.seeds) != len(wanted):
        return f"{len(result.seeds)} seeds, more than the task's {len(wanted)}"
    return ""


def _wrong_rows(result: Result, task: Task, record: Record | None) -> str:
    """Whether every query touch was answered once at every shot and seed, with sums that errors can have."""
    rows = as_rows(result.queries)
    counts = Counter((row["object"], row["touch"], row["shot"], row["seed"]) for row in rows)
    asked = {(name, touch) for name, touch, _, _ in counts}
    if record is not None:
        wanted = {(e.name, touch) for e in record.entries for touch in e.query}
        if asked != wanted:
            return "other query touches than those of the task"
    if any(n != task.protocol.query for n in Counter(name for name, _ in asked).values()):
        return f"other than {task.protocol.query} query touches an object"
    every = {(*touch, shot, seed) for touch in asked for shot in result.shots for seed in result.seeds}
    if set(counts) != every or max(counts.values(), default=1) != 1:
        return "a query touch is missing or there twice at some shot and seed"
    sizes = {(row["object"], row["touch"]): row["n"] for row in rows}
    if any(row["n"] != sizes[row["object"], row["touch"]] for row in rows):
        return "another number of readings of a touch at some shot and seed"
    return ""


def _other_data(result: Result, record: Record | None) -> str:
    """Why the data, whose bits are others than those of the board's, are others by their fingerprints."""
    if record is None or not result.data:
        return f"other dataset ({result.dataset_sha256[:12]}), of which nothing is known"
    try:
        odd = differences(msgspec.convert(result.data, Record), record)
    except (ValueError, KeyError, TypeError, RecursionError):
        return "its fingerprints of the dataset cannot be read"
    return f"other dataset ({result.dataset_sha256[:12]}): {'; '.join(odd)}" if odd else ""


TOLERANCE = 1e-3
"""Largest relative difference of a fingerprint: rounding alone gives 1e-8 in a touch with a unique equilibrium, and
quantisation 1.2e-4; other seeds, scenes or physics differ by tens of per cent."""
IMAGE_TOLERANCE = 2e-2
"""The same for an image averaged in blocks: five flipped pixels on an outline give 0.4 %, another shoe 10 %."""
OTHER_ENDS = 0.02
"""Largest share of the touches that may read otherwise: where a frame ends at a limit of the solver, rounding decides
whether it converges (13 of the 1,440 frames of the bubble shoes do)."""
AGAIN = 1.25
"""Factor on the share of touches that another machine was seen to make otherwise: a third machine is not the second."""
SMALLEST = 1e-2
"""A vector smaller than this fraction of the root mean square of its kind counts as that large: the readings of a touch
that met nothing are rounding error."""


def differences(found: Record, known: Record) -> list[str]:
    """What is different in ``found`` from the record ``known``: a phrase a difference, [] if it is the same data.

    Raises:
        ValueError, KeyError, TypeError: a record is malformed.
    """
    out, odd, share = apart(found, known)
    allowed = max(OTHER_ENDS, AGAIN * known.again)
    if share > allowed:
        out.append(f"{len(odd)} of its touches read otherwise ({plain(odd[0])}), {100.0 * share:.3g} % of all, where "
                   f"rounding decides at most {100.0 * allowed:.3g} %")
    return out


def apart(found: Record, known: Record) -> tuple[list[str], list[str], float]:
    """Where two records differ: phrases on what no rounding changes; the touches that read otherwise; and their
    share [-]. Where the two cannot be compared number by number, a phrase says so and nothing else is known."""
    (mine, a, one), (theirs, b, other) = found.fingerprints(), known.fingerprints()
    views = [[(e.name, e.split, e.object_index, e.view_index) for e in r.entries] for r in (found, known)]
    if views[0] != views[1]:
        strange = sorted({name for name, *_ in {*views[0]} ^ {*views[1]}}) or [views[0][0][0]]
        return [f"its object views or their splits are others, e.g. {plain(strange[0])}"], [], 0.0
    if [e.query for e in found.entries] != [e.query for e in known.entries] or mine != theirs:
        return ["it has other touches"], [], 0.0
    kinds = np.array([what for *_, what in theirs])
    kind = np.unique(kinds, return_inverse=True)[1]
    floors = SMALLEST * np.sqrt(np.bincount(kind, b**2) / np.bincount(kind))  # as which a smaller vector counts
    along = np.abs(a[:, None] * one - b[:, None] * other).max(axis=1) / SCALE
    tolerance = np.where(np.isin(kinds, IMAGES), IMAGE_TOLERANCE, TOLERANCE)
    far = ~(np.maximum(np.abs(a - b), along) <= tolerance * np.maximum(b, floors[kind]))
    read = kinds == READING
    names = [f"{view}{f' touch {number - 1}' if number else ''}" for view, number, _ in theirs]
    wrong = [f"{names[k]}: {kinds[k]}" for k in np.flatnonzero(far & ~read)]
    out = [f"{len(wrong)} pictures or directions differ ({plain(wrong[0])})"] if wrong else []
    odd = [names[k] for k in np.flatnonzero(far & read)]
    return out, odd, len(odd) / max(int(read.sum()), 1)
