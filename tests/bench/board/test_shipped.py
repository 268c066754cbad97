"""Rows that ship: a board read from its compact file is the board of the result files, and rows that are forged from
it get no rank of a shipped method, and no evidence."""

import dataclasses
import json
import shutil
from pathlib import Path

import msgspec
import numpy as np
import pytest

from measurements import audit, release
from measurements.release import SEEDS, ship, write_list
from vsfsim.bench import leaderboard
from vsfsim.bench.admission import fingerprint
from vsfsim.bench.admission.fingerprint import shipped_record
from vsfsim.bench.board import rows
from vsfsim.bench.board.compare import by_object
from vsfsim.bench.board.rows import row_sha256
from vsfsim.bench.evaluate import Made
from vsfsim.bench.identity import contents_of
from vsfsim.bench.metrics import Answer, scores_of
from vsfsim.bench.result import Result
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
    monkeypatch.setattr(leaderboard, "folder", lambda _: tmp_path)
    monkeypatch.setattr(rows, "folder", lambda _: tmp_path)
    board = leaderboard.collect(task, [results])
    ship({Path("toy-v1", row.path.name): (row.admitted(), "", 3.0) for row in board.rows}, tmp_path)
    shipped = leaderboard.collect(task)
    for row, was in zip(shipped.rows, board.rows, strict=True):
        assert row.rank == was.rank and not row.result.rows and row.path.name == was.path.name
        for shot in task.protocol.labels:
            found, expected = (by_object(r.result, "rmse", shot) for r in (row, was))
            assert found == pytest.approx(expected, rel=1e-7) and len(found) == 2
    again = leaderboard.collect(task, [results])
    assert [row.origin for row in again.rows] == ["shipped, made again here"] * 2
    assert {entry.cpu_s >= 3.0 for entry in rows.listed().values()} == {True}
    other = dataclasses.replace(task, sha256="other")
    assert {row.mark for row in leaderboard.collect(other).rows} == {"other text of the task"}


def test_every_living_board_has_ceilings_and_simple_rows_or_says_why_not(board):
    """Each row that every board should have is of the release or in `leaderboard/absent.toml`, never both."""
    wanted = {"resim", "fem-map", "fem-map-seen", "near-springs", "surface-gp", "cnp", "sbml", "neural-vsf", "grid-vsf"}
    known = methods().keys() | ceilings().keys()
    assert set(rows.plan()) == set(shelf.tasks())
    for task in map(load_task, shelf.tasks()):
        planned = {key.partition(".")[0] for key in rows.plan()[task.name].rows}
        absent = rows.absent(task.name, rows.plan()[task.name].rows)
        said = [name for names in absent for name in names.split(", ")]
        assert len(said) == len(set(said)) and planned | set(said) <= known and not planned & set(said), task.name
        assert wanted <= planned | set(said), task.name
    assert "no row of fem-map, fem-map-seen: 0.7 and 1.7 CPU hours" in leaderboard.text(board)
    assert "lab release --only bag-punyo-v1" in ", ".join(rows.absent("bag-punyo-v1", ()).values())


def test_a_release_costs_at_most_a_day_and_audits_every_task():
    """By its table; audits on three fresh seeds are of rows of the board."""
    parts = rows.plan()
    minutes = [part.dataset + part.audit + sum(part.rows.values()) + sum(part.studies.values())
               + len(SEEDS) * sum(part.fresh.values()) for part in parts.values()]
    assert sum(minutes) <= 24 * 60 and all(part.audit > 0.0 for part in parts.values())
    assert any(len(part.fresh.keys() - {"dataset"}) >= 6 for part in parts.values())
    assert all(part.fresh.keys() - {"dataset"} <= part.rows.keys() for part in parts.values())


def test_a_release_goes_on_where_it_stopped_on_another_machine(task, toy_dataset, tuned, tmp_path, monkeypatch):
    """What ships is kept where no result lies: a row by the digests of its task, data, method and scorer, an audit by
    those of its rows. The second machine makes the row that is missing, and after a change all."""
    part = rows.Part(1.0, {"contact-points.tuned": 2.0, "resim": 3.0}, audit=4.0, studies={"toy": 5.0})
    lacking, made = ["half"], []
    elsewhere(monkeypatch, tmp_path)
    monkeypatch.setattr(release, "plan", lambda: {"toy-v1": part})
    monkeypatch.setattr(release, "load_task", lambda _: task)
    monkeypatch.setattr(release, "dataset_of", lambda *_: toy_dataset)
    monkeypatch.setattr(audit, "_shortcuts", lambda *_: {"view": {"mock-0001": 0.5}})
    monkeypatch.setattr(release, "load_study", lambda name: name)
    monkeypatch.setattr(release, "lacking", lambda _: lacking)
    monkeypatch.setattr(release, "make_studies", lambda studies, *_: made.append(studies) or iter(()))
    monkeypatch.setattr(release, "commit", lambda: "a" * 40)
    monkeypatch.setattr(rows, "absent", lambda what, _: {"all": "too large"} if what == "study toy" else {})
    asked, row = [], tuned
    ceiling = dataclasses.replace(row, method="resim", entry=ceilings()["resim"].value, preset="",
                                  parameters={}, contents=contents_of("resim", {}))

    def evaluate_all(one, choices, **_):
        ((path, choice),) = choices.items()
        asked.append(path.stem)
        result = ceiling if choice.method == "resim" else row
        result.save(path)
        yield Made(path, result)

    monkeypatch.setattr(release, "evaluate_all", evaluate_all)

    def state():
        return {what: how for _, what, _, how in release.planned(None)[1]}

    assert set(state().values()) == {"missing"}
    monkeypatch.chdir(make_folder(tmp_path / "one"))
    said, _ = release.release(["toy-v1"], 1, lambda *_: None)
    assert said.startswith("left out of study toy: all; too large\n")
    assert asked == ["contact-points.tuned", "resim"] and made == [["toy"]]
    assert {what for what, how in state().items() if how == "missing"} == {"dataset", "study toy"}
    lacking.clear()
    assert "0.2 CPU hours, of which 0.0 are missing\nleft out of" in release.planned(None)[0]
    (tmp_path / "leaderboard" / "toy-v1" / "resim.json").unlink()
    monkeypatch.chdir(make_folder(tmp_path / "two"))
    assert {what for what, how in state().items() if how == "missing"} == {"dataset", "resim", "audit"}
    release.release(["toy-v1"], 1, lambda *_: None)
    assert asked[2:] == ["resim"] and set(state().values()) == {"there"}
    release.release(["toy-v1"], 1, lambda *_: None)
    assert len(asked) == 3, "nothing is made twice"
    part.fresh["contact-points.tuned"] = 1.0  # a method that fails on a fresh seed stops no study
    lacking.append("half")
    monkeypatch.setattr(release.Whole, "_on", lambda *_: load_task("no-such"))
    with pytest.raises(TaskError, match=r"^toy-v1, audit: unknown task 'no-such'"):
        release.release(["toy-v1"], 1, lambda *_: None)
    assert made[-1] == ["toy"] and not part.fresh.clear() and not lacking.clear()
    monkeypatch.setattr(release, "changed", lambda name, *_: ["the method"] * (name == "contact-points"))
    assert [what for what, how in state().items() if how == "missing"] == ["dataset", "contact-points.tuned", "audit"]


def test_what_does_not_ship_is_left_out_and_told(monkeypatch):
    """Recordings, and variants with weights of others; what is named is in the study."""
    mini, real = (release.Whole(name, rows.plan()[name]) for name in ("fewshot-shoes-v3-mini-v1", "real-palpation-v1"))
    study, without = release.load_study("shoes-features"), {"dinov2-s", "dinov2-b"}
    assert without <= {one.name for one in study.variants}
    assert not without & {one.name for one in release.lacking(study)}
    monkeypatch.setattr(release.Whole, "items", lambda _: {"dataset": (0.2, False)})
    assert list(real.make(1, lambda *_: None)) == []
    of_task, of_study = release.left_out([mini, real])
    assert of_task.startswith("left out: real-palpation-v1; its recordings do not ship, and are not in ")
    assert of_study.startswith("left out of study shoes-features: dinov2-s, dinov2-b; the published weights do not")


def test_data_that_are_others_take_the_rows_with_them(task, toy_dataset, tuned, tmp_path, monkeypatch,
                                                      write_dataset, toy_views):
    """Those of a machine that rounds otherwise, or of code that marks other frames, do not: the record stays, and has
    their share of marked frames."""
    elsewhere(monkeypatch, tmp_path)
    scored = dataclasses.replace(task.protocol, unresolved="scored")
    task, out = dataclasses.replace(task, protocol=scored), tmp_path / "leaderboard"
    release._keep_record(task, toy_dataset, out)
    ship({Path("toy-v1", "contact-points.tuned.json"): (tuned, "", 1.0)}, out)

    def data(factor, **marks):
        return write_dataset([dataclasses.replace(view, touches=tuple(dataclasses.replace(
            t, force=t.force * factor, **marks) for t in view.touches)) for view in toy_views])

    release._keep_record(task, data(1.0 + 1e-7, resolved=np.zeros(len(toy_views[0].touches[0].time), bool)), out)
    assert len(rows.listed()) == 1 and shipped_record(task).dataset_sha256 == toy_dataset.sha256
    assert shipped_record(task).unresolved[2] == 1.0
    other = data(1.5)
    release._keep_record(task, other, out)
    assert not rows.listed() and not list(out.glob("toy-v1/*")) and shipped_record(task).dataset_sha256 == other.sha256


def elsewhere(monkeypatch, root):
    """Rows and records that ship are in a folder of the test's own."""
    known = shelf.folder
    for module in (release.shelf, leaderboard, rows, fingerprint):
        monkeypatch.setattr(module, "folder", lambda what: root / what if what in ("leaderboard", "tasks") else known(
            what))
    monkeypatch.setattr(release.shelf, "checkout", lambda: root)


def make_folder(path):
    path.mkdir()
    return path


def test_a_release_says_what_it_makes(vsfsim, tmp_path):
    said = vsfsim("lab", "release", "--dry-run", "--only", "rope-punyo-v1", cwd=tmp_path).stdout
    assert "grid-vsf.tuned" in said and "study rope" in said and "CPU hours, of which" in said
    wrong = vsfsim("lab", "release", "--dry-run", "--only", "rope-punyo", cwd=tmp_path)
    assert wrong.returncode == 2 and "Did you mean 'rope-punyo-v1'" in wrong.stderr


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
                rows.append((name, shot, seed, touch, n, sse))
    queries = dict(zip(("object", "shot", "seed", "touch", "n", "sse"), map(list, zip(*rows)), strict=True))
    scores = scores_of(Answer.READINGS, beside_zero(as_rows(queries), one.readings), one.shots, one.seeds)
    return dataclasses.replace(one, queries=queries, answers={}, maps={}, values={}, data={},
                               scores=scores, dataset_sha256=record.dataset_sha256, **more)


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
                 (0.1, "verified", {"method": "great", **own}), (0.1, "sealed", {"method": "a;reboot", **own}),
                 (0.1, "sealed", {"method": "", **own}), (0.1, "sealed", {"method": "m" * 400, **own})))]
    found = leaderboard.collect(board.task, files)
    mine = {row.path.stem: row for row in found.rows if row.path in files}
    assert [mine[k].mark == rows.CLAIMED for k in "01234567"] == [True] * 4 + [False] * 4
    assert [mine[k].rank for k in "01234567"] == [None, None, None, None, 1, None, None, None]
    assert all("means something to a shell" in mine[k].mark for k in "567")
    assert {row.evidence for row in mine.values()} == {"open"}
    assert leaderboard.possible(found) == leaderboard.possible(board)


def test_what_is_written_into_the_files_that_ship_stands_only_by_the_list(board, tmp_path, monkeypatch):
    """A row added, a score changed, evidence written into a row; then a list with a receipt that is missing."""
    root = shelf.folder("leaderboard")
    shutil.copytree(root / TASK, tmp_path / TASK)
    shutil.copy(root / rows.LIST, tmp_path)
    monkeypatch.setattr(leaderboard, "folder", lambda _: tmp_path)
    monkeypatch.setattr(rows, "folder", lambda _: tmp_path)
    ranks = [(row.result.method, row.result.preset, row.rank) for row in leaderboard.collect(board.task).rows]
    assert ranks == [(row.result.method, row.result.preset, row.rank) for row in board.rows]
    one, other, *_ = sorted((tmp_path / TASK).glob("*.json"))
    great = json.loads(one.read_text()) | {"method": "great", "entry": "great:Great", "evidence": "verified"}
    better = json.loads(other.read_text())
    better["scores"] = {"rmse_ratio": {"5": {"mean": 0.1, "std": 0.0, "per_seed": []}}}
    for path, table in ((one, great), (other, better)):
        path.write_text(json.dumps(table))
    found = leaderboard.collect(board.task).rows
    odd = {row.result.method: row for row in found if row.mark == rows.UNLISTED}
    assert odd.keys() == {"great", better["method"]} and all(row.rank is None for row in odd.values())
    assert {row.evidence for row in odd.values()} == {"open"}
    assert f"* great: {rows.UNLISTED}" in leaderboard.text(leaderboard.collect(board.task))
    entry = next(iter(rows.listed().values()))
    write_list([msgspec.structs.replace(entry, evidence="verified")], tmp_path / rows.LIST)
    assert {one.evidence for one in rows.listed().values()} == {"verified"}
    (tmp_path / rows.LIST).write_text((tmp_path / rows.LIST).read_text().replace('"verified"', '"sealed"'))
    with pytest.raises(TaskError, match="needs the commitment of its set and the receipt"):
        rows.listed()


def test_every_row_that_ships_is_listed_and_every_listed_row_ships():
    """So all tables of README and pages come from rows whose command, commit and machine are known."""
    root, entries = shelf.folder("leaderboard"), rows.listed()
    files = [path for path in root.rglob("*.json") if path.name != rows.LIST and path.parent.name != "audits"]
    there = {row_sha256(one): one for one in map(Result.load, files)}
    assert entries and entries.keys() == there.keys() and len(files) == len(there)
    for sha256, entry in entries.items():
        assert (entry.task, entry.method) == (there[sha256].task, there[sha256].method)
        assert entry.commit == there[sha256].made_by["commit"] or entry.evidence == "verified"
