"""Cross-validation over objects, from the folds to the board."""

import dataclasses

import numpy as np
import pytest

from vsfsim.bench.board.compare import by_object, by_run, curve, interval
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.mock import mock_view
from vsfsim.bench.predictions import questions
from vsfsim.bench.protocol import folds_of, record
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import TaskError

OBJECTS = 4


@pytest.fixture(scope="module")
def folded(folded_text):
    return parse_task(folded_text.replace("[0, 1, 5]", "[0, 5]"), "toy-v1.toml")


@pytest.fixture(scope="module")
def dataset(write_dataset):
    return write_dataset([mock_view(i, split="train" if i < 2 else "test", touches=12) for i in range(OBJECTS)])


@pytest.fixture(scope="module")
def results(folded, dataset):
    return {name: evaluate("toy_methods:" + name, folded, dataset, parameters=given, check=False)
            for name, given in (("Constant", {"value": 0.0}), ("FoldMean", {}))}


def test_every_object_is_tested_once_and_never_learned_from(folded, dataset):
    folds = folds_of(dataset, folded.protocol)
    assert sorted(n for f in folds for n in f.test) == sorted(e.name for e in dataset.entries)
    for fold in folds:
        assert not set(fold.train) & set(fold.test) and len(fold.train) + len(fold.test) == OBJECTS
    assert folds == folds_of(dataset, folded.protocol)
    assert folds != folds_of(dataset, dataclasses.replace(folded.protocol, seed=5))


def test_all_views_of_an_object_are_in_one_fold(folded, dataset):
    """Four views of two objects."""
    twice = dataclasses.replace(dataset, entries=tuple(
        dataclasses.replace(e, object_index=k // 2, view_index=k % 2) for k, e in enumerate(dataset.entries)))
    for fold in folds_of(twice, folded.protocol):
        assert {k // 2 for k, e in enumerate(twice.entries) if e.name in fold.test}.isdisjoint(
            {k // 2 for k, e in enumerate(twice.entries) if e.name in fold.train})
    with pytest.raises(TaskError, match="has 2 objects, and the task divides them into 5 folds"):
        folds_of(twice, dataclasses.replace(folded.protocol, folds=5))


def test_a_training_is_done_once_a_fold_and_seed(results):
    assert results["Constant"].seeds == (0, 1) and results["FoldMean"].seeds == (0, 1, 2, 3)
    # with 0 touches the answer is that of the training; it does not depend on the draw
    assert results["FoldMean"].scores["rmse"]["0"].per_seed[0] == results["FoldMean"].scores["rmse"]["0"].per_seed[1]
    assert results["FoldMean"].scores["rmse"]["0"].per_seed[0] != results["FoldMean"].scores["rmse"]["0"].per_seed[2]


def test_each_object_is_predicted_from_the_others(folded, dataset, results):
    """`FoldMean` with seed 0 answers with the mean reading of what it learned from, so its errors show what."""
    views = {name: dataset.load(name) for name in dataset.names()}
    for fold in folds_of(dataset, folded.protocol):
        questioned = next(q for q in questions(folded, dataset) if q.name == fold.test[0])
        assert questioned.train == fold.train
    result = results["FoldMean"]
    sse = {(o, t): s for o, t, shot, run, s in zip(*(result.queries[k] for k in ("object", "touch", "shot", "seed",
                                                                                "sse"))) if (shot, run) == ("0", 0)}
    for fold in folds_of(dataset, folded.protocol):
        learned = [record(views[name], folded) for name in fold.train]
        mean = np.mean(np.concatenate([r.value.ravel() for one in learned for r in one.readings]))
        for name in fold.test:
            clean = record(views[name], folded).clean
            for (o, t), s in sse.items():
                if o == name:
                    assert s == pytest.approx(float(np.sum((clean[t] - mean) ** 2)), rel=1e-6)


def test_zero_has_the_ratio_one_and_others_that_of_their_objects(results):
    values = by_object(results["Constant"], "rmse_ratio", "5")
    assert len(values) == OBJECTS and list(values.values()) == pytest.approx([1.0] * OBJECTS, rel=1e-7)
    mean = results["FoldMean"].scores["rmse_ratio"]["5"].mean
    found = by_run(results["FoldMean"], "rmse_ratio", "5", 2)
    assert {of.shape for of in found.values()} == {(2, 2)} and mean == pytest.approx(interval(found).mean, rel=1e-12)
    for run, value in enumerate(results["FoldMean"].scores["rmse_ratio"]["5"].per_seed):
        assert value == pytest.approx(np.mean([of.flat[run] for of in found.values()]), rel=1e-12)


def test_the_area_of_a_result_is_that_of_its_shots(folded, results):
    """Shots 0, 5 and all, which is 8 of 12: half of the first step to 0, half of the second to all."""
    found = curve(results["FoldMean"], folded)
    at = np.log2([1.0, 6.0, 1.0 + max(folded.dataset.touches - folded.protocol.query, 5)])
    for name, area in found["area"].items():
        shots = [found[label][name] for label in ("0", "5", "all")]
        assert area == pytest.approx(np.trapezoid(shots, at, axis=0) / at[-1], rel=1e-12) and area.shape == (2, 2)


def test_more_draws_than_the_task_has_are_refused(folded, dataset):
    with pytest.raises(TaskError, match="has 2 of each training"):
        evaluate("toy_methods:Constant", folded, dataset, seeds=3, check=False)
