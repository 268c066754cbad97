import json
import os
from collections import Counter

import pytest

from vsfsim.bench.mock import mock_view
from vsfsim.bench.result_file import unpack
from vsfsim.bench.task import parse_task
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

TASK = """
name = "toy-v1"
description = "A toy."
dataset = { folder = "toy", scene = "mock", seed = 0, objects = 3, views = 1, touches = 12, tier = "vsf" }
protocol = { train = "train", test = "test", shots = [0, 1, 5], seeds = 3, query = 4, seed = 0 }
observation = { kind = "normal-force" }
noise = { force_std = 0.15, offset_std = 0.5, drift_std = 0.0, tare_frames = 2, seed = 0 }
metrics = { primary = "rmse", ranking_shot = 5 }
[[paper]]
method = "somebody"
source = "a paper"
unit = "hPa"
comparable = false
values = { 0 = [1.0, 0.1], all = 0.5 }
"""


# Methods of these tests report into files, which a container does not show; `test_sandbox.py` has the containers.
os.environ.setdefault("VSFSIM_SANDBOX", "process")


@pytest.fixture(scope="session")
def task_text():
    return TASK


@pytest.fixture(scope="session")
def folded_text():
    """The text of the same task with four objects and cross-validation over them."""
    text = TASK
    for old, new in {'train = "train", test = "test", ': "folds = 2, draws = 2, trainings = 2, ", "seeds = 3, ": "",
                     "objects = 3": "objects = 4", '"rmse"': '"rmse_ratio"'}.items():
        assert old in text
        text = text.replace(old, new)
    return text


@pytest.fixture(scope="session")
def task():
    return parse_task(TASK, "toy-v1.toml")


@pytest.fixture(scope="session")
def toy_views():
    return [mock_view(i, split="train" if i < 1 else "test", touches=12) for i in range(3)]


@pytest.fixture(scope="session")
def write_dataset(tmp_path_factory):
    """Writes the views of some mock objects into a folder of their own."""
    def write(views, scene_text="mock", seed=0):
        splits = Counter({view.object_index: view.split for view in views}.values())
        recipe = Recipe(scene="mock", scene_text=scene_text, seed=seed, objects=sum(splits.values()), views=1,
                        touches=len(views[0].touches), splits=dict(splits), device="cpu", tier="vsf",
                        precision="float64", renderer="warp")
        with DatasetWriter(tmp_path_factory.mktemp("data") / "toy", recipe, [v.name for v in views]) as writer:
            for view in views:
                writer.add(view)
            return writer.finish()

    return write


@pytest.fixture(scope="session")
def toy_dataset(write_dataset, toy_views):
    return write_dataset(toy_views)


@pytest.fixture(scope="session")
def plain_table():
    """Reads the JSON of a result file, its rows as lists of numbers, which a reader takes as well."""
    def read(path):
        table = json.loads(path.read_text())
        for key in ("queries", "readings"):
            table[key] = unpack(table[key]) if table[key] else {}
        table["answers"] = {name: unpack(columns) for name, columns in table["answers"].items()}
        return table

    return read
