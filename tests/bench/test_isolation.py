"""Every known way to reach the truth or the scorer from a method, and every way in which a method can break."""

import dataclasses
import json

import pytest

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.isolation import limits
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.protocol import divide, record
from vsfsim.core.errors import MethodError


@pytest.fixture(scope="module")
def honest(task, toy_dataset):
    """The scores of a method that answers 1.5 and does nothing else."""
    return evaluate("toy_methods:Constant", task, toy_dataset, seeds=1, check=False).scores


@pytest.fixture
def attack(task, toy_dataset, tmp_path):
    """Evaluates a hostile method at one seed and returns its scores and what it reported; with ``brief`` at two of the
    four shots."""
    def run(name, *, seeds=1, brief=False, **parameters):
        report = tmp_path / "report.txt"
        report.unlink(missing_ok=True)
        shots = (0,) if brief else task.protocol.shots
        asked = dataclasses.replace(task, protocol=dataclasses.replace(task.protocol, shots=shots))
        result = evaluate(name if ":" in name else f"hostile_methods:{name}", asked, toy_dataset, seeds=seeds,
                          check=False, parameters={"report": str(report.with_suffix("")), **parameters})
        lines = report.read_text().splitlines() if report.exists() else []
        return result.scores, [json.loads(line) for line in lines]

    return run


def test_no_frame_of_a_caller_holds_the_truth(attack, honest):
    scores, found = attack("ReadsFrames")
    names = set().union(*found)
    assert "vsfsim.bench.isolation.child._Server" in names, "the frames were looked through"
    assert not [name for name in names if name.rpartition(".")[2] in ("Truth", "ObjectView", "Recording", "Dataset",
                                                                      "Subject")]
    assert scores == honest


def test_no_object_in_memory_is_the_truth_or_a_reading_of_a_query(attack, honest, task, toy_views):
    scores, found = attack("ReadsMemory")
    assert all(one["kinds"] == [] for one in found)
    seen = {round(total, 9) for one in found for total in one["readings"]}
    given, asked = set(), set()
    for view in toy_views[1:]:
        query = divide(view, task.protocol).query
        recording = record(view, task)
        for index, (reading, clean) in enumerate(zip(recording.readings, recording.clean, strict=True)):
            (asked if index in query else given).update((round(float(reading.value.sum()), 9),
                                                         round(float(clean.sum()), 9)))
    assert len(seen & given) >= 8, "the search finds the readings that a method was given"
    assert not seen & (asked - given - {0.0})
    assert scores == honest


def test_overwritten_arrays_are_copies(attack, honest):
    scores, found = attack("Overwrites")
    assert found and not any(found), "read-only"
    assert scores == honest


@pytest.mark.parametrize("name", ["ReplacesScorer", "hostile_import:ReplacesAtImport"])
def test_a_replaced_scorer_scores_nothing(attack, honest, name):
    assert attack(name)[0] == honest


def test_prints_go_to_a_log_beside_the_result_which_is_no_file_of_the_users(task, toy_dataset, tmp_path, capfd):
    (tmp_path / "mine.log").write_text("notes of an experiment\n")
    evaluate("hostile_methods:Prints", task, toy_dataset, out=tmp_path / "mine.json", seeds=1, check=False)
    assert capfd.readouterr() == ("", "")
    assert (tmp_path / "mine.json.log").read_text().count("I am rank 1\nfrom a shell\n") == 8
    assert (tmp_path / "mine.log").read_text() == "notes of an experiment\n"


@pytest.mark.parametrize(("name", "parameters", "limits", "message"), [
    ("Sleeps", {}, {"timeout": 2.0}, r"predict for .* took longer than 2 s; --timeout is 2 s a call"),
    ("Allocates", {"gib": 4.0}, {"memory": 2.0}, r"Error in predict for .*may allocate 2 GiB \(--memory\)"),
    ("Exits", {}, {}, "the method raised SystemExit in predict for mock-0001-v0, 0-shot, seed 0"),
    ("Dies", {}, {}, r"the method's process ended in predict for .*\(exit code 0\)"),
    ("Crashes", {}, {}, r"the method's process ended in predict for .*\(Segmentation fault\)"),
    ("AnswersText", {}, {}, r"prediction for touch \d+ of .* is no array of real numbers: its dtype is <U3"),
    ("AnswersHuge", {}, {}, r"is 1e\+308 in frame 0; no reading is over 1e\+12"),
    ("StiffnessIsAList", {}, {}, "must return an Estimate with a mean and a std; it returned list"),
    ("Forges", {}, {"timeout": 60.0}, "the method's process gave no answer in predict for"),
])
def test_a_method_that_breaks_is_a_mistake_in_the_input(task, toy_dataset, name, parameters, limits, message):
    with pytest.raises(MethodError, match=message):
        evaluate(f"hostile_methods:{name}", task, toy_dataset, seeds=1, parameters=parameters, check=False, **limits)


def test_the_contract_is_tested_first(task, toy_dataset):
    with pytest.raises(MethodError, match=r"toy_methods:SwallowsNan does not keep the contract of a method: refuses a "
                                          "reading that is not a number: .* `vsfsim check toy_methods:SwallowsNan`"):
        evaluate("toy_methods:SwallowsNan", task, toy_dataset)
    with pytest.raises(MethodError, match="a parameter cannot be written into a result file"):
        evaluate("hostile_methods:NotPlain", task, toy_dataset)


def test_workers_give_the_same_result(task, toy_dataset):
    one, two = (evaluate("toy_methods:Seeded", task, toy_dataset, workers=n, check=False)
                for n in (1, 2))
    assert one.queries == two.queries and one.scores == two.scores and one.answers == two.answers


def test_what_a_method_learned_reaches_each_trial_as_a_copy(attack, honest):
    """Pickled, or by its save and load."""
    for name in ("Learns", "LearnsUnpicklable"):
        scores, found = attack(name, brief=True)
        assert scores == {metric: {shot: by_shot[shot] for shot in ("0", "all")} for metric, by_shot in honest.items()}
        assert len({pid for pid, _ in found}) == 4 and all(learned == 1 for _, learned in found)


def test_what_can_neither_be_pickled_nor_saved_is_refused(attack):
    with pytest.raises(MethodError, match=r"handed to its trials: it cannot be pickled .* save\(\) and load\(\)"):
        attack("Unsaved", brief=True)


@pytest.mark.parametrize(("given", "training", "trial"), [
    ({}, "0", "0"), ({"device": "cpu"}, "", ""), ({"device": "cuda:0", "host": True}, "0", "")])
def test_a_method_sees_no_gpu_where_it_is_to_use_none(attack, monkeypatch, given, training, trial):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    _, found = attack("Device", brief=True, **given)
    assert found == [training] + [trial] * 4


def test_wrong_limits_are_refused():
    for words, message in (({"sandbox": "docker"}, "--sandbox is 'docker'"), ({"timeout": 0.0}, "--timeout is 0.0"),
                           ({"memory": float("nan")}, "--memory is nan"), ({"workers": 0}, "--workers is 0")):
        with pytest.raises(MethodError, match=message):
            Isolation(**words)
    assert "VSFSIM_DATASETS" not in limits.environment({"VSFSIM_DATASETS": "x", "HOME": "y"})
