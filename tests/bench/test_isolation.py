"""Every known way to reach the truth or the scorer from a method, and every way in which a method can break."""

import dataclasses
import json
import os
import time

import pytest

from vsfsim.bench.evaluate import evaluate, finish
from vsfsim.bench.isolation import child, limits
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
    def run(name, *, seeds=1, isolation=None, brief=False, **parameters):
        report = tmp_path / "report"
        report.unlink(missing_ok=True)
        shots = (0,) if brief else task.protocol.shots
        asked = dataclasses.replace(task, protocol=dataclasses.replace(task.protocol, shots=shots))
        result = evaluate(name if ":" in name else f"hostile_methods:{name}", asked, toy_dataset, seeds=seeds,
                          check=False, isolation=isolation or Isolation(),
                          parameters={"report": str(report), **parameters})
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


def test_nothing_lies_in_its_folder_and_nothing_in_its_environment(attack, honest, monkeypatch, toy_dataset):
    monkeypatch.chdir(toy_dataset.path.parent)
    monkeypatch.setenv("VSFSIM_DATASETS", str(toy_dataset.path.parent))
    scores, found = attack("OpensFiles")
    assert all(one == {"here": [], "below": [], "environment": []} for one in found) and found
    assert scores == honest


def test_overwritten_arrays_are_copies(attack, honest):
    scores, found = attack("Overwrites")
    assert found and not any(found), "read-only"
    assert scores == honest


@pytest.mark.parametrize("name", ["ReplacesScorer", "hostile_import:ReplacesAtImport"])
def test_a_replaced_scorer_scores_nothing(attack, honest, name):
    assert attack(name)[0] == honest


def test_nothing_passes_from_trial_to_trial(attack):
    _, found = attack("Remembers", seeds=2)
    assert {line[0] for line in found} == {0, 1, 5, 8}
    assert all(line[1:] == [0, 0, 0, 0] for line in found)


def test_a_process_that_a_trial_leaves_behind_is_ended(attack):
    _, found = attack("Lingers")
    assert len(found) == 8
    for pid in found:
        until = time.monotonic() + 20.0
        while _runs(pid) and time.monotonic() < until:
            time.sleep(0.05)
        assert not _runs(pid)


def _runs(pid):
    try:
        return open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def test_prints_go_to_the_log(task, toy_dataset, tmp_path, capfd):
    evaluate("hostile_methods:Prints", task, toy_dataset, seeds=1, check=False, log=tmp_path / "log")
    assert capfd.readouterr() == ("", "")
    assert (tmp_path / "log").read_text().count("I am rank 1\nfrom a shell\n") == 8


def test_the_log_beside_a_result_is_no_file_of_the_users(task, toy_dataset, tmp_path):
    (tmp_path / "mine.log").write_text("notes of an experiment\n")
    finish("hostile_methods:Prints", task, toy_dataset, tmp_path / "mine.json", seeds=1, check=False)
    assert (tmp_path / "mine.json.log").read_text().count("I am rank 1\nfrom a shell\n") == 8
    assert (tmp_path / "mine.log").read_text() == "notes of an experiment\n"


@pytest.mark.parametrize(("name", "parameters", "isolation", "message"), [
    ("Sleeps", {}, Isolation(timeout=2.0), r"predict for .* took longer than the 2 s of --timeout"),
    ("Allocates", {"gib": 4.0}, Isolation(memory=2.0), r"Error in predict for .*may allocate 2 GiB \(--memory\)"),
    ("Exits", {}, Isolation(), "the method raised SystemExit in predict for mock-0001-v0, 0-shot, seed 0"),
    ("Dies", {}, Isolation(), r"the method's process ended in predict for .*\(exit code 0\)"),
    ("Crashes", {}, Isolation(), r"the method's process ended in predict for .*\(SIGSEGV\)"),
    ("AnswersText", {}, Isolation(), r"prediction for touch \d+ of .* is no array of real numbers: its dtype is <U3"),
    ("AnswersComplex", {}, Isolation(), "is no array of real numbers: its dtype is complex128"),
    ("AnswersHuge", {}, Isolation(), r"is 1e\+308 in frame 0; no reading is over 1e\+12"),
    ("StiffnessIsAList", {}, Isolation(), "must return an Estimate with a mean and a std; it returned list"),
    ("StiffnessIsText", {}, Isolation(), "has a mean that is not an array of real numbers"),
    ("Forges", {}, Isolation(timeout=60.0), "the method's process gave no answer in predict for"),
])
def test_a_method_that_breaks_is_a_mistake_in_the_input(task, toy_dataset, name, parameters, isolation, message):
    with pytest.raises(MethodError, match=message):
        evaluate(f"hostile_methods:{name}", task, toy_dataset, seeds=1, parameters=parameters, isolation=isolation,
                 check=False)


def test_memory_within_the_limit_is_allocated(task, toy_dataset):
    evaluate("hostile_methods:Allocates", task, toy_dataset, seeds=1, parameters={"gib": 0.2},
             isolation=Isolation(memory=2.0), check=False)


def test_the_contract_is_tested_first(task, toy_dataset):
    with pytest.raises(MethodError, match=r"toy_methods:SwallowsNan does not keep the contract of a method: refuses a "
                                          "reading that is not a number: .* `vsfsim check toy_methods:SwallowsNan`"):
        evaluate("toy_methods:SwallowsNan", task, toy_dataset)
    with pytest.raises(MethodError, match="a parameter of hostile_methods:NotPlain cannot be written"):
        evaluate("hostile_methods:NotPlain", task, toy_dataset)


def test_workers_give_the_same_result(task, toy_dataset):
    one, two = (evaluate("toy_methods:Seeded", task, toy_dataset, isolation=Isolation(workers=n), check=False)
                for n in (1, 2))
    assert one.queries == two.queries and one.scores == two.scores and one.answers == two.answers


def test_where_processes_cannot_be_forked_each_trial_gets_a_copy(task, toy_dataset, attack, honest):
    scores, found = attack("hostile_state:Unforkable", brief=True)
    assert scores == {metric: {shot: by_shot[shot] for shot in ("0", "all")} for metric, by_shot in honest.items()}
    assert len({pid for pid, _, _ in found}) == 4
    assert all(held == 1 for _, _, held in found), "what meta_fit learned is there, and nothing else"


def test_trials_are_forks_of_one_copy_of_what_a_gpu_learned(attack, honest):
    scores, found = attack("hostile_state:LearnsOnGpu", brief=True)
    assert scores == {metric: {shot: by_shot[shot] for shot in ("0", "all")} for metric, by_shot in honest.items()}
    assert len({pid for pid, _, _ in found}) == 4 and len({parent for _, parent, _ in found}) == 1
    assert all(held == 1 for _, _, held in found)


@pytest.mark.parametrize(("host", "visible", "parents"), [(True, "", 1), (False, "0", None)])
def test_trials_are_forks_without_a_gpu_if_the_method_says_that_they_need_none(attack, monkeypatch, host, visible,
                                                                              parents):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    _, found = attack("hostile_state:TrialsOnHost", brief=True, host=host)
    assert len(found) == 4 and {seen for seen, _ in found} == {visible}
    if parents is not None:
        assert len({parent for _, parent in found}) == parents


@pytest.mark.parametrize(("given", "visible", "forked", "gradients"), [
    ({}, "0", 1, 0), ({"device": "cpu"}, "", 1, 1), ({"device": "cuda:0"}, "0", 1, 0),
    ({"device": "cuda:0", "driver": True}, "0", 0, 0)])
def test_a_method_that_is_to_use_no_gpu_sees_none_and_one_that_has_begun_to_use_it_is_not_forked(
        attack, monkeypatch, given, visible, forked, gradients):
    """In a fork a GPU cannot be used if its driver was loaded before, nor a gradient taken where PyTorch has seen one
    before. Where it sees none, the first gradient is taken before the fork: in the fork it would ask the driver for
    GPUs and end by SIGSEGV."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
    _, found = attack("Device", brief=True, **given)
    assert len(found) == 4 and all(one == [visible, forked, gradients] for one in found)


def test_methods_that_ship_use_no_gpu_unless_told_to(monkeypatch):
    for given, visible in (({"device": "cuda:1"}, "0"), ({}, "")):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0")
        child._hide_gpus("grid-vsf", given)
        assert os.environ["CUDA_VISIBLE_DEVICES"] == visible


def test_wrong_limits_are_refused():
    for words, message in (({"sandbox": "docker"}, "--sandbox is 'docker'"), ({"timeout": 0.0}, "--timeout is 0.0"),
                           ({"memory": float("nan")}, "--memory is nan"), ({"workers": 0}, "--workers is 0")):
        with pytest.raises(MethodError, match=message):
            Isolation(**words)
    assert "VSFSIM_DATASETS" not in limits.environment({"VSFSIM_DATASETS": "x", "HOME": "y"})


bubblewrap = pytest.mark.skipif(not os.path.exists("/usr/bin/bwrap"), reason="bubblewrap is not installed")


@bubblewrap
def test_a_container_hides_the_dataset(attack, honest, toy_dataset):
    path = str(toy_dataset.path / toy_dataset.entries[1].file)
    _, found = attack("OpensPath", path=path)
    assert found and all(isinstance(size, int) for size in found), "a process can read the user's files"
    box = Isolation(sandbox="bubblewrap")
    with pytest.raises(MethodError, match="FileNotFoundError"):
        attack("OpensPath", path=path, isolation=box)  # its report has no place in the container either
    scores, _ = attack("OpensPath", path=path, report="", isolation=box)
    assert scores == honest
