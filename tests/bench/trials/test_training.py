"""What a method learns from in a study, and trainings that run side by side."""

import dataclasses
import os

import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.evaluate import evaluate, make
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import Fold
from vsfsim.bench.result import Result
from vsfsim.bench.task import parse_task
from vsfsim.bench.trials import answers
from vsfsim.bench.trials.jobs import Evaluation
from vsfsim.bench.trials.training import Extra, Training
from vsfsim.core.errors import TaskError

SCENE = '[object.shape]\nstyle = { each = ["slipper", "boot"] }\n'


@pytest.fixture(scope="module")
def task(folded_text):
    return parse_task(folded_text.replace("draws = 2", "draws = 1").replace("[0, 1, 5]", "[0, 5]"), "toy-v1.toml")


@pytest.fixture(scope="module")
def dataset(write_dataset):
    """Four mock objects, the first two in two views."""
    views = [mock_view(i, split="train", touches=12) for i in range(4)]
    views += [dataclasses.replace(v, name=v.name.replace("v0", "v1"), view_index=1) for v in views[:2]]
    return write_dataset(views, scene_text=SCENE)


def learned(training, dataset, task):
    """By the test view, the objects that a method learns from."""
    return {name: sorted({int(n[5:9]) for n in fold.train}) for fold in training.folds(dataset, task.protocol)
            for name in fold.test}


def test_classes_divide_the_objects(dataset, task):
    same = learned(Training("same-class"), dataset, task)
    other = learned(Training("other-classes"), dataset, task)
    assert same["mock-0000-v0"] == [2] and same["mock-0003-v0"] == [1]
    assert other["mock-0000-v0"] == [1, 3] and other["mock-0001-v0"] == [0, 2]
    assert set(same) == set(other) == set(dataset.names())


def test_views_divide_the_objects(dataset, task):
    own = Training("same-object", test_views=(1,))
    assert learned(own, dataset, task) == {"mock-0000-v1": [0], "mock-0001-v1": [1]}
    seen = Training(train_views=(0,), test_views=(1,)).folds(dataset, task.protocol)
    assert {n for f in seen for n in f.test} == {"mock-0000-v1", "mock-0001-v1"}
    assert all(n.endswith("v0") for f in seen for n in f.train)


def test_a_share_is_a_part_of_a_larger_one(dataset, task):
    def of(**given):
        fold = Training(**given).folds(dataset, task.protocol)[0]
        return Training(**given).specimens(task, dataset, fold, 1, answers.Reader().specimen)

    every, some, few = of(), of(touches=0.5), of(touches=0.1)
    assert [len(s.touches) for s in every] == [12] * len(every)
    assert {len(s.touches) for s in some} == {6} and {len(s.touches) for s in few} == {1}
    for a, b, c in zip(every, some, few, strict=True):
        paths = [{t.action.poses.tobytes() for t in s.touches} for s in (a, b, c)]
        assert paths[2] < paths[1] < paths[0]
    names = {s.name[:9] for s in of(objects=0.5)}
    assert len(names) == 1 and names < {s.name[:9] for s in every}
    half, read = Training(objects=0.5), answers.Reader().specimen
    whole = Fold(0, tuple(dataset.names()), ())
    assert {tuple(s.name for s in half.specimens(task, dataset, whole, k, read)) for k in (0, 2, 3)
            } != {tuple(s.name for s in of(objects=0.5))}, "another training draws others"


def test_objects_of_another_dataset_are_added(dataset, task):
    extra = Training(extra=(Extra(task, dataset, 2),))
    fold = extra.folds(dataset, task.protocol)[0]
    found = extra.specimens(task, dataset, fold, 0, answers.Reader().specimen)
    assert len(found) == len(fold.train) + 4 and extra.table()["extra"][0]["objects"] == 2


@pytest.mark.parametrize(("given", "message"), [
    ({"rule": "same"}, "train is 'same'"), ({"objects": 0.0}, "share_of_objects is 0.0"),
    ({"touches": 1.5}, "share_of_touches is 1.5")])
def test_what_cannot_be_is_refused(given, message):
    with pytest.raises(TaskError, match=message):
        Training(**given)


@pytest.mark.parametrize(("training", "message"), [
    (Training(test_views=(7,)), "has none of the views"),
    (Training("same-object"), "no training view for mock-0002-v0")])
def test_what_the_dataset_lacks_is_said(dataset, task, training, message):
    with pytest.raises(TaskError, match=message):
        training.folds(dataset, task.protocol)


@pytest.fixture(scope="module")
def plain(dataset, task):
    return evaluate("toy_methods:Seeded", task, dataset, check=False)


def test_such_a_result_is_never_ranked(dataset, task, plain, tmp_path):
    other = evaluate("toy_methods:Seeded", task, dataset, check=False, training=Training(touches=0.5))
    assert other.study["share_of_touches"] == 0.5 and plain.study == {}
    for name, result in (("plain", plain), ("other", other)):
        result.save(tmp_path / f"{name}.json")
    assert Result.load(tmp_path / "other.json") == other
    board = leaderboard.collect(task, [tmp_path])
    assert [row.rank for row in board.rows] == [1, None] and "a study's" in board.rows[1].mark


def test_processes_change_nothing_and_a_failure_does_not_end_the_rest(dataset, task, plain, tmp_path, monkeypatch):
    path = tmp_path / "several.json"
    rows = [Evaluation("toy_methods:Crashes", task, dataset, tmp_path / "crash.json"),
            Evaluation("toy_methods:Seeded", task, dataset, path)]
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    found = {one.path.stem: one for one in make(rows, 3, check=False)}
    assert "OMP_NUM_THREADS" not in os.environ, "the caller's threads are its own"
    assert "toe" in found["crash"].state and len(found) == 2
    several = Result.load(path)
    assert found["several"].result == several
    assert several.queries == plain.queries and several.scores == plain.scores
    assert several.timing["fits"] == plain.timing["fits"] == 4
    assert sorted(p.name for p in tmp_path.iterdir()) == ["several.json"]


def test_a_reader_tells_protocols_and_noises_apart(dataset, task):
    """Studies ask one task by several protocols, and all their trainings share a reader."""
    name, read = dataset.names()[0], answers.Reader()
    fewer = dataclasses.replace(task, protocol=dataclasses.replace(task.protocol, query=task.protocol.query - 1))
    loud = dataclasses.replace(task, noise=dataclasses.replace(task.noise, force_std=10.0))
    first = read.subject(task, dataset, name)
    assert len(read.subject(fewer, dataset, name).actions) == len(first.actions) - 1
    assert read.subject(task, dataset, name) is first
    quiet, other = (read.specimen(t, dataset, name).touches[0].value for t in (task, loud))
    assert (quiet != other).any() and read.specimen(fewer, dataset, name) is read.specimen(task, dataset, name)
