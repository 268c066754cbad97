"""Which results are ranked: other data, other numbers and old files are shown with the reason or refused."""

import dataclasses
import json
import math
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.admission import admit, fingerprint
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.mock import mock_view
from vsfsim.bench.result import Result
from vsfsim.bench.result_file import write_record
from vsfsim.core.errors import TaskError
from vsfsim.core.plain_text import markdown


@pytest.fixture(scope="module")
def result(constant):
    return constant(1.0)


@pytest.fixture(scope="module")
def written(task, toy_dataset, result, plain_table, tmp_path_factory):
    """The record of the toy dataset, the result as a file, and that file's table as text."""
    folder = tmp_path_factory.mktemp("written")
    write_record(folder / "record.json", fingerprint.make_record(task, toy_dataset))
    result.save(folder / "r.json")
    return folder / "record.json", folder / "r.json", json.dumps(plain_table(folder / "r.json"))


@pytest.fixture
def record(task, written, tmp_path, monkeypatch):
    """The task ships the record of the toy dataset."""
    path = tmp_path / "records" / "toy-v1.json"
    path.parent.mkdir()
    path.write_bytes(written[0].read_bytes())
    monkeypatch.setattr(fingerprint, "record_path", lambda _: path)
    return fingerprint.shipped_record(task)


def views(rounding=0.0, train=0):
    """The toy dataset's views with their readings, paths and depth rounded otherwise; ``train`` is the object that the
    training file holds."""
    out = []
    for i in range(3):
        view = mock_view(train if i == 0 else i, split="train" if i < 1 else "test", touches=12)
        touches = tuple(dataclasses.replace(t, force=t.force * (1.0 + rounding), mount_pose=t.mount_pose + rounding)
                        for t in view.touches)
        image = dataclasses.replace(view.view, depth=view.view.depth * (1.0 + rounding))
        out.append(dataclasses.replace(view, name=f"mock-{i:04d}-v0", object_index=i, touches=touches, view=image))
    return out


def recorded(task, views):
    """The record of a dataset that holds these views."""
    return fingerprint.make_record(task, SimpleNamespace(recipe=SimpleNamespace(options={}),
        load={view.name: view for view in views}.get, sha256="0" * 64, made_by={},
        names=lambda split: [view.name for view in views if view.split == split]))


def test_rounding_is_the_same_dataset_and_anything_else_is_not(task, record):
    def found(views):
        return admit.differences(recorded(task, views), record)

    assert found(views(1e-7)) == []
    assert found(views(1e-2)) != []
    stolen = found(views(train=1))
    assert any("touches read otherwise (mock-0000-v0 touch 0)" in word for word in stolen)
    turned = views()
    turned[0] = dataclasses.replace(turned[0], touches=turned[0].touches[::-1])
    assert "of its touches read otherwise" in found(turned)[0]
    other = views()
    other[2] = dataclasses.replace(other[2], view=dataclasses.replace(other[2].view, rgb=255 - other[2].view.rgb))
    other[1] = dataclasses.replace(other[1], touches=(*other[1].touches[:3], dataclasses.replace(
        other[1].touches[3], force=1.01 * other[1].touches[3].force), *other[1].touches[4:]))
    assert found(other) == ["1 pictures or directions differ (mock-0002-v0: colour)",
                            "1 of its touches read otherwise (mock-0001-v0 touch 3), 2.78 % of "
                            "all, where rounding decides at most 2 %"]
    renamed = [dataclasses.replace(v, name=f"shoe-{v.object_index:04d}-v0") for v in views()]
    assert found(renamed) == ["its object views or their splits are others, e.g. mock-0000-v0"]


def test_few_touches_may_have_other_frames_that_did_not_converge(task, record, monkeypatch):
    def found(count, **changes):
        other = views()
        other[1] = dataclasses.replace(other[1], touches=tuple(dataclasses.replace(
            touch, converged=touch.converged & ((np.arange(len(touch.time)) != 6) | (k >= count)), **changes)
            for k, touch in enumerate(other[1].touches)))
        return admit.differences(recorded(task, other), record)

    assert "1 of its touches read otherwise" in found(1)[0]
    monkeypatch.setattr(admit, "OTHER_ENDS", 0.03)
    assert found(1) == [] and len(found(2)) == 1
    assert "directions differ" in found(1, axis=np.array([0.0, 0.6, -0.8]))[0], "another path is another touch"


def _snapped(count, force=1.3, **changes):
    """The toy dataset's views; some touches of the second one came to another end."""
    other = views()
    other[1] = dataclasses.replace(other[1], touches=tuple(dataclasses.replace(
        touch, force=force * touch.force, mount_pose=touch.mount_pose + 1e-2 * (np.arange(len(touch.time)) > 4)[
            :, None, None], **changes) if k < count else touch for k, touch in enumerate(other[1].touches)))
    return other


def test_where_rounding_decides_as_much_may_differ_as_on_another_machine(task, record):
    def made(views):
        return recorded(task, views)

    assert "4 of its touches read" in admit.differences(made(_snapped(4)), record)[0], "nothing was measured yet"
    wrong, _, share = admit.apart(made(_snapped(4)), record)
    assert share == pytest.approx(4 / 36) and not wrong
    record = msgspec.structs.replace(record, again=share)
    path = fingerprint.record_path(task)
    write_record(path, record)
    known = fingerprint.shipped_record(task)
    assert known.again == record.again
    for same in (_snapped(4, 0.8), _snapped(5, 1.2), views()):
        assert admit.differences(made(same), known) == []
    # more touches, another direction or another view are other data
    more = admit.differences(made(_snapped(6, 1.01)), known)
    assert "16.7 % of all, where rounding decides at most 13.9 %" in more[0]
    turned = np.array([0.0, 0.6, -0.8])
    assert "4 pictures or directions differ" in admit.differences(made(_snapped(4, axis=turned)), known)[0]
    seen = _snapped(4)
    seen[2] = dataclasses.replace(seen[2], view=dataclasses.replace(seen[2].view, rgb=255 - seen[2].view.rgb))
    assert admit.differences(made(seen), known) == ["1 pictures or directions differ (mock-0002-v0: colour)"]
    for other in (_snapped(4, axis=turned), seen, views()[:2]):
        assert admit.apart(made(other), record)[0], "not of the same planned touches"


def test_training_on_the_test_objects_is_not_ranked(task, record, result, write_dataset, tmp_path):
    same = dataclasses.replace(result, dataset_sha256="1" * 64, data=recorded(task, views(1e-7)).table())
    cheat = evaluate("toy_methods:Constant", task, write_dataset(views(train=1)),
                     parameters={"value": 4.0}, check=False)
    (tmp_path / "results").mkdir()
    for name, one in (("a", result), ("b", same), ("c", cheat)):
        dataclasses.replace(one, method=name).save(tmp_path / "results" / f"{name}.json")
    board = leaderboard.collect(task, [tmp_path / "results"])
    rows = {row.result.method: row for row in board.rows}
    assert rows["a"].rank and rows["b"].rank and rows["b"].other_bits and rows["c"].rank is None
    assert "other dataset" in rows["c"].mark and "read otherwise (mock-0000-v0 touch 0)" in rows["c"].mark
    text = leaderboard.text(board)
    assert "c: other dataset" in text and "~ on the same dataset" in text and "ships no record" not in text


def change(**fields):
    return lambda result: dataclasses.replace(result, **{name: make(result) for name, make in fields.items()})


def first(value, **columns):
    def make(result):
        return {**result.queries, **{name: [value, *result.queries[name][1:]] for name in columns}}
    return make


@pytest.mark.parametrize(("wrong", "reason"), [
    (change(queries=first(3, n=1)), "another number of readings of a touch at some shot and seed"),
    (change(queries=first("mock-0002-v0", object=1)), "query touch"),
    (change(queries=lambda r: {k: v[:-1] for k, v in r.queries.items()}), "missing or there twice"),
    (change(queries=lambda r: {k: [*v, v[0]] for k, v in r.queries.items()}), "missing or there twice"),
    (change(answers=lambda r: {"stiffness": {"object": ["a"]}}), "its rows cannot be scored"),
    (change(dataset_sha256=lambda r: "0" * 64), "other dataset (000000000000), of which nothing is known"),
])
def test_numbers_that_disagree_are_not_ranked(task, record, result, tmp_path, wrong, reason):
    wrong(result).save(tmp_path / "r.json")
    (row,) = leaderboard.collect(task, [tmp_path / "r.json"]).rows
    assert row.rank is None and reason in row.mark and not row.other_bits


def test_what_a_result_says_of_its_scores_is_not_read(task, record, result, tmp_path):
    better = change(scores=lambda r: {"rmse": {shot: dataclasses.replace(s, mean=0.1, per_seed=(0.1,) * 3, std=0.0)
                                               for shot, s in r.scores["rmse"].items()}})(result)
    better.save(tmp_path / "r.json")
    (row,) = leaderboard.collect(task, [tmp_path / "r.json"]).rows
    assert row.rank == 1 and row.scores == result.scores


def test_fewer_seeds_are_not_ranked(task, record, result, tmp_path):
    def first(columns):
        return {name: [v for v, seed in zip(column, columns["seed"]) if seed == 0] for name, column in columns.items()}

    one = dataclasses.replace(result, seeds=(0,), queries=first(result.queries),
                              answers={name: first(columns) for name, columns in result.answers.items()})
    dataclasses.replace(one, scores=one.computed()).save(tmp_path / "r.json")
    (row,) = leaderboard.collect(task, [tmp_path / "r.json"]).rows
    assert row.rank is None and row.mark == "1 of the task's 3 seeds"


@pytest.mark.parametrize("poison", [
    lambda t: t["queries"]["sse"].__setitem__(0, -1.0), lambda t: t["queries"]["n"].__setitem__(0, 0),
    lambda t: t["queries"]["n"].__setitem__(0, None), lambda t: t["queries"]["sse"].__setitem__(0, 10**400),
    lambda t: t["scores"]["rmse"]["0"].update(per_seed=[math.inf] * 3), lambda t: t["queries"]["n"].pop(),
    lambda t: t["scores"]["rmse"]["0"].update(mean=math.nan), lambda t: t["scores"]["rmse"]["0"].update(mean=0.0),
    lambda t: t.update(parameters=json.loads("[" * 900 + "]" * 900)), lambda t: t.update(seeds=[0, 0, 0]),
    lambda t: t["timing"].update(adapt_s=-1.0), lambda t: t.pop("timing"), lambda t: t["readings"]["ss"].pop(),
])
def test_poisoned_results_are_refused_in_one_paragraph(written, tmp_path, poison):
    table = json.loads(written[2])
    poison(table)
    (tmp_path / "r.json").write_text(json.dumps(table))
    with pytest.raises(TaskError, match=r"r\.json (is malformed|cannot be read): "):
        Result.load(tmp_path / "r.json")


def test_names_are_cleaned_for_a_terminal_and_a_page(task, record, result, tmp_path):
    evil = "\x1b[2J<script>alert(1)</script>|\u202eknar\r\n# [x](javascript:1)"
    dataclasses.replace(result, method=evil, notes=(evil,)).save(tmp_path / "r.json")
    board = leaderboard.collect(task, [tmp_path / "r.json"])
    ((_, name, *_),) = leaderboard.cells(board, markdown)[1]
    for page in (leaderboard.text(board), leaderboard.page([board]), name):
        assert "alert(1)" in page and not set(page) & set("\x1b\r\u202e")
    assert "<script" not in leaderboard.page([board]) and not set("<|[") & set(name)


@pytest.mark.parametrize("words", ['{"format": "vsfsim-task-record", "version": 1}', "[" * 5000])
def test_a_damaged_record_is_refused(task, record, words):
    fingerprint.record_path(task).write_text(words)
    with pytest.raises(TaskError, match=r"toy-v1\.json (is no record|cannot be read)"):
        fingerprint.shipped_record(task)
