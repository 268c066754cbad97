"""What limits a field of springs on plants: `vsfsim measure plant-learning`.

Springs are fitted to the support touches of each plant and predict its query touches, with settings changed one at a
time. It matters where the springs start: at zero, at one value, or at a value that falls with the distance from the
foot of the stem; and whether they are independent or alike near each other. Then come oracles: the same prediction with
one best factor for each query or each frame, which says whether size or direction is wrong, and springs fitted to the
query touches themselves, which says what independent springs can represent at all. Nothing is learned from other
plants.
"""

from __future__ import annotations

import dataclasses
import multiprocessing
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from measurements.artificial_plants.prior import PLANTS
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.baselines.particle_model import ParticleModel, VsfSettings
from vsfsim.baselines.posterior import Posterior
from vsfsim.bench.method import Reading
from vsfsim.bench.protocol import Query, divide, record
from vsfsim.bench.task import Task, load_task, open_dataset
from vsfsim.data.records import ObjectView
from vsfsim.vsf.features.registry import particle_features
from vsfsim.vsf.meta.composition import GaussianPrior

PRIOR_STD, LOOSE_STD = 30.0, 300.0
"""Of a spring constant: as the fits of `gaussian` (`tuned`), and where the data are to decide alone [N/m]."""
LOOSE_NOISE = 0.05
"""Noise of a reading where the data are to decide alone [N m]; none in proportion to the force."""
COMMON = (3.0, 6.0, 10.0)
"""Values that all springs start from [N/m]."""
FALLING = 2.0
"""Springs that fall with the distance r from the foot start from this over r + 0.05 m [N]."""
REACH, ALIKE_STD = 0.18, 3.0
"""Of springs that are alike, as in the preset `tuned`: over which distance [m], and their standard deviation [N/m]."""
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
    found: list[dict[str, float]] = []
    if workers == 1:
        for name in names:
            progress(name)
            found.append(ratios(loaded, dataset[name]))
    else:  # a task does not travel to another process
        with multiprocessing.get_context("spawn").Pool(workers) as pool:
            for name, row in zip(names, pool.imap(partial(_of, task, folder), names), strict=True):
                progress(name)
                found.append(row)
    return table(found, {"task": task, "sha256": dataset.sha256})


def _of(task: str, folder: Path | None, name: str) -> dict[str, float]:
    """`ratios` of one object of a task's dataset."""
    loaded = load_task(task)
    return ratios(loaded, open_dataset(loaded, folder)[name])


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

    def fit(readings: Sequence[Reading], *, std: float = PRIOR_STD, mean: float | np.ndarray = 0.0,
            **changed: float) -> Posterior:
        model = model_of(dataclasses.replace(PLANTS, **changed))  # type: ignore[arg-type]
        plain = GaussianPrior.plain(0.0, std**2, len(model.particles))
        return Posterior.under(model, readings, dataclasses.replace(plain, mean=plain.mean + mean))

    def ratio(readings: Sequence[Reading], **how: Any) -> float:
        return error_ratio([fit(readings, **how)] * len(queries), queries)

    loose = {"std": LOOSE_STD, "noise_std": LOOSE_NOISE, "noise_share": 0.0}
    place = particle_features("place", view.view, model_of(PLANTS).particles, spacing=PLANTS.spacing)
    falling = FALLING / np.exp(place[:, 2].astype(float))
    best = fit(support, mean=falling)
    out = {f"{k} touches": ratio(support[:k]) for k in (5, 10, 20) if k < len(support)}
    out |= {ALL: ratio(support), "all, without noise": ratio(exact)}
    for mean in COMMON:
        out |= {f"none, springs of {mean:g} N/m": ratio([], mean=mean),
                f"all, springs around {mean:g} N/m": ratio(support, mean=mean)}
    for k in (1, 5, 10, len(support)):
        out[f"{'all' if k == len(support) else k}, springs alike"] = ratio(support[:k], reach=REACH, std=ALIKE_STD)
    return {**out, "none, springs that fall with the distance": ratio([], mean=falling),
            "all, around springs that fall": error_ratio([best] * len(queries), queries),
            "the same, particles stick": ratio(support, mean=falling, friction=10.0),
            "the same, every query with its best factor": scaled_ratio(best, queries, axis=None),
            "the same, every frame with its best factor": scaled_ratio(best, queries, axis=1),
            "all and the queries, without noise, loosely": ratio([*exact, *asked], **loose),
            "each query by itself, without noise, loosely": error_ratio([fit([r], **loose) for r in asked], queries)}


def scaled_ratio(posterior: Posterior, queries: Sequence[Query], *, axis: int | None) -> float:
    """`error_ratio` after each query (``axis`` None), or each of its frames (1), is multiplied by the number, at least
    0, that fits it best [-]."""
    error = zero = 0.0
    for query in queries:
        truth = query.clean[query.scored]
        given = posterior.predict([query.action])[0][query.scored]
        size = np.maximum((given**2).sum(axis=axis, keepdims=True), 1e-12)
        factor = np.maximum((given * truth).sum(axis=axis, keepdims=True), 0.0) / size
        error += float(np.sqrt(np.mean((factor * given - truth) ** 2)))
        zero += float(np.sqrt(np.mean(truth**2)))
    return error / zero


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
