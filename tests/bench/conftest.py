import contextlib
import functools
import json
import os

import mock_dataset
import pytest
from texts import text

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.isolation.process import MethodHost
from vsfsim.bench.mock import mock_view
from vsfsim.bench.result_file import unpack
from vsfsim.bench.task import parse_task
from vsfsim.bench.trials.answers import Reader, asked_of, run_trial

TASK = text("toy-v1", ("seeds = 2", "seeds = 3"))

# Methods of these tests report into files, which a container does not show; `test_sandbox.py` has the containers.
os.environ.setdefault("VSFSIM_SANDBOX", "process")


@pytest.fixture(scope="session")
def task_text():
    return TASK


@pytest.fixture(scope="session")
def folded_text():
    """The text of the same task with four objects and cross-validation over them."""
    return text("folded-v1")


@pytest.fixture(scope="session")
def task():
    return parse_task(TASK, "toy-v1.toml")


@pytest.fixture(scope="session")
def toy_views():
    return [mock_view(i, split="train" if i < 1 else "test", touches=12) for i in range(3)]


@pytest.fixture(scope="session")
def write_dataset(tmp_path_factory):
    """Writes the views of some mock objects into a folder of their own."""
    return lambda views, **more: mock_dataset.write(tmp_path_factory.mktemp("data") / "toy", views, **more)


@pytest.fixture(scope="session")
def toy_dataset(write_dataset, toy_views):
    return write_dataset(toy_views)


@pytest.fixture(scope="session")
def constant(task, toy_dataset):
    """The result of a method that predicts one value everywhere, evaluated once for each value."""
    return functools.cache(lambda value: evaluate("toy_methods:Constant", task, toy_dataset,
                                                  check=False, parameters={"value": value}))


@pytest.fixture(scope="session")
def tuned(task, toy_dataset):
    """The result of a method that ships."""
    return evaluate("contact-points", task, toy_dataset, preset="tuned", check=False)


@pytest.fixture(scope="session")
def honest(task, toy_dataset):
    """The scores of a method that answers 1.5 and does nothing else."""
    return evaluate("toy_methods:Constant", task, toy_dataset, seeds=1, check=False).scores


@pytest.fixture(scope="session")
def one_trial(task, toy_dataset, tmp_path_factory):
    """A context for trials of a method, its processes with further variables each; much cheaper than an evaluation."""
    @contextlib.contextmanager
    def trials(name, isolation, **parameters):
        log = tmp_path_factory.mktemp("trials") / "log"
        subject = Reader().subject(task, toy_dataset, "mock-0001-v0")

        def make(labels, **variables):
            """The answers at the last of some shots, after one training."""
            learned = host.learn([], seed=None, environment=variables)
            return [run_trial(host, learned, subject, asked_of(subject, label, 0, task.protocol))
                    for label in labels.split()][-1]

        make.log = log
        with MethodHost(name, parameters, isolation, log, hidden=[toy_dataset.path]) as host:
            yield make

    return trials


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
