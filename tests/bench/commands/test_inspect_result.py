"""`TASK-development` and `show RESULT`: the loop of a method's author."""

import math

import numpy as np
import pytest

from vsfsim.bench.commands.inspect_result import inspect_result
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import divide
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import TaskError

DEVELOPED = 'development = { folder = "toy-development", seed = 5, objects = 3 }, tier'


def test_the_worst_object_and_touch_come_first(task, toy_dataset, toy_views, tmp_path):
    evaluate("toy_methods:Constant", task, toy_dataset, parameters={"value": 2.0}, out=tmp_path / "constant.json")
    text, numbers = inspect_result(tmp_path / "constant.json")
    by_hand = {}
    for view in toy_views[1:]:
        for index in divide(view, task.protocol).query:
            truth = -(view.touches[index].force @ view.touches[index].axis)
            by_hand[view.name, index] = math.sqrt(np.mean((2.0 - truth) ** 2)), math.sqrt(np.mean(truth**2))
    found = {(t["view"], t["touch"]): (t["rmse"]["5"], t["share"]) for t in numbers["touches"]}
    assert found.keys() == by_hand.keys()
    for key, found_here in found.items():
        mine, _ = by_hand[key]
        level = np.mean([zero for (name, _), (_, zero) in by_hand.items() if name == key[0]])
        assert found_here == pytest.approx((mine, mine / level), rel=1e-4)
    assert [t["share"] for t in numbers["touches"]] == sorted((t["share"] for t in numbers["touches"]), reverse=True)
    objects = numbers["objects"]["5"]
    lines = text.split("by object, the worst first")[1].splitlines()[3:5]
    assert [line.split()[0] for line in lines] == sorted(objects, key=objects.get, reverse=True)


def test_a_task_on_its_development_objects_is_another_task(task_text, toy_dataset, tmp_path):
    task = parse_task(task_text.replace("tier", DEVELOPED), "toy-v1.toml")
    other = task.on("development")
    assert other.name == "toy-v1-development" and other.sha256 != task.sha256
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
