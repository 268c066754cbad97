"""Rows that ship: a board read from its compact file is the board of the result files, and rows that are forged from
it get no rank of a shipped method, and no evidence."""

import dataclasses
import json
import math
import shutil

import msgspec
import numpy as np
import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.admission.fingerprint import shipped_record
from vsfsim.bench.board import rows
from vsfsim.bench.board.compare import by_object
from vsfsim.bench.board.rows import read_rows, row_sha256
from vsfsim.bench.identity import contents_of
from vsfsim.bench.metrics import Answer, scores_of
from vsfsim.bench.result_file import as_rows, beside_zero
from vsfsim.bench.task import load_task
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import ceilings, methods


@pytest.fixture(scope="module")
def results(constant, tmp_path_factory):
    out = tmp_path_factory.mktemp("results")
    for value in (1.0, 5.0):
        constant(value).save(out / f"constant-{value:g}.json")
    return out


def test_a_board_that_ships_is_the_board_of_its_results(task, results, tmp_path, monkeypatch):
    board = leaderboard.collect(task, [results])
    leaderboard.ship(board, tmp_path / "toy-v1.json")
    monkeypatch.setattr(leaderboard, "folder", lambda _: tmp_path)
    monkeypatch.setattr(rows, "folder", lambda _: tmp_path)
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
    lambda t: t.update(version=9), lambda t: t["rows"]["constant-1.json"].pop("values"),
    lambda t: t["rows"]["constant-1.json"].update(method=3),
    lambda t: t["objects"].pop(), lambda t: t["rows"]["constant-1.json"]["scores"]["rmse"].update({"0": ["a", 1]})])
def test_a_damaged_file_is_refused(task, results, tmp_path, change):
    path = tmp_path / "toy-v1.json"
    leaderboard.ship(leaderboard.collect(task, [results]), path)
    table = json.loads(path.read_text())
    change(table)
    path.write_text(json.dumps(table))
    with pytest.raises(TaskError, match="is no leaderboard that ships"):
        read_rows(path)


def test_every_living_board_has_ceilings_and_simple_rows_or_says_why_not(board):
    """Each row that every board should have is there or in `leaderboard/absent.toml`, never both."""
    wanted = {"resim", "fem-map", "fem-map-seen", "near-springs", "surface-gp", "cnp", "sbml"}
    known = methods().keys() | ceilings().keys()
    for task in map(load_task, shelf.tasks()):
        there = {one.method for one in read_rows(shelf.folder("leaderboard") / f"{task.name}.json").values()}
        said = [name for names in rows.absent(task.name) for name in names.split(", ")]
        assert len(said) == len(set(said)) and set(said) <= known and not there & set(said), task.name
        assert task.superseded_by or wanted <= there | set(said), task.name
    assert all(f"no row of {names}: {reason}" in leaderboard.text(board)
               for names, reason in rows.absent(TASK).items())


# ------------------------------------------------------------------ rows made by hand, from what ships alone

TASK = "fewshot-shoes-v3-mini-v1"


def forged(board, share, **more):
    """A result whose errors are ``share`` of zero's: query readings' sums of squares ship with every board."""
    one = next(row.result for row in board.rows if (row.result.method, row.result.preset) == ("sbml", "tuned"))
    rng, record = np.random.default_rng(0), shipped_record(board.task)
    rows = []
    for name, touch, n, ss in zip(*(one.readings[k] for k in ("object", "touch", "n", "ss")), strict=True):
        for shot in one.shots:
            for seed in one.seeds:
                sse = float(np.float32(ss * share**2 * rng.uniform(0.8, 1.2) / (1 if shot == "0" else 2)))
                rows.append((name, shot, seed, touch, n, sse, float(np.float32(math.sqrt(sse * n) * 0.8))))
    queries = dict(zip(("object", "shot", "seed", "touch", "n", "sse", "sae"), map(list, zip(*rows)), strict=True))
    scores = scores_of(Answer.READINGS, beside_zero(as_rows(queries), one.readings, 1), one.shots, one.seeds)
    return dataclasses.replace(one, queries=queries, answers={}, maps={}, values={}, data={}, scores=scores,
                               dataset_sha256=record.dataset_sha256, **more)


@pytest.fixture(scope="module")
def board():
    return leaderboard.collect(load_task(TASK))


def saved(result, path, **said):
    """The file of a result, with what it says of itself besides."""
    result.save(path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **said}))
    return path


def test_a_forged_row_has_no_evidence_and_no_rank_of_a_method_that_ships(board, tmp_path):
    """The same name, settings and digests as the row that ships; another source; a file of predictions; a ceiling."""
    own = {"entry": "great:Great", "package": {"name": "great", "version": "1.0"}, "preset": "", "contents": {}}
    resim = {"method": "resim", "preset": "", "entry": shelf.ceilings()["resim"].value}
    files = [saved(forged(board, share, **more), tmp_path / f"{k}.json", evidence=said)
             for k, (share, said, more) in enumerate((
                 (0.2, "sealed", {"contents": contents_of("sbml", {})}), (0.21, "verified", {"contents": {}}),
                 (0.22, "verified", {"entry": rows.PREDICTIONS}), (0.5, "verified", resim),
                 (0.1, "verified", {"method": "great", **own}), (0.1, "sealed", {"method": "a;reboot", **own})))]
    found = leaderboard.collect(board.task, files)
    mine = {row.path.stem: row for row in found.rows if row.path in files}
    assert [mine[k].mark == rows.CLAIMED for k in "012345"] == [True, True, True, True, False, False]
    assert [mine[k].rank for k in "012345"] == [None, None, None, None, 1, None]
    assert "means something to a shell" in mine["5"].mark
    assert {row.evidence for row in mine.values()} == {"open"}
    assert leaderboard.possible(found) == leaderboard.possible(board)


def test_what_is_written_into_the_files_that_ship_stands_only_by_the_list(board, tmp_path, monkeypatch):
    """A row added, a score changed, evidence written into a row; then a list with a receipt that is missing."""
    root = shelf.folder("leaderboard")
    for name in (f"{TASK}.json", rows.LIST):
        shutil.copy(root / name, tmp_path / name)
    monkeypatch.setattr(leaderboard, "folder", lambda _: tmp_path)
    monkeypatch.setattr(rows, "folder", lambda _: tmp_path)
    path, table = tmp_path / f"{TASK}.json", json.loads((root / f"{TASK}.json").read_text())
    ranks = [(row.result.method, row.result.preset, row.rank) for row in leaderboard.collect(board.task).rows]
    assert ranks == [(row.result.method, row.result.preset, row.rank) for row in board.rows]
    one, other, *_ = table["rows"].values()
    great = {**one, "method": "great", "entry": "great:Great", "evidence": "verified"}
    better = {**other, "scores": {**other["scores"], "rmse_ratio": {"5": [0.1, 0.0]}}}
    changed = dict(zip(table["rows"], (great, better)))
    path.write_text(json.dumps({**table, "rows": {**table["rows"], **changed}}))
    found = leaderboard.collect(board.task).rows
    odd = {row.result.method: row for row in found if row.mark == rows.EARLIER}
    assert odd.keys() == {"great", other["method"]} and all(row.rank is None for row in odd.values())
    assert {row.evidence for row in found} == {"open"} and "†" in leaderboard.text(leaderboard.collect(board.task))
    entry = next(iter(rows.listed().values()))
    rows.write_list([msgspec.structs.replace(entry, evidence="verified")], tmp_path / rows.LIST)
    assert {one.evidence for one in rows.listed().values()} == {"verified"}
    (tmp_path / rows.LIST).write_text((tmp_path / rows.LIST).read_text().replace('"verified"', '"sealed"'))
    with pytest.raises(TaskError, match="needs the commitment of its set and the receipt"):
        rows.listed()


def test_every_listed_row_ships_and_is_as_it_was_listed():
    """No entry without its row; no row of today's tasks by the trainings whose records were rewritten."""
    there, entries = {}, rows.listed()
    for path in {shelf.folder("leaderboard") / of / f"{entry.task}.json" for entry in entries.values()
                 for of in ("", "studies")}:
        there |= {row_sha256(one): one for one in read_rows(path).values()}
    assert entries and entries.keys() <= there.keys()
    for sha256, entry in entries.items():
        assert (entry.task, entry.method) == (there[sha256].task, there[sha256].method)
        assert entry.commit == there[sha256].made_by["commit"] or entry.evidence == "verified"
    assert not any("was set to the second" in note for one in there.values() for note in one.notes)
