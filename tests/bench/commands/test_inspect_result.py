"""`evaluate --on development`, `--keep predictions` and `show RESULT`: the loop of a method's author."""

import dataclasses
import math

import numpy as np
import pytest

from vsfsim.bench.commands.inspect_result import inspect_result
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import divide
from vsfsim.bench.result import Result
from vsfsim.bench.task import parse_task
from vsfsim.bench.trials.score import curves_beside, load_curves
from vsfsim.core.errors import TaskError

DEVELOPED = 'development = { folder = "toy-development", seed = 5, objects = 3 }, tier'


@pytest.fixture(scope="module")
def kept(task, toy_dataset, tmp_path_factory):
    path = tmp_path_factory.mktemp("results") / "constant.json"
    evaluate("toy_methods:Constant", task, toy_dataset, parameters={"value": 2.0}, out=path, keep="predictions")
    return path


def test_predictions_lie_beside_the_truth(kept, toy_views):
    found = load_curves(Result.load(kept), kept)
    assert len(found) == 2 * 4 and curves_beside(kept).stat().st_size < 20_000
    for (name, touch), (truth, predicted) in found.items():
        made = next(view for view in toy_views if view.name == name).touches[touch]
        assert predicted.shape == (4, 3, len(made.time), 1) and (predicted == 2.0).all()
        np.testing.assert_allclose(truth[:, 0], -(made.force @ made.axis), rtol=1e-6, atol=1e-6)


def test_the_worst_object_and_touch_come_first(kept, task, toy_views):
    text, numbers = inspect_result(kept)
    by_hand = {}
    for view in toy_views[1:]:
        for index in divide(view, task.protocol).query:
            truth = -(view.touches[index].force @ view.touches[index].axis)
            by_hand[view.name, index] = math.sqrt(np.mean((2.0 - truth) ** 2)), math.sqrt(np.mean(truth**2)), (
                2.0 * truth.sum() / (truth**2).sum())
    found = {(t["view"], t["touch"]): (t["rmse"]["5"], t["share"], t["gain"]) for t in numbers["touches"]}
    assert found.keys() == by_hand.keys()
    for key, (error, share, gain) in found.items():
        mine, _, factor = by_hand[key]
        level = np.mean([zero for (name, _), (_, zero, _) in by_hand.items() if name == key[0]])
        assert (error, share, gain) == pytest.approx((mine, mine / level, factor), rel=1e-4)
    assert [t["share"] for t in numbers["touches"]] == sorted((t["share"] for t in numbers["touches"]), reverse=True)
    objects = numbers["objects"]["5"]
    lines = text.split("by object, the worst first")[1].splitlines()[3:5]
    assert [line.split()[0] for line in lines] == sorted(objects, key=objects.get, reverse=True)


def test_without_predictions_there_are_errors_and_no_curves(kept, tmp_path):
    Result.load(kept).save(tmp_path / "bare.json")
    text, numbers = inspect_result(tmp_path / "bare.json", shot="all")
    assert "--keep predictions" in text and math.isnan(numbers["touches"][0]["gain"])
    assert numbers["shot"] == "all"


def test_predictions_of_another_evaluation_are_refused(kept, task, toy_dataset, tmp_path):
    path = tmp_path / "r.json"
    known = Result.load(kept)
    queries = {**known.queries, "sse": [1.01 * value for value in known.queries["sse"]]}
    dataclasses.replace(known, queries=queries).save(path)
    curves_beside(path).write_bytes(curves_beside(kept).read_bytes())
    with pytest.raises(TaskError, match="of another evaluation than the result beside it"):
        inspect_result(path)
    curves_beside(path).write_bytes(curves_beside(kept).read_bytes()[:-40])


def test_a_task_on_its_development_objects_is_another_task(task_text, toy_dataset, tmp_path):
    task = parse_task(task_text.replace("tier", DEVELOPED), "toy-v1.toml")
    other = task.on("development")
    assert other.name == "toy-v1-development" and other.sha256 != task.sha256 and not other.paper
    assert (other.dataset.folder, other.dataset.seed) == ("toy-development", 5) and other.development is None
    with pytest.raises(TaskError, match="--seed 5"):
        evaluate("toy_methods:Constant", other, tmp_path / "nowhere")
    with pytest.raises(TaskError, match="seed is 0, not 5"):
        evaluate("toy_methods:Constant", other, toy_dataset)
    fresh = task.on("seed-7")
    assert (fresh.name, fresh.dataset.folder, fresh.dataset.seed) == ("toy-v1-seed-7", "toy-seed-7", 7)
    assert len({task.sha256, other.sha256, fresh.sha256}) == 3
    for seed in (0, 5):
        with pytest.raises(TaskError, match=f"has objects of seed {seed} itself"):
            task.on(f"seed-{seed}")
