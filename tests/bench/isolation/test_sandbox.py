"""What a method cannot reach or leave behind, in every sandbox that works here."""

import os
import subprocess
import sys
import time

import hostile_methods  # noqa: F401
import pytest

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.isolation import container, namespaces
from vsfsim.bench.isolation.limits import Isolation
from vsfsim.core.errors import MethodError

BOXES = [name for name in container.SANDBOXES if container.works(name)]
CONTAINERS = [name for name in BOXES if name != "process"]


def run(name, task, dataset, box, *, seeds=1, check=False, timeout=None, **parameters):
    return evaluate(f"hostile_methods:{name}", task, dataset, seeds=seeds, check=check, parameters=parameters,
                    isolation=Isolation(box, timeout))


@pytest.fixture(scope="module")
def honest(task, toy_dataset):
    return evaluate("toy_methods:Constant", task, toy_dataset, seeds=1, check=False,
                    isolation=Isolation("process")).scores


def gone(pid):
    until = time.monotonic() + 10.0
    while time.monotonic() < until:
        try:
            if open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[0] in "ZX":
                return True
        except OSError:
            return True
        time.sleep(0.02)
    return False


@pytest.mark.parametrize("box", BOXES)
def test_a_method_scores_the_same_in_every_sandbox_and_the_row_says_which(task, toy_dataset, honest, box):
    found = evaluate("toy_methods:Constant", task, toy_dataset, seeds=1, isolation=Isolation(box))
    assert found.scores == honest and found.isolation == box


def test_what_has_left_its_session_ends_with_the_trial(task, toy_dataset, tmp_path):
    run("LeavesSession", task, toy_dataset, "process", report=str(tmp_path / "pids"))
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert len(pids) == 8 and all(map(gone, pids))


@pytest.mark.parametrize("box", BOXES)
def test_no_note_passes_over_an_abstract_socket(task, toy_dataset, honest, box):
    assert run("TalksOnSocket", task, toy_dataset, box, seeds=1).scores == honest


def test_a_trial_that_times_out_leaves_nothing_behind(task, toy_dataset, tmp_path):
    with pytest.raises(MethodError, match="took longer than the 2 s"):
        run("LeavesAndSleeps", task, toy_dataset, "process", timeout=2.0, report=str(tmp_path / "pids"))
    pids = [int(line) for line in (tmp_path / "pids").read_text().split()]
    assert pids and all(map(gone, pids))


@pytest.mark.parametrize("box", BOXES)
def test_no_other_process_can_be_attached_to_nor_its_folder_be_read(task, toy_dataset, honest, box, monkeypatch):
    monkeypatch.chdir(toy_dataset.path.parent)
    assert run("Peeks", task, toy_dataset, box, looks_for=toy_dataset.path.name).scores == honest


@pytest.mark.parametrize("box", CONTAINERS)
def test_a_container_shows_what_a_parameter_names_and_not_the_dataset(task, toy_dataset, tmp_path, box):
    (tmp_path / "weights").write_text("1")
    run("NeedsFile", task, toy_dataset, box, path=str(tmp_path / "weights"))
    with pytest.raises(MethodError, match=r"FileNotFoundError in .*It runs in a container \(--sandbox "):
        run("NeedsPart", task, toy_dataset, box, folder=str(toy_dataset.path.parent), file=toy_dataset.entries[1].file)


def test_the_default_is_the_strongest_that_works(monkeypatch):
    monkeypatch.delenv("VSFSIM_SANDBOX")
    assert Isolation().sandbox == container.strongest() == BOXES[0]
    monkeypatch.setattr(container, "works", lambda name: name == "process")
    assert Isolation().sandbox == "process"
    with pytest.raises(MethodError, match=r"--sandbox namespaces does not work here: .* strongest one that works: "
                                          "process"):
        Isolation("namespaces")


@pytest.mark.skipif(not os.path.exists("/proc/self/ns/user"), reason="no Linux namespaces")
def test_the_time_limit_is_that_of_one_call_in_the_check_too(task, toy_dataset):
    start = time.monotonic()
    with pytest.raises(MethodError, match=r"adapt in the check of its contract took longer than the 3 s of --timeout"):
        run("SleepsInCheck", task, toy_dataset, "process", check=True, timeout=3.0)
    assert time.monotonic() - start < 20.0


@pytest.mark.parametrize("box", BOXES)
def test_a_gigabyte_of_prints_is_named(task, toy_dataset, tmp_path, box):
    with pytest.raises(MethodError, match=r"has printed more than 64 MiB, the last of it in predict for mock-0001-v0"):
        evaluate("hostile_methods:PrintsMuch", task, toy_dataset, seeds=1, check=False, isolation=Isolation(box),
                 log=tmp_path / "log")
    assert (tmp_path / "log").stat().st_size <= 64 << 20


@pytest.mark.parametrize(("name", "entry"), [("gaussian", "vsfsim.baselines.gaussian:GaussianAverage"),
                                             ("own:Own", "own:Own")])
@pytest.mark.parametrize("box", CONTAINERS)
def test_a_container_shows_packages_that_no_folder_of_the_path_holds(box, name, entry, tmp_path, monkeypatch):
    """An "editable" installation is found by an import hook, and a user works somewhere else."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text("class Own:\n    def meta_fit(self, specimens): ...\n"
                                     "    def adapt(self, view, support): ...\n    def predict(self, touches): ...\n")
    code = ("from vsfsim.bench.isolation.process import MethodProcess\n"
            "from vsfsim.bench.isolation.limits import Isolation\n"
            f"from pathlib import Path\nwith MethodProcess({name!r}, {{}}, Isolation({box!r}), Path('log')) as one:\n"
            "    print(one.description.entry)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.stdout.strip() == entry, done.stderr


def test_a_remount_repeats_each_lock_of_a_mount_and_adds_none():
    """Flags that statvfs tells, in the words of mount(2); the kernel refuses a remount that drops one."""
    relatime = 1 << 21  # MS_RELATIME of mount(2), which statvfs has elsewhere
    assert namespaces._LOCKED == {os.ST_NOSUID: namespaces._NOSUID, os.ST_NODEV: namespaces._NODEV,
                                  os.ST_NOEXEC: namespaces._NOEXEC, os.ST_NOATIME: os.ST_NOATIME,
                                  os.ST_NODIRATIME: os.ST_NODIRATIME, os.ST_RELATIME: relatime}
