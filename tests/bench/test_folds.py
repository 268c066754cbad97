"""Cross-validation over objects, from the folds to the board."""

import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from vsfsim.bench.board.compare import by_object, interval, joined_ranks, paired
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
    assert mean == pytest.approx(interval(by_object(results["FoldMean"], "rmse_ratio", "5"))[0], rel=1e-12)


def test_ranks_are_joined_by_paired_differences():
    rng = np.random.default_rng(0)
    level = {f"o{k}": float(v) for k, v in enumerate(rng.uniform(0.3, 1.5, 20))}  # objects differ by far more
    shift = {name: value + 0.05 + 0.01 * rng.standard_normal() for name, value in level.items()}
    noisy = {name: value + 0.05 + 0.5 * rng.standard_normal() for name, value in level.items()}
    assert paired(shift, level).told_apart and not paired(noisy, level).told_apart
    assert paired(shift, level).mean == pytest.approx(0.05, abs=0.01)
    assert joined_ranks([level, shift]) == [1, 2] and joined_ranks([level, noisy]) == [1, 1]
    assert joined_ranks([level, level, shift]) == [1, 1, 3]
    two = {k: level[k] for k in ("o0", "o1")}
    assert not paired({k: v + 1.0 for k, v in two.items()}, two).told_apart, "two objects tell nothing"
    assert paired({k: shift[k] for k in ("o0", "o1", "o2")}, {k: level[k] for k in ("o0", "o1", "o2")}).told_apart


def test_a_standard_error_over_objects_has_n_minus_one_and_a_value_is_of_its_shot_alone():
    """Of 1, 2, 6: mean 3, sum of squares about it 14, standard error sqrt(14 / 2 / 3)."""
    values = {"a": 1.0, "b": 2.0, "c": 6.0}
    assert interval(values) == pytest.approx((3.0, math.sqrt(14.0 / 6.0)))
    found = paired({name: v + 1.0 for name, v in values.items()}, dict.fromkeys(values, 1.0))
    assert (found.mean, found.error, found.objects) == (pytest.approx(3.0), pytest.approx(math.sqrt(14.0 / 6.0)), 3)
    assert math.isnan(paired({"a": 1.0}, {"a": 0.0}).error)
    # a mean over the runs of one shot; other shots, and runs without an answer, do not enter the scores that rank
    columns = {"object": ["a-v0", "a-v0", "a-v1", "a-v0", "b-v0"], "shot": ["5", "5", "5", "all", "5"],
               "mask_f1": [0.2, None, 0.4, 0.9, None]}
    result = SimpleNamespace(values={}, answers={"mask": columns})
    assert by_object(result, "mask_f1", "5") == {"a": pytest.approx(0.3)}
    assert by_object(result, "mask_f1", "all") == {"a": 0.9} and by_object(result, "mask_f1", "0") == {}


def test_more_draws_than_the_task_has_are_refused(folded, dataset):
    with pytest.raises(TaskError, match="has 2 of each training"):
        evaluate("toy_methods:Constant", folded, dataset, seeds=3, check=False)
