"""What limits a field of springs on plants: `vsfsim measure plant-learning`.

`point-vsf` is fitted to the support touches of each plant and predicts its query touches, with settings changed one at
a time; then to the query touches themselves, which shows what independent springs can represent at all. Nothing is
learned from other plants.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.artificial_plants.prior import PLANTS
from benchmarks.measurement import Column, Measurement, Progress, Table
from vsfsim.baselines.particle_model import ParticleModel, VsfSettings
from vsfsim.baselines.posterior import Posterior
from vsfsim.bench.method import Reading
from vsfsim.bench.protocol import Query, divide, record
from vsfsim.bench.task import Task, load_task, open_dataset
from vsfsim.data.records import ObjectView

PRIOR_STD, LOOSE_STD = 30.0, 100.0
"""Of a spring constant: of the preset `tuned`, and where the data are to decide alone [N/m]."""
COMMON = 3.0
"""One value for all springs, of the size that the average over other plants has [N/m]."""
ALL = "all touches"


def measure(task: str, *, folder: Path | None = None, workers: int = 1,
            progress: Progress = lambda _: None) -> Measurement:
    """Error of the query touches over that of predicting zero, for every variant.

    Args:
        task: name or path of a task with joint torques. For the choice of settings give a copy of another seed.
        folder: its dataset, None for where the task looks.
        workers: processes, one for a plant at a time.
        progress: called with the name of each plant.
    """
    loaded = load_task(task)
    dataset = open_dataset(loaded, folder)
    names = list(dataset.names())
    work = [(loaded, dataset[name]) for name in names]
    found: list[dict[str, float]] = []
    if workers == 1:
        for one in work:
            progress(one[1].name)
            found.append(ratios(*one))
    else:
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            for name, row in zip(names, pool.starmap(ratios, work, chunksize=1), strict=True):
                progress(name)
                found.append(row)
    return table(found, {"task": task, "sha256": dataset.sha256})


def ratios(task: Task, view: ObjectView) -> dict[str, float]:
    """Error over that of predicting zero of each variant on one object view [-]."""
    recording, draw = record(view, task), divide(view, task.protocol)
    queries = [recording.queries[i] for i in draw.query]
    support = [recording.readings[i] for i in draw.pool]
    clean = [dataclasses.replace(r, value=c) for r, c in zip(recording.readings, recording.clean, strict=True)]
    exact, asked = [clean[i] for i in draw.pool], [clean[i] for i in draw.query]
    models: dict[VsfSettings, ParticleModel] = {}

    def model_of(settings: VsfSettings) -> ParticleModel:
        if settings not in models:
            models[settings] = ParticleModel.behind(view.view, settings)
        return models[settings]

    def ratio(readings: Sequence[Reading], *, std: float = PRIOR_STD, mean: float = 0.0, **changed: float) -> float:
        settings = dataclasses.replace(PLANTS, **changed)  # type: ignore[arg-type]
        model = model_of(settings)
        return error_ratio([Posterior.of(model, readings, prior_mean=mean, prior_var=std**2)] * len(queries), queries)

    alone = [Posterior.of(model_of(PLANTS), [reading], prior_mean=0.0, prior_var=LOOSE_STD**2) for reading in asked]
    few = {f"{k} touches": ratio(support[:k]) for k in (5, 10, 20) if k < len(support)}
    return {**few, ALL: ratio(support), "all, without noise": ratio(exact),
            f"all, springs around {COMMON:g} N/m": ratio(support, mean=COMMON),
            f"none, springs of {COMMON:g} N/m": ratio([], mean=COMMON),
            "all, particles stick": ratio(support, friction=10.0),
            "all, particles slide": ratio(support, friction=0.0),
            "all, particles 20 mm apart": ratio(support, spacing=0.02, std=2.0 * PRIOR_STD),
            "all, within 30 mm of the seen surface": ratio(support, band=0.03),
            "the queries themselves, without noise": ratio(asked, std=LOOSE_STD),
            "each query by itself, without noise": error_ratio(alone, queries),
            "all touches and the queries, without noise": ratio([*exact, *asked], std=LOOSE_STD)}


def error_ratio(posteriors: Sequence[Posterior], queries: Sequence[Query]) -> float:
    """Mean over touches of the RMS error, over that of predicting zero, as the metric `rmse_ratio` [-]; each query has
    its own posterior."""
    error = zero = 0.0
    for posterior, query in zip(posteriors, queries, strict=True):
        truth = query.clean[query.scored]
        error += float(np.sqrt(np.mean((posterior.predict([query.action])[0][query.scored] - truth) ** 2)))
        zero += float(np.sqrt(np.mean(truth**2)))
    return error / zero


def table(found: Sequence[dict[str, float]], run: dict[str, str]) -> Measurement:
    """The table of all variants; ``found`` has one row a plant."""
    rows, size = [], np.sqrt(len(found))
    base = np.array([row[ALL] for row in found])
    for name in found[0]:
        values = np.array([row[name] for row in found])
        change = values - base
        spread = [float(np.std(v, ddof=1) / size) if len(found) > 1 else 0.0 for v in (values, change)]
        rows.append({"name": name, "ratio": float(values.mean()), "error": spread[0], "change": float(change.mean()),
                     "change_error": spread[1]})
    return Measurement.of("plant-learning", run, [Table(
        "springs fitted to touches of a plant: error of its query touches over that of predicting zero", (
            Column("name", "fitted to"), Column("ratio", "ratio", "1", "", ".3f"),
            Column("error", "+-", "1", "", ".3f"), Column("change", f"against {ALL}", "1", "", "+.3f"),
            Column("change_error", "+-", "1", "", ".3f")), rows, name="variants")],
        notes=[f"{len(found)} plants; errors are standard errors over plants, of differences those of paired ones."],
        numbers={"plants": len(found)})
