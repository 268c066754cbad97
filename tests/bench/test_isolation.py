"""Every known way to reach the truth or the scorer from a method, and every way in which a method can break."""

import json
import math

import pytest

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.isolation import limits, process
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.bench.protocol import divide, record
from vsfsim.core.errors import MethodError


@pytest.fixture(scope="module")
def trial(one_trial):
    """Makes a trial of one class of `hostile_methods`."""
    with one_trial("hostile_methods:named", Isolation(timeout=5.0, memory=2.0)) as make:
        yield lambda name, label="5", **variables: make(label, CLASS=name, **variables)


@pytest.fixture
def reported(trial, tmp_path):
    """Makes a trial of a method that answers as an honest one does; returns what it reported."""
    def run(name, label="5", **variables):
        answers = trial(name, label, REPORT=str(tmp_path / "report"), **variables)
        assert all((reading == 1.5).all() for reading in answers.readings)
        return [json.loads(line) for line in (tmp_path / "report").read_text().splitlines()]

    return run


def test_no_frame_of_a_caller_holds_the_truth(reported):
    (names,) = reported("ReadsFrames")
    assert "vsfsim.bench.isolation.child._Server" in names, "the frames were looked through"
    assert not [name for name in names if name.rpartition(".")[2] in ("Truth", "ObjectView", "Recording", "Dataset",
                                                                      "Subject")]


def test_no_object_in_memory_holds_the_truth_or_a_query_reading(reported, task, toy_views):
    """A reading that is asked is found nowhere in the process, with or without the sensor's noise."""
    (found,) = reported("ReadsMemory", "all")
    assert found["kinds"] == []
    seen, asked, given = {round(value, 9) for value in found["readings"]}, set(), set()
    query, recording = divide(toy_views[1], task.protocol).query, record(toy_views[1], task)
    for index, (reading, clean) in enumerate(zip(recording.readings, recording.clean, strict=True)):
        (asked if index in query else given).update((round(float(reading.value.sum()), 9),
                                                     round(float(clean.sum()), 9)))
    assert len(seen & given) >= 8, "the search finds the readings that a method was given"
    assert not seen & (asked - given - {0.0})


def test_overwritten_arrays_are_copies_and_read_only(reported, trial):
    found = reported("Overwrites")
    assert found and not any(found)
    assert trial("Constant").readings[0].tolist() == [[1.5]] * 12, "the next trial has the arrays as they were"


@pytest.mark.parametrize("name", ["hostile_methods:ReplacesScorer", "hostile_import:ReplacesAtImport"])
def test_a_replaced_scorer_scores_nothing(task, toy_dataset, honest, name):
    assert evaluate(name, task, toy_dataset, seeds=1, check=False).scores == honest


def test_prints_go_to_a_log_beside_the_result_which_is_no_file_of_the_users(task, toy_dataset, tmp_path, capfd):
    (tmp_path / "mine.log").write_text("notes of an experiment\n")
    evaluate("hostile_methods:Prints", task, toy_dataset, out=tmp_path / "mine.json", seeds=1, check=False)
    assert capfd.readouterr() == ("", "")
    assert (tmp_path / "mine.json.log").read_text().count("I am rank 1\nfrom a shell\n") == 8
    assert (tmp_path / "mine.log").read_text() == "notes of an experiment\n"


@pytest.mark.parametrize(("name", "message"), [
    ("Sleeps", r"predict for .* took longer than 5 s; --timeout is 5 s a call"),
    ("Answers np.ones(1 << 29)", r"Error in predict for .*may allocate 2 GiB \(--memory\)"),
    ("Answers sys.exit(0)", "the method raised SystemExit in predict for mock-0001-v0, 5-shot, seed 0"),
    ("Answers os._exit(0)", r"the method's process ended in predict for .*\(exit code 0\)"),
    ("Answers os.kill(os.getpid(), 11)", r"the method's process ended in predict for .*\(Segmentation fault\)"),
    ("Answers [np.full((12, 1), '1.5')] * 4", r"for touch \d+ of .* is no array of real numbers: its dtype is <U3"),
    ("Answers [np.ma.masked_all((12, 1))] * 4", r"for touch \d+ of mock-0001-v0, 5-shot, seed 0 is nan in frame 0"),
    ("Answers [np.full((12, 1), 1e308)] * 4", r"is 1e\+308 in frame 0; .* no reading is over 1e\+12"),
    ("Stiffness toy_methods.Estimate(np.append(points[1:, 0], np.nan), points[:, 0])", "must be a finite mean a point"),
    ("Stiffness [1.0] * len(points)", "must return an Estimate with a mean and a std; it returned list"),
    ("Forges", "the method's process gave no answer in predict for"),
    ("Unpicklable", r"handed to its trials: it cannot be pickled .* __getstate__\(\) and __setstate__\(\)"),
    ("Flat", r"has shape \(12,\); it must be \(T, d\) = \(12, 1\)"),
    ("Crashes", "raised KeyError in adapt to mock-0001-v0, 5-shot, seed 0"),
])
def test_a_method_that_breaks_is_a_mistake_in_the_input(trial, name, message):
    name, _, code = name.partition(" ")
    with pytest.raises(MethodError, match=message):
        trial(name, CODE=code)


def test_of_what_is_printed_the_first_part_is_kept(one_trial, monkeypatch):
    monkeypatch.setattr(process, "LARGEST_LOG", 1 << 20)
    with one_trial("hostile_methods:PrintsMuch", Isolation(), count=40) as make:
        assert make("0").readings[0].tolist() == [[1.5]] * 12
        assert make.log.stat().st_size == 1 << 20


def test_the_contract_is_tested_first(task, toy_dataset):
    with pytest.raises(MethodError, match=r"toy_methods:SwallowsNan does not keep the contract of a method: refuses a "
                                          "reading that is not a number: .* `vsfsim check toy_methods:SwallowsNan`"):
        evaluate("toy_methods:SwallowsNan", task, toy_dataset)
    with pytest.raises(MethodError, match="a parameter cannot be written into a result file"):
        evaluate("hostile_methods:NotPlain", task, toy_dataset)


def test_what_a_method_learned_reaches_each_trial_as_a_copy(reported):
    found = reported("Learns", "0 5")
    assert len({pid for pid, _ in found}) == 2 and [learned for _, learned in found] == [0, 0]


@pytest.mark.parametrize(("given", "training", "trial"), [
    ({}, "0", "0"), ({"device": "cpu"}, "", ""), ({"device": "cuda:0", "host": True}, "0", "")])
def test_a_method_sees_no_gpu_where_it_is_to_use_none(one_trial, monkeypatch, tmp_path, given, training, trial):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    with one_trial("hostile_methods:Device", Isolation(), **given) as make:
        make("0", REPORT=str(tmp_path / "report"))
    assert [json.loads(line) for line in (tmp_path / "report").read_text().splitlines()] == [training, trial]


def test_wrong_limits_are_refused():
    for words, message in (({"sandbox": "docker"}, "--sandbox is 'docker'"), ({"timeout": 0.0}, "--timeout is 0.0"),
                           ({"memory": math.nan}, "--memory is nan")):
        with pytest.raises(MethodError, match=message):
            Isolation(**words)
    assert "VSFSIM_DATASETS" not in limits.environment({"VSFSIM_DATASETS": "x", "HOME": "y"})
