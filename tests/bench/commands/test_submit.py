"""`vsfsim submit`: what is refused, what is told, and what is written."""

import dataclasses
import json

import pytest

from vsfsim.bench.board.rows import command_of
from vsfsim.bench.commands import submit as module
from vsfsim.bench.commands.submit import submit
from vsfsim.bench.identity import contents_of
from vsfsim.bench.leaderboard import collect
from vsfsim.bench.result import Result
from vsfsim.cli.options import parameters_of
from vsfsim.core.errors import TaskError

PARAMETERS = {"value": 5.0}


@pytest.fixture(scope="module")
def result(constant):
    return dataclasses.replace(constant(5.0), isolation="namespaces", package={"name": "toys", "version": "1.2"},
                               made_by={"vsfsim": "0.2.0", "commit": "a" * 40}, dataset_made_by={})


@pytest.fixture
def installed(monkeypatch):
    monkeypatch.setattr(module, "methods", lambda: {"toy_methods:Constant": None})


def test_a_good_row_is_written_with_its_pull_request(result, task, installed, tmp_path):
    result.save(tmp_path / "r.json")
    text, numbers = submit(tmp_path / "r.json", tmp_path / "out", task=task)
    assert {one["state"] for one in numbers["checks"]} == {"ok"} and numbers["rank"] == 1, text
    row = tmp_path / "out" / "leaderboard" / "toy-v1" / "toy_methods.Constant.json"
    assert Result.load(row) == Result.load(tmp_path / "r.json")
    assert collect(task, [row]).rows[0].rank == 1
    request = (tmp_path / "out" / "PULL_REQUEST.md").read_text()
    for words in ("pip install toys==1.2", task.dataset.command(), command_of(result, whole=True),
                  "rank 1 of 1", result.contents["the method"], result.dataset_sha256):
        assert words in request, words


@pytest.mark.parametrize(("change", "message"), [
    (lambda r: {"package": {"name": "", "version": ""}}, "not an installed package"),
    (lambda r: {"method": "gaussian"}, "'gaussian' is a method that ships"),
    (lambda r: {"contents": {**r.contents, "the method": "0" * 64}}, "the method changed since"),
    (lambda r: {"contents": {}}, "does not say of which source"),
    (lambda r: {"study": {"objects": 0.5}}, "a study's"),
])
def test_what_the_board_would_not_rank_is_refused_and_nothing_is_written(result, task, installed,
                                                                         tmp_path, change, message):
    dataclasses.replace(result, **change(result)).save(tmp_path / "r.json")
    with pytest.raises(TaskError, match=message):
        submit(tmp_path / "r.json", tmp_path / "out", task=task)
    assert not (tmp_path / "out").exists()


def test_a_task_that_is_not_installed_is_asked_for(result, tmp_path):
    result.save(tmp_path / "r.json")
    with pytest.raises(TaskError, match=r"task 'toy-v1', which is not installed.* --task FILE.toml"):
        submit(tmp_path / "r.json", tmp_path / "out")


def test_a_method_that_is_not_installed_is_refused(result, task, tmp_path):
    result.save(tmp_path / "r.json")
    with pytest.raises(TaskError, match="'toy_methods:Constant' is not installed here"):
        submit(tmp_path / "r.json", tmp_path / "out", task=task)


def test_weaknesses_are_told(result, task, installed, tmp_path):
    dataclasses.replace(result, isolation="process", made_by={"vsfsim": "0.2.0", "commit": "a" * 40 + "+changes"}
                        ).save(tmp_path / "r.json")
    _, numbers = submit(tmp_path / "r.json", tmp_path / "out", task=task)
    assert [one["what"] for one in numbers["checks"] if one["state"] == "told"] == [
        "it ran in a container", "it was scored by committed code"]
    dataclasses.replace(result, entry="predictions file", package={}, contents={}).save(tmp_path / "p.json")
    _, numbers = submit(tmp_path / "p.json", tmp_path / "out", task=task)
    assert numbers["checks"][-1] == {"what": "others can run it again", "state": "told",
                                     "said": "it is a file of predictions, so that nobody can: it stays unverified"}


def test_results_of_development_are_no_rows(result, task, installed, tmp_path):
    dataclasses.replace(result, task="toy-v1-development").save(tmp_path / "r.json")
    with pytest.raises(TaskError, match="has other objects than"):
        submit(tmp_path / "r.json", tmp_path / "out", task=task)


def test_the_command_gives_the_parameters_back(result):
    given = {"value": 0.001, "device": "cpu", "shots": [0, 1], "exact": True, "rule": "H+E (x'y)", "none": None}
    words = command_of(dataclasses.replace(result, parameters=given), whole=True)
    import shlex

    parts = shlex.split(words)
    back = parameters_of([parts[k + 1] for k, part in enumerate(parts) if part == "--set"])
    assert back == {key: value for key, value in given.items() if value is not None}
    assert contents_of("toy_methods:Constant", PARAMETERS)["the method"] == result.contents["the method"]
    assert json.dumps(back)
