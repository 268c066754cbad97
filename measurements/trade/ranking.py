"""What fidelity does to a ranking of methods: `vsfsim measure ranking`.

One small task is made at several fidelities, with the same objects and touches. The same methods are scored on each: on
data of that fidelity alone, and on the finest data after they have learned from the training objects of the cheap ones.
Kendall's tau compares each ranking with that of the finest data; its interval is from draws of the test objects with
replacement.

The error on the finest data is also split: what falls away without the sensor's noise is of the noise, what falls away
with all the touches that are not asked is of too few touches, and the rest is of the method's model.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from measurements.stability.team import kept
from vsfsim.bench.board.compare import by_object
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.task import Task, parse_task
from vsfsim.bench.trials.training import PLAIN, Extra, Training
from vsfsim.core.scene import load_scene
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import text_sha256
from vsfsim.generate import run

SCENE = Path(__file__).parent / "ranking.toml"
TASK = """
name = "ranking-v1"
description = "The force of a ball on foam blocks of two layers."
[dataset]
folder = "ranking"
scene = "ranking"
seed = 0
objects = {objects}
views = 1
touches = {touches}
tier = "auto"
[protocol]
train = "train"
test = "test"
shots = [{shots}]
seeds = 2
query = {query}
seed = 0
[observation]
kind = "normal-force"
[noise]
force_std = {force}
offset_std = {force}
drift_std = {drift}
tare_frames = 2
seed = 0
[metrics]
primary = "rmse_ratio"
ranking_shot = {shots}
"""
SHOTS, QUERY = 4, 4
"""Touches that are learned from, and that are asked."""
NOISE, QUIET = {"force": 0.05, "drift": 0.01}, {"force": 0.0, "drift": 0.0}
METHODS = ("gaussian", "gaussian-zero", "near-springs", "surface-gp", "contact-points")
_NO_VIEW = 99  # number of a view that no object has: nothing is learned from the finest data
_DRAWS = 2000
_EVENLY = 95.0


@dataclass(frozen=True)
class Fidelity:
    """One way to make the data."""

    name: str
    tier: str
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the recipe, see `vsfsim.generate.job.Job.scene`."""


FINEST = Fidelity("fem", "fem")
FIDELITIES = (Fidelity("vsf", "vsf"), Fidelity("linear", "linear"), Fidelity("fem-coarse", "fem-coarse"),
              Fidelity("fem, half the frames", "fem", {"frames": 2}), FINEST)


def kendall(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Kendall's tau (...,) [-] of two rows of values (..., m): the mean over pairs of +1 where both order them alike,
    -1 where not, 0 at a tie."""
    first, second = np.triu_indices(one.shape[-1], 1)
    return np.mean(np.sign(one[..., first] - one[..., second]) * np.sign(other[..., first] - other[..., second]), -1)


def agreement(one: np.ndarray, other: np.ndarray, *, seed: int = 0) -> tuple[float, float, float]:
    """Tau of the means over objects, and its 95 % interval over draws of the objects.

    Args:
        one, other: errors of methods on objects (m, n).
        seed: of the draws.
    """
    draws = np.random.default_rng(seed).integers(0, one.shape[1], (_DRAWS, one.shape[1]))
    taus = kendall(*(np.moveaxis(values[:, draws].mean(axis=2), 0, -1) for values in (one, other)))
    low, high = np.percentile(taus, [50.0 - _EVENLY / 2.0, 50.0 + _EVENLY / 2.0])
    return float(kendall(one.mean(axis=1), other.mean(axis=1))), float(low), float(high)


def made(fidelity: Fidelity, folder: Path, *, objects: int, touches: int, workers: int) -> Dataset:
    """The data of a fidelity; what is there is not made again."""
    return run.generate(load_scene(SCENE), folder / fidelity.name.replace(", ", "-").replace(" ", "-"),
                        objects=objects, touches=touches, tier=fidelity.tier,
                        workers=workers, bought=fidelity.options)


def measure(*, fidelities: Sequence[str] = (), methods: Sequence[str] = METHODS, objects: int = 24, touches: int = 10,
            workers: int = 1, out: Path = Path("ranking"), progress: Progress = lambda said: None) -> Measurement:
    """The table.

    Args:
        fidelities: names of `FIDELITIES`; empty for all. The finest is always made.
        methods: at least two.
        objects: half of them to learn from.
        touches: of each, at least 8.
        workers: processes.
        out: folder of the data and of what was scored; a later run goes on with it.
        progress: called with what is going on.
    """
    task, quiet, many = (
        parse_task(TASK.format(objects=objects, touches=touches, shots=shots, query=QUERY, **noise), SCENE)
        for noise, shots in ((NOISE, SHOTS), (QUIET, SHOTS), (QUIET, touches - QUERY)))
    data: dict[str, Dataset] = {}
    for one in FIDELITIES:
        if not fidelities or one.name in fidelities or one is FINEST:
            progress(f"{one.name}: {objects} objects")
            data[one.name] = made(one, out, objects=objects, touches=touches, workers=workers)
    scored = _scored(task, data, methods, out / "scores.jsonl", workers, progress)
    rows = []
    best = scored[FINEST.name, FINEST.name]
    for name in data:
        row: dict[str, Any] = {"fidelity": name}
        for key, values in (("own", scored[name, name]), ("fine", scored[name, FINEST.name])):
            tau, low, high = agreement(values, best)
            row |= {f"{key}_tau": tau, f"{key}_interval": f"{low:.2f} to {high:.2f}",
                    **{f"{key}.{m}": float(v) for m, v in zip(methods, values.mean(axis=1), strict=True)}}
        rows.append(row)
    flat = [{**row, **{f"{key}_{m}": row[f"{key}.{m}"] for key in ("own", "fine") for m in methods}} for row in rows]
    finest = {FINEST.name: data[FINEST.name]}
    silent, all_ = (_scored(one, finest, methods, out / "scores.jsonl", workers, progress)[FINEST.name, FINEST.name]
                    for one in (quiet, many))
    parts = zip(methods, best.mean(axis=1).tolist(), silent.mean(axis=1).tolist(), all_.mean(axis=1).tolist(),
                strict=True)
    return found_of(flat, {"objects": objects, "touches": touches, "methods": list(methods)}, [
        {"method": m, "error": e, "noise": e - s, "touches": s - a, "model": a} for m, e, s, a in parts])


def found_of(rows: Sequence[Mapping[str, Any]], settings: Mapping[str, Any],
             split: Sequence[Mapping[str, Any]] = ()) -> Measurement:
    """The measurement of these rows, and of those of the parts of the error."""
    methods = settings["methods"]
    columns = [Column("fidelity", "fidelity"),
               *(Column(f"own_{m}", m, "1", "", ".3f") for m in methods),
               Column("own_tau", "tau", "1", "", ".2f"), Column("own_interval", "95 %"),
               *(Column(f"fine_{m}", f"{m}, tested on fem", "1", "", ".3f") for m in methods),
               Column("fine_tau", "tau, tested on fem", "1", "", ".2f"), Column("fine_interval", "95 %")]
    return Measurement.of("ranking", settings, [
        Table("Error over that of predicting zero, after four touches, of methods trained and tested on one fidelity, "
              "and trained on it and tested on fem; Kendall's tau against the ranking on fem", columns, rows,
              name="ranking"),
        Table(f"Parts of that error on fem: of the sensor's noise, of {SHOTS} touches in place of "
              f"{settings['touches'] - QUERY}, and what the model leaves",
              [Column("method", "method"), *(Column(key, words, "1", "", ".3f") for key, words in (
                  ("error", "error"), ("noise", "noise"), ("touches", "too few touches"), ("model", "model")))],
              split, name="split")])


def _scored(task: Task, data: Mapping[str, Dataset], methods: Sequence[str], file: Path, workers: int,
            progress: Progress) -> dict[tuple[str, str], np.ndarray]:
    """Errors (m, n) of the methods on the test objects, by what they learn from and what they are tested on."""
    done = {row["key"]: row["values"] for row in kept(file, {}, "vsfsim measure ranking")}
    pairs = list(dict.fromkeys(pair for name in data for pair in ((name, name), (name, FINEST.name))))

    def key(learned: str, tested: str, method: str) -> str:
        named = (method, data[learned].sha256, data[tested].sha256, text_sha256(task.sha256))
        return " ".join(word[:16] for word in named)

    def score(asked: tuple[str, str, str]) -> tuple[str, dict[str, float]]:
        learned, tested, method = asked
        training = PLAIN if learned == tested else Training(
            train_views=(_NO_VIEW,),
            extra=(Extra(task, data[learned], len({e.object_index for e in data[learned].entries}) // 2),))
        result = evaluate(method, task, data[tested], training=training, check=False)
        return key(*asked), by_object(result, task.primary, task.ranking_shot)

    asked = [(a, b, m) for a, b in pairs for m in methods if key(a, b, m) not in done]
    with ThreadPoolExecutor(workers) as pool, open(file, "a") as lines:
        for number, (name, values) in enumerate(pool.map(score, asked), start=1):
            done[name] = values
            lines.write(json.dumps({"key": name, "values": values}) + "\n")
            lines.flush()
            progress(f"{number} of {len(asked)} scores ...")
    return {(a, b): np.array([[done[key(a, b, m)][n] for n in sorted(done[key(a, b, m)])] for m in methods])
            for a, b in pairs}
