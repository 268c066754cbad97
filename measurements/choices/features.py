"""Errors of SBML with several features and noises, from training objects alone: `vsfsim measure features`.

Cross-validation over the training split of a task's dataset: the prior is learned on the other folds and predicts the
forces of touches of the objects left out, after 0 touches and of each half of their touches after the other half. Test
objects are opened by `on_test` alone: one evaluation after everything was chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.baselines.gaussian import GaussianAverage
from vsfsim.baselines.sbml import Sbml
from vsfsim.bench.method import build_method, parameters_of
from vsfsim.bench.metric_functions import touch_errors
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import Task
from vsfsim.core.errors import MethodError
from vsfsim.data.dataset import Dataset


@dataclass(frozen=True)
class Choice:
    """Errors of one variant: root mean square over a touch, mean over touches and objects."""

    name: str
    """Of the variant."""
    zero: float
    """Error after no touch [task's unit]."""
    half: float
    """Error on each half of the touches after the other half [task's unit]."""
    difference: tuple[float, float]
    """Of both errors to the first sbml's, mean over objects [task's unit]."""
    spread: tuple[float, float]
    """Standard errors of these differences [task's unit]."""


def choose(task: Task, dataset: Dataset, *, features: Sequence[str], noises: Sequence[float], folds: int,
           seeds: int = 1, settings: Mapping[str, Any] | None = None,
           on_test: bool = False, progress: Progress = lambda _: None) -> list[Choice]:
    """Score variants of SBML, and the naive Gaussian prior, by cross-validation over the training objects.

    Args:
        task: what a reading is and its noise.
        dataset: only its training split is read, but for ``on_test``.
        features, noises: all pairs of them.
        folds: of the objects.
        seeds: trainings of each variant and fold.
        settings: further parameters of `Sbml`.
        on_test: learn on all training objects and predict the test objects, without folds.
        progress: called with what is going on.

    Raises:
        MethodError: fewer than two training objects, folds, or, with ``on_test``, test objects.
    """
    learned = dataset.names(task.protocol.train)
    folds = min(folds, len(learned))
    if folds < 2:
        raise MethodError(f"measure features: {len(learned)} training objects and {folds} folds; at least two of each "
                          f"are needed.")
    asked = dataset.names(task.protocol.test) if on_test else []
    if on_test and len(asked) < 2:
        raise MethodError(f"measure features: {len(asked)} test object; an error of a difference needs at least two.")
    names = [*learned, *asked]
    # Each round leaves some objects out of the training and predicts them.
    rounds = [list(range(len(learned), len(names)))] if on_test else [list(range(fold, len(names), folds))
                                                                      for fold in range(folds)]
    views = [dataset.blind().load(name) for name in names]
    specimens, recordings = [specimen(view, task) for view in views], [record(view, task) for view in views]
    # Particles, rows and features are those of the object, whatever is learned from them: made once for all variants.
    first_of: dict[float, Sbml] = {}
    variants: list[tuple[str, Callable[[int], object]]] = [("gaussian", lambda seed: GaussianAverage())]
    for feature in features:
        for noise in noises:
            given = {**(settings or {}), "features": feature, "noise_std": noise}
            variants.append((f"sbml, {feature}, noise_std {noise:g}", lambda seed, given=given:
                             build_method(Sbml, parameters_of(Sbml, {**given, "seed": seed}))))
    errors = np.zeros((len(variants), len(views), 2))
    for k, (name, make) in enumerate(variants):
        for fold, out in enumerate(rounds):
            progress(f"{name}, {len(names) - len(out)} objects to learn from, {len(out)} to predict, {fold + 1} of "
                     f"{len(rounds)}")
            for seed in range(seeds):
                method = make(seed)
                if isinstance(method, Sbml):
                    method.share(first_of.setdefault(method.noise_std, method))
                method.meta_fit([s for i, s in enumerate(specimens) if i not in out])
                for i in out:
                    errors[k, i] += np.array(_errors(method, views[i].view, recordings[i])) / seeds
    errors = errors[:, sorted(i for out in rounds for i in out)]
    first = errors[1] if len(variants) > 1 else errors[0]
    count = np.sqrt(errors.shape[1])
    return [Choice(name, *(float(x) for x in e.mean(axis=0)), tuple(float(x) for x in (e - first).mean(axis=0)),
                   tuple(float(x) for x in (e - first).std(axis=0, ddof=1) / count)) for (name, _),
            e in zip(variants, errors)]


def report(settings: Mapping[str, Any], rows: Sequence[Choice], unit: str, *, on_test: bool = False) -> Measurement:
    """The errors of all variants."""
    return Measurement.of("features", settings, [
        Table(f"error on {'test objects' if on_test else 'training objects left out'}; paired differences to the first "
              f"sbml and their standard errors [{unit}]", (
            Column("name", "variant"), Column("zero", "0 touches", form=".3f"),
            Column("half", "half of them", form=".3f"), Column("difference.0", "difference, 0", form="+.3f"),
            Column("spread.0", "±", form=".3f"), Column("difference.1", "difference, half", form="+.3f"),
            Column("spread.1", "±", form=".3f")), [asdict(row) for row in rows], name="variants")],
        numbers={"unit": unit})


def measure(task: Task, dataset: Dataset, **given: Any) -> Measurement:
    """`choose` as a measurement; the arguments are the same."""
    settings = {"task": task.name, "dataset": str(dataset.path), **{k: v for k, v in given.items() if k != "progress"}}
    return report(settings, choose(task, dataset, **given), task.observation.unit,
                  on_test=bool(given.get("on_test", False)))


def _errors(method, view, recording) -> tuple[float, float]:
    """Errors on all touches: without any, and each half after the other."""
    usable = [i for i, r in enumerate(recording.readings) if r.valid.any()]
    zero, half = [], []
    for support, query in ((usable[::2], usable[1::2]), (usable[1::2], usable[::2])):
        for given, errors in (([], zero), (support, half)):
            method.adapt(view, [recording.readings[i] for i in given])
            answer = method.predict([recording.readings[i].action for i in query])
            rows = [touch_errors(a, recording.clean[i], recording.readings[i].valid) for a, i in zip(answer, query)]
            errors += [float(np.sqrt(row["sse"] / row["n"])) for row in rows]
    return float(np.mean(zero)), float(np.mean(half))
