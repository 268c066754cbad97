"""Result files and the table made of them."""

import dataclasses

import numpy as np
import pytest

from vsfsim.bench import leaderboard
from vsfsim.bench.admission.fingerprint import make_record
from vsfsim.bench.board.rows import CLAIMED, PREDICTIONS, command_of
from vsfsim.bench.commands.score import score_predictions
from vsfsim.bench.metrics import Answer, metrics_of, scores_of
from vsfsim.bench.predictions import questions
from vsfsim.bench.result import Result
from vsfsim.core.errors import MethodError, TaskError


@pytest.fixture(scope="module")
def results(constant):
    return [constant(value) for value in (50.0, 1.0, 5.0)]


def test_result_round_trip_and_raw_values(results, task, tmp_path):
    results[0].save(tmp_path / "deep" / "r.json")
    back = Result.load(tmp_path / "deep" / "r.json")
    assert back == results[0]
    assert back.computed() == back.scores, "from what is stored"
    assert scores_of(Answer.READINGS, back.rows, back.shots, back.seeds) == {
        metric.name: dict(back.scores[metric.name]) for metric in metrics_of(Answer.READINGS)}, "from the raw values"
    assert back.task_sha256 == task.sha256 and back.made_by["vsfsim"] and back.versions["numpy"] == np.__version__
    assert back.timing["adapts"] == 2 * (1 + 3 + 3 + 1)


def test_board_ranks_by_the_primary_metric_and_marks_other_data(results, task, tmp_path):
    for name, result in zip("abc", results):
        dataclasses.replace(result, method=name).save(tmp_path / f"{name}.json")
    for name, more in {"stranger": {"dataset_sha256": "f" * 64, "isolation": "namespaces"},
                       "older": {"task_sha256": "e" * 64, "isolation": "", "entry": PREDICTIONS}}.items():
        dataclasses.replace(results[1], method=name, **more).save(tmp_path / f"{name}.json")
    board = leaderboard.collect(task, [tmp_path])
    mean = {n: r.scores["rmse"]["5"].mean for n, r in zip("abc", results)}
    ranked = [row.result.method for row in board.rows if row.rank]
    assert ranked == sorted(mean, key=mean.get) and [row.rank for row in board.rows] == [1, 1, 1, None, None], (
        "two objects tell nothing")
    text = leaderboard.text(board)
    assert "stranger: other dataset (ffffffffffff), of which nothing is known, not ranked" in text
    assert "older: other text" in text
    assert f"but in a process that can read the user's files: {', '.join(ranked)}\n" in text
    assert "scored from a file, so that nothing kept its method from the answers: older\n" in text
    assert f"<td>{ranked[0]}</td>" in leaderboard.page([board])


def test_the_same_data_made_elsewhere_are_ranked(results, task, toy_dataset, tmp_path, monkeypatch):
    record = make_record(task, toy_dataset)
    monkeypatch.setattr(leaderboard, "shipped_record", lambda _: record)
    for name, result in zip("abc", results):
        dataclasses.replace(result, method=name).save(tmp_path / f"{name}.json")
    there = {**results[1].readings, "ss": [(1.0 + 2e-6) * v for v in results[1].readings["ss"]]}
    queries = {**results[1].queries, "sse": [(1.0 + 2e-6) * v for v in results[1].queries["sse"]]}
    elsewhere = dataclasses.replace(results[1], dataset_sha256="f" * 64, readings=there, data=record.table())
    dataclasses.replace(elsewhere, method="new").save(tmp_path / "d.json")
    # what was made again there, to the same numbers, is no second row; what came out otherwise is
    close = dataclasses.replace(elsewhere, method="b", queries=queries)
    dataclasses.replace(close, scores=close.computed()).save(tmp_path / "e.json")
    dataclasses.replace(elsewhere, method="a").save(tmp_path / "f.json")
    board = leaderboard.collect(task, [tmp_path])
    assert sorted((row.result.method, row.rank is not None, row.other_bits) for row in board.rows) == [
        ("a", True, False), ("a", True, True), ("b", True, False), ("c", True, False), ("new", True, True)]
    text = leaderboard.text(board)
    assert "new ~" in text and "~ on the same dataset, made on a machine that rounds otherwise" in text


def test_a_row_with_the_name_of_a_shipped_method_is_that_method_or_claimed(task, tuned, tmp_path):
    for k, (name, change) in enumerate({
            "same": {}, "source": {"contents": {**tuned.contents, "the method": "0" * 64}}, "silent": {"contents": {}},
            "settings": {"preset": "paper"}, "stranger": {"entry": "else:Where"},
            "package": {"package": {"name": "p"}}, "ceiling": {"method": "resim"}}.items()):
        scaled = [(1.0 + 0.1 * k) ** 2 * v for v in tuned.queries["sse"]]
        one = dataclasses.replace(tuned, queries={**tuned.queries, "sse": scaled}, **change)
        dataclasses.replace(one, scores=one.computed()).save(tmp_path / f"{name}.json")
    board = leaderboard.collect(task, [tmp_path])
    assert {row.path.stem for row in board.rows if row.mark == CLAIMED} == {
        "source", "silent", "settings", "stranger", "package", "ceiling"}
    assert [row.path.stem for row in board.rows if row.rank] == ["same"]
    assert leaderboard.text(board).count("(claimed, tuned)") == 5


def test_results_of_another_task_are_refused(results, task, tmp_path):
    dataclasses.replace(results[0], task="other-v1").save(tmp_path / "a.json")
    with pytest.raises(TaskError, match="is a result of task other-v1, not of toy-v1"):
        leaderboard.collect(task, [tmp_path])
    assert "vsfsim evaluate --method NAME --task toy-v1" in leaderboard.text(leaderboard.collect(task))


def test_predictions_from_a_file_score_like_the_method_itself(results, task, toy_dataset, tmp_path):
    answers = {}
    for question in questions(task, toy_dataset):
        assert len(question.support) == (8 if question.shot == "all" else int(question.shot))
        for key, action in zip(question.keys, question.actions):
            answers[key] = np.full((len(action.time), 1), 5.0)
    np.savez(tmp_path / "p.npz", **answers)
    scored = score_predictions(tmp_path / "p.npz", task, toy_dataset, name="elsewhere")
    assert scored.scores["rmse"] == results[2].scores["rmse"]
    assert command_of(scored) == "vsfsim lab score FILE --task toy-v1 --name elsewhere"
    for change, message in ((lambda a: a.pop(next(iter(a))), "have no '"),
                            (lambda a: a.update(x=np.zeros(1)), "does not ask"),
                            (lambda a: a.update({next(iter(a)): np.full((12, 1), np.nan)}), "is nan in frame 0")):
        wrong = dict(answers)
        change(wrong)
        np.savez(tmp_path / "w.npz", **wrong)
        with pytest.raises(MethodError, match=message):
            score_predictions(tmp_path / "w.npz", task, toy_dataset, name="elsewhere")
