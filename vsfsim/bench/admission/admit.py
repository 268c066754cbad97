"""Whether a result may be ranked: its scores are computed again, and its data are compared with the task's record.

A result file is a text that anybody can write. These checks find mistakes, old files and other data; they cannot tell
an honest file from one that was written by hand to pass them. Who ranks rows of strangers runs their methods again.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vsfsim.bench.admission import fingerprint, same_data
from vsfsim.bench.metrics import METRICS, PER_OBJECT, Answer
from vsfsim.bench.result import Result
from vsfsim.bench.task import Task
from vsfsim.bench.trials.result_fields import OLD_VERSION
from vsfsim.bench.trials.rows import Score, as_rows
from vsfsim.core.errors import TaskError

ROUNDING = 1e-6
"""Relative difference up to which a stored score is the one that its rows give; sums are stored to 16 digits."""
_UNDERFLOW = float(np.finfo(np.float32).tiny)  # sums of smaller squares are stored as 0


@dataclass(frozen=True)
class Admission:
    """What the board thinks of a result."""

    reason: str
    """Why it is not ranked, or ""."""
    scores: Mapping[str, Mapping[str, Score]]
    """By metric and shot, computed from its rows. Of an old result, metrics of which it kept no rows are those that it
    says; they are shown and never rank."""
    same_bits: bool
    """Its dataset has the very bits of the task's record."""


def admit(result: Result, task: Task, record: fingerprint.Record | None) -> Admission:
    """Look at a result before it is ranked.

    Args:
        result: the result. task: of the board. record: of the task's dataset; None if the task has none, so that the
        board compares the results with one another.
    """
    try:
        scores = result.computed()
    except (KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError):
        return Admission("its rows cannot be scored", {}, False)
    same_bits = record is not None and result.dataset_sha256 == record.dataset_sha256
    reason = (_other_task(result, task) or _wrong_rows(result, task, record) or _wrong_scores(result, scores)
              or _wrong_primary(result, task, scores) or ("" if same_bits else _other_data(result, record)))
    said = {} if result.schema_version > OLD_VERSION else {
        name: by_shot for name, by_shot in result.scores.items() if name not in scores}
    return Admission(reason, {**said, **scores}, same_bits)


def _other_task(result: Result, task: Task) -> str:
    if result.task_sha256 != task.sha256:
        return "other text of the task"
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


def _wrong_rows(result: Result, task: Task, record: fingerprint.Record | None) -> str:
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
    for row in rows:
        n, sse, sae = row["n"], row["sse"], row["sae"]
        slack = 1.0 + ROUNDING
        if (n != sizes[row["object"], row["touch"]] or sse > slack * sae**2 + _UNDERFLOW
                or sae**2 > slack * n * (sse + _UNDERFLOW)):
            return "sums of errors that no errors have"
    return ""


def _wrong_scores(result: Result, scores: Mapping[str, Mapping[str, Score]]) -> str:
    """Whether the stored scores are those of the rows; those of an old result, as far as its rows tell."""
    for name, by_shot in result.scores.items():
        metric = METRICS.get(name)
        if metric is None or (result.schema_version == OLD_VERSION and metric.answer is not Answer.READINGS):
            continue
        for shot, score in by_shot.items():
            found = scores.get(name, {}).get(shot)
            if found is None or not all(math.isclose(a, b, rel_tol=ROUNDING, abs_tol=1e-12) for a, b in zip(
                    (score.mean, *score.per_seed), (found.mean, *found.per_seed), strict=True)) or not math.isclose(
                    score.std, found.std, rel_tol=1e-3, abs_tol=ROUNDING * max(abs(score.mean), 1e-6)):
                return f"its {name} at {shot}-shot is not that of its rows"
    return ""


def _wrong_primary(result: Result, task: Task, scores: Mapping[str, Mapping[str, Score]]) -> str:
    if task.ranking_shot in scores.get(task.primary, {}):  # of an old result, computed ones only
        return ""
    if result.schema_version == OLD_VERSION and task.metric.answer in PER_OBJECT and task.primary in result.scores:
        return "made by an older vsfsim, which kept nothing to compute it from again; evaluate it again"
    return f"no {task.primary} at {task.ranking_shot}-shot"


def _other_data(result: Result, record: fingerprint.Record | None) -> str:
    if record is None:
        return ""
    if not result.data:
        return f"other dataset ({result.dataset_sha256[:12]}), of which nothing is known"
    try:
        found = fingerprint.Record.read(result.data, "data")
    except TaskError:
        return "its fingerprints of the dataset cannot be read"
    odd = same_data.differences(found, record)
    return f"other dataset ({result.dataset_sha256[:12]}): {'; '.join(odd)}" if odd else ""
