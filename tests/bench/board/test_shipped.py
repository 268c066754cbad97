"""Rows that ship: a board read from its compact file is the board of the result files."""

import dataclasses
import json

import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.board.absent import absent
from vsfsim.bench.board.compare import by_object
from vsfsim.bench.board.shipped import read_rows
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.task import load_task
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import ceilings, methods


@pytest.fixture(scope="module")
def results(task, toy_dataset, tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    for value in (1.0, 3.0):
        evaluate("toy_methods:Constant", task, toy_dataset, parameters={"value": value}, check=False).save(
            out / f"constant-{value:g}.json")
    return out


def test_a_board_that_ships_is_the_board_of_its_results(task, results, tmp_path, monkeypatch):
    board = leaderboard.collect(task, [results])
    leaderboard.ship(board, tmp_path / "toy-v1.json")
    monkeypatch.setattr(leaderboard, "folder", lambda _: tmp_path)
    shipped = leaderboard.collect(task)
    assert leaderboard.markdown(shipped) == leaderboard.markdown(board)
    for row, was in zip(shipped.rows, board.rows, strict=True):
        assert row.rank == was.rank and not row.result.queries["n"] and row.path.name == was.path.name
        for shot in task.protocol.labels:
            found, expected = (by_object(r.result, "rmse", shot) for r in (row, was))
            assert found == pytest.approx(expected, rel=1e-7) and len(found) == 2
    again = leaderboard.collect(task, [results])
    assert [row.origin for row in again.rows] == ["shipped, made again here"] * 2
    other = dataclasses.replace(task, sha256="other")
    assert {row.mark for row in leaderboard.collect(other).rows} == {"other text of the task"}


@pytest.mark.parametrize("change", [
    lambda t: t.update(version=9), lambda t: t["rows"][0].pop("values"), lambda t: t["rows"][0].update(method=3),
    lambda t: t["rows"][0].update(readings=7), lambda t: t["objects"].pop(),
    lambda t: t["rows"][0]["scores"]["rmse"].update({"0": ["a", 1]}), lambda t: t.update(rows=3)])
def test_a_damaged_file_is_refused(task, results, tmp_path, change):
    path = tmp_path / "toy-v1.json"
    leaderboard.ship(leaderboard.collect(task, [results]), path)
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    with pytest.raises(TaskError, match="is no leaderboard that ships"):
        read_rows(path)


def test_what_ships_is_small():
    assert sum(path.stat().st_size for path in shelf.folder("leaderboard").rglob("*.json")) < 5e6


def test_every_living_board_has_ceilings_and_simple_rows_or_says_why_not():
    """Each row that every board should have is there or in `leaderboard/absent.toml`, never both."""
    wanted = {"resim", "fem-map", "fem-map-seen", "near-springs", "surface-gp", "cnp", "sbml"}
    known = methods().keys() | ceilings().keys()
    for task in map(load_task, shelf.tasks()):
        there = {one.result.method for one in read_rows(shelf.folder("leaderboard") / f"{task.name}.json")}
        said = [name for names in absent(task.name) for name in names.split(", ")]
        assert len(said) == len(set(said)) and set(said) <= known and not there & set(said), task.name
        assert task.superseded_by or wanted <= there | set(said), task.name
        title = leaderboard.text(leaderboard.collect(task))
        assert all(f"no row of {names}: {reason}" in title for names, reason in absent(task.name).items())


def test_a_damaged_list_of_absent_rows_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("vsfsim.bench.board.absent.folder", lambda _: tmp_path)
    for text in ("[broken", 'fewshot-shoes-v3-v1 = "text"'):
        (tmp_path / "absent.toml").write_text(text)
        with pytest.raises(TaskError, match=r"absent\.toml"):
            absent("fewshot-shoes-v3-v1")
