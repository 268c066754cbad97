import json
import os

import mock_dataset
import pytest

from vsfsim.bench.mock import mock_view
from vsfsim.bench.result_file import unpack
from vsfsim.bench.task import parse_task

TASK = mock_dataset.TASK.replace("seeds = 2", "seeds = 3") + """[[paper]]
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
    return lambda *given: mock_dataset.write(tmp_path_factory.mktemp("data") / "toy", *given)


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
