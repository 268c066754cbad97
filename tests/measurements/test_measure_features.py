"""Choosing features and noise on training objects alone."""

import numpy as np
import pytest

from measurements.choices.features import choose, report
from vsfsim.baselines.gaussian import GaussianAverage
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import load_task
from vsfsim.core.errors import MethodError
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter


def made(folder, train, test=1):
    views = [mock_view(i, split="train" if i < train else "test", touches=6) for i in range(train + test)]
    recipe = Recipe(scene="mock", scene_text="mock", seed=0, objects=train + test, views=1, touches=6,
                    splits={"train": train, "test": test},
                    device="cpu", tier="vsf", precision="float64", renderer="warp")
    with DatasetWriter(folder, recipe, [v.name for v in views]) as writer:
        for view in views:
            writer.add(view)
        return writer.finish()


def test_variants_are_scored_on_objects_left_out_and_test_objects_stay_closed(tmp_path, monkeypatch):
    dataset, task = made(tmp_path / "toy", 3), load_task("inclusion-mini-v3")
    opened = []
    load = type(dataset).load
    monkeypatch.setattr(type(dataset), "load", lambda self, name: (opened.append(name), load(self, name))[1])
    rows = choose(task, dataset, features=("xyzrgb",), noises=(1.0, 30.0), folds=3, settings={"epochs": 2})
    assert set(opened) == set(dataset.names("train"))
    assert [row.name for row in rows] == ["gaussian", "sbml, xyzrgb, noise_std 1", "sbml, xyzrgb, noise_std 30"]
    assert rows[1].spread == (0.0, 0.0) and rows[1].half < rows[1].zero, "touches help"
    assert abs(rows[2].zero - rows[2].half) < 0.2 * (rows[1].zero - rows[1].half), "a noise of 30 N hears no touch"
    text = report({}, rows, "N").text()
    assert "sbml, xyzrgb, noise_std 30" in text and "training objects left out" in text


def test_the_one_look_at_the_test_objects(tmp_path):
    dataset, task = made(tmp_path / "toy", 2, 2), load_task("inclusion-mini-v3")
    first, second, third = choose(task, dataset, features=("xyzrgb", "local"), noises=(1.0,), folds=2,
                                  settings={"epochs": 2}, on_test=True)
    assert second.difference == (0.0, 0.0)
    assert third.difference == pytest.approx((third.zero - second.zero, third.half - second.half))
    method = GaussianAverage()
    views = [dataset.blind().load(name) for name in dataset.names("train")]
    method.meta_fit([specimen(view, task) for view in views])
    errors = []
    for name in dataset.names("test"):
        view = dataset.load(name)
        recording = record(view, task)
        method.adapt(view.view, [])
        answers = method.predict([r.action for r in recording.readings])
        errors += [np.sqrt(np.mean((a - c) ** 2)) for a, c in zip(answers, recording.clean)]
    assert first.zero == pytest.approx(np.mean(errors)), ("all training objects, no touch, every touch of both "
                                                          "test objects")
    assert "error on test objects" in report({}, [first, second], "N", on_test=True).text()
    with pytest.raises(MethodError, match="1 test object"):
        choose(task, made(tmp_path / "small", 2, 1), features=("xyzrgb",), noises=(1.0,), folds=2, on_test=True)


def test_one_object_is_too_few(tmp_path):
    with pytest.raises(MethodError, match="1 training objects and 1 folds"):
        choose(load_task("inclusion-mini-v3"), made(tmp_path / "toy", 1), features=("xyzrgb",), noises=(3.0,),
               folds=4)
