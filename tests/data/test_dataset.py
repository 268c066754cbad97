"""The folder: resume, refusal of another recipe, locks, a full disk, and what verify finds."""

import dataclasses
import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
import tracemalloc
from pathlib import Path

import h5py
import numpy as np
import pytest
from filelock import FileLock
from mock_dataset import contents, recipe_of, write

from vsfsim.bench.mock import mock_view
from vsfsim.core.errors import DatasetError
from vsfsim.core.system.file_lock import take
from vsfsim.data import writer as writer_module
from vsfsim.data.dataset import Dataset
from vsfsim.data.verify import summary_rows, verify
from vsfsim.data.writer import DatasetWriter

VIEWS = [mock_view(i, split="train" if i < 2 else "test", touches=4) for i in range(3)]
RECIPE = recipe_of(VIEWS, scene_text='name = "mock"\nseed = 1\n')
NAMES = [view.name for view in VIEWS]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """A whole dataset, which nothing changes."""
    return write(tmp_path_factory.mktemp("built") / "d", VIEWS, scene_text=RECIPE.scene_text).path


@pytest.fixture
def made(built, tmp_path):
    """A copy of it in the test's own folder."""
    return Path(shutil.copytree(built, tmp_path / "d"))


def test_sigkill_at_any_moment_then_rerun_gives_the_same_bits(built, tmp_path):
    script = tmp_path / "run.py"
    script.write_text(textwrap.dedent(f"""
        import sys, time
        sys.path[:0] = {[str(p) for p in Path(__file__).parents[:2]]!r}
        from test_dataset import NAMES, RECIPE, VIEWS, DatasetWriter
        with DatasetWriter(sys.argv[1], RECIPE, NAMES) as writer:
            print("begun", flush=True)
            for view in VIEWS:
                if view.name in writer.missing():
                    writer.add(view)
                    print("added", flush=True)
                    time.sleep(float(sys.argv[2]))
            writer.finish()
    """))
    out = tmp_path / "killed"
    for lines in (1, 2):  # killed after it began, then after one more file
        process = subprocess.Popen([sys.executable, str(script), str(out), "30"], stdout=subprocess.PIPE)
        for _ in range(lines):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        process.wait()
    assert (out / "dataset.lock").exists() and not (out / "dataset.json").exists()
    (out / f"{NAMES[2]}.h5.123.part").write_bytes(b"half")
    with pytest.raises(DatasetError, match="unfinished"):
        Dataset.open(out)
    before = (out / f"{NAMES[0]}.h5").stat().st_mtime_ns
    with DatasetWriter(out, RECIPE, NAMES) as writer:
        assert any("died" in note for note in writer.notes)
    subprocess.run([sys.executable, str(script), str(out), "0"], check=True, stdout=subprocess.DEVNULL)
    assert (out / f"{NAMES[0]}.h5").stat().st_mtime_ns == before, "a whole file was made again"
    assert contents(out) == contents(built)


def test_a_finished_dataset_is_left_alone_and_repaired_if_damaged(made):
    """Also one whose writer was killed between the manifest and the last clean-up."""
    before = contents(made)
    (made / "dataset.part.json").write_text("{}")
    (made / "dataset.lock").write_text("123")
    assert {problem.file for problem in verify(made).problems} == {"dataset.part.json", "dataset.lock"}
    for _ in range(2):
        with DatasetWriter(made, RECIPE, NAMES) as writer:
            assert writer.missing() == [] and "finished already" in writer.notes[-1]
            writer.finish()
        assert contents(made) == before
    (made / f"{NAMES[0]}.h5").write_bytes(b"rot")
    with DatasetWriter(made, RECIPE, NAMES) as writer:
        assert writer.missing() == [NAMES[0]]
        writer.add(VIEWS[0])
        writer.finish()
    assert contents(made) == before


@pytest.mark.parametrize("finished", [True, False])
@pytest.mark.parametrize(("changes", "message"), [
    ({"seed": 1}, "seed 0 there, 1 asked for"),
    ({"scene_text": 'name = "mock"\nseed = 2\n'}, "line 2: 'seed = 1' there, 'seed = 2' asked for"),
])
def test_the_folder_of_another_recipe_is_refused(built, tmp_path, changes, message, finished):
    if finished:
        shutil.copytree(built, tmp_path / "d")
    else:
        DatasetWriter(tmp_path / "d", RECIPE, NAMES).close()
    before = contents(tmp_path / "d")
    with pytest.raises(DatasetError, match=message):
        DatasetWriter(tmp_path / "d", dataclasses.replace(RECIPE, **changes), NAMES)
    assert contents(tmp_path / "d") == before


def test_the_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "movie.part").write_text("x")
    with pytest.raises(DatasetError, match=r"not empty and holds no dataset \(movie.part\)"):
        DatasetWriter(tmp_path, RECIPE, NAMES)
    assert contents(tmp_path) == {"movie.part": b"x"}


def test_files_of_two_versions_of_the_code_are_not_mixed(tmp_path, monkeypatch):
    DatasetWriter(tmp_path / "d", RECIPE, NAMES).close()
    monkeypatch.setattr(writer_module, "made_by", lambda: {"vsfsim": "9.9", "commit": None})
    with pytest.raises(DatasetError, match="begun by other code"):
        DatasetWriter(tmp_path / "d", RECIPE, NAMES)


def test_a_worker_that_outlives_its_killed_parent_does_not_keep_the_lock(tmp_path):
    code = f"""
import os, sys, time
sys.path[:0] = {[str(p) for p in Path(__file__).parents[:2]]!r}
from test_dataset import NAMES, RECIPE, DatasetWriter
writer = DatasetWriter({str(tmp_path / "d")!r}, RECIPE, NAMES)
if os.fork() == 0:
    print(os.getpid(), flush=True)  # only now has it begun, and let go of what is not its own
    time.sleep(20)
    os._exit(0)
time.sleep(20)
"""
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    child = int(parent.stdout.readline())
    try:
        with pytest.raises(DatasetError, match=f"being written by process {parent.pid}"):
            DatasetWriter(tmp_path / "d", RECIPE, NAMES)
        parent.kill()
        parent.wait()
        DatasetWriter(tmp_path / "d", RECIPE, NAMES).close()
        os.kill(child, 0)  # it is still there
    finally:
        os.kill(child, signal.SIGKILL)


def test_full_disk_leaves_nothing_half_written(tmp_path, monkeypatch):
    writer = DatasetWriter(tmp_path / "d", RECIPE, NAMES)

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DatasetError, match=r"No space left on device .*MB were needed.*Free some space"):
        writer.add(VIEWS[0])
    monkeypatch.undo()
    assert sorted(p.name for p in (tmp_path / "d").iterdir()) == ["dataset.lock", "dataset.part.json"]
    writer.close()


def test_finish_refuses_a_gap(tmp_path):
    with DatasetWriter(tmp_path / "d", RECIPE, NAMES) as writer:
        writer.add(VIEWS[0])
        with pytest.raises(DatasetError, match=f"are missing: '{NAMES[1]}', '{NAMES[2]}';"):
            writer.finish()


def test_one_flipped_bit_anywhere_is_found(tmp_path):
    views = [mock_view(i, split="train" if i < 2 else "test", touches=1) for i in range(3)]
    write(tmp_path / "d", views)
    rng = np.random.default_rng(0)
    for file in sorted((tmp_path / "d").iterdir()):
        if file.name == "README.md":
            continue  # people may write on it; it is no part of the content
        whole = file.read_bytes()
        for position in [0, len(whole) - 1, *rng.integers(0, len(whole), 6)]:
            broken = bytearray(whole)
            broken[position] ^= 1 << int(rng.integers(8))
            file.write_bytes(bytes(broken))
            report = verify(tmp_path / "d")
            assert not report.ok and report.problems[0].file == file.name, f"{file.name} byte {position}"
        file.write_bytes(whole)
    assert verify(tmp_path / "d").ok


def rewrite(path, change):
    """Change an object file and the manifest with it, as a wrong writer would have."""
    from vsfsim.data.disk import file_sha256
    from vsfsim.data.manifest import make_manifest

    dataset = Dataset.open(path)
    entry = dataset.entries[0]
    with h5py.File(path / entry.file, "r+") as file:
        change(file)
    entries = (dataclasses.replace(entry, sha256=file_sha256(path / entry.file)), *dataset.entries[1:])
    (path / "dataset.json").write_bytes(make_manifest(dataset.recipe, dataset.made_by, entries))


def replace_data(file, name, data):
    attrs = dict(file[name].attrs)
    del file[name]
    file[name] = data
    file[name].attrs.update(attrs)


@pytest.mark.parametrize(("change", "message"), [
    (lambda f: f.__delitem__("touches/001/force"), "touches/001/force is missing"),
    (lambda f: f.create_dataset("view/extra", data=1), "view/extra is not in the schema"),
    (lambda f: f["view/depth"].attrs.__setitem__("units", "mm"), "@units 'mm'; the schema says 'm'"),
    (lambda f: replace_data(f, "touches/000/time", np.zeros(5)), r"shape \(.*T = "),
    (lambda f: replace_data(f, "touches/000/residual", np.zeros(12, np.float32)),
     "dtype float32; the schema says float64"),
    (lambda f: f["touches/002/force"].__setitem__((3, 1), np.nan),
     r"touches/002/force\[3, 1\] is not finite in frame 3, which is marked converged"),
    # frame 6 is below the least force of a contact, where the balance says nothing, frame 7 above
    (lambda f: (f["touches/000/audit/force_balance"].__setitem__(slice(6, 8), 0.01),
                f["touches/000/force"].__setitem__(slice(6, 8), [[0.0, 0.0, 0.9e-3], [0.0, 0.0, 1.1e-3]])),
     "touches/000 frame 7: force and reaction differ by 1.0e-02"),
    (lambda f: f.attrs.__setitem__("split", "other"), "says split = 'other'"),
])
def test_verify_names_what_is_wrong(made, change, message):
    rewrite(made, change)
    report = verify(made)
    assert re.search(message, report.text()), report.text()
    assert report.problems[0].file == f"{NAMES[0]}.h5" and report.problems[0].todo


def test_verify_finds_missing_and_foreign_files(made):
    (made / f"{NAMES[0]}.h5").unlink()
    (made / "notes.txt").write_text("x")
    text = verify(made).text()
    assert f"{NAMES[0]}.h5: is missing" in text and "notes.txt: is not listed" in text


def test_unconverged_frames_are_counted_not_complained_about(tmp_path):
    touch = VIEWS[0].touches[0]
    converged, force = touch.converged.copy(), touch.force.copy()
    converged[4:6], force[4:6] = False, np.nan
    view = dataclasses.replace(VIEWS[0], touches=(dataclasses.replace(touch, converged=converged, force=force),
                                                  *VIEWS[0].touches[1:]))
    write(tmp_path / "d", [view, *VIEWS[1:]])
    report = verify(tmp_path / "d")
    assert report.ok and report.unconverged == 2


def test_a_good_dataset_has_no_problems_and_its_summary_tells_the_main_figures(built):
    report, told = verify(built), dict(summary_rows(built))
    assert (report.files, report.touches, report.untouched, report.unconverged) == (3, 12, 3, 0)
    assert report.ok, report.text()
    assert told["objects"] == "3 in 3 views: 2 train, 1 test" and told["touches"] == "12, 3 met nothing"
    top = max(t.normal_force().max() for v in VIEWS for t in v.touches)
    assert told["normal force"].startswith(f"0 to {top:.3g} N")
    stiff = np.concatenate([v.truth.young_modulus[v.truth.region == 1] for v in VIEWS])
    assert told["  stiff"] == f"{stiff.min():.3g} to {stiff.max():.3g} Pa"


def test_a_file_that_is_open_in_another_program_is_not_called_damaged(made):
    entry = Dataset.open(made).entries[0].file
    hold = ("import h5py, sys; file = h5py.File(sys.argv[1], 'r+', locking=True); print('open', flush=True); "
            "sys.stdin.read()")
    other = subprocess.Popen([sys.executable, "-c", hold, str(made / entry)], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "open\n"
        (problem,) = verify(made).problems
        with pytest.raises(DatasetError, match=r"cannot be opened: .*Close it in the program"):
            list(Dataset.open(made))
    finally:
        other.communicate()
    assert problem.file == entry and "elete" not in problem.todo and "Close it" in problem.todo
    assert verify(made).ok


def test_a_dataset_larger_than_memory_is_read_a_few_views_at_a_time(tmp_path):
    """Reading ten views takes the memory of those that a process keeps, `KEPT`, and of the one it reads."""
    pytest.importorskip("torch")
    from vsfsim.data.torch_view import KEPT

    dataset = write(tmp_path / "d", [mock_view(i, split="train", touches=2) for i in range(10)])

    def peak(count):
        touches = dataset[:count].torch()
        tracemalloc.start()
        for k in range(len(touches)):
            assert touches[k]["force"].shape[1] == 3
        size = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return size

    peak(1)  # what is imported stays
    one, few, whole = peak(1), peak(KEPT + 1), peak(10)
    assert one < 0.7 * few and whole < 1.2 * few


def test_without_locks_an_owner_is_refused_and_a_shard_goes_on(tmp_path, monkeypatch):
    """On a file system without locks two owners would write one file; a shard's files are its own."""
    def fails(lock):  # as a system does after it has made the file
        Path(lock.lock_file).touch()
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(FileLock, "acquire", fails)
    with pytest.raises(DatasetError, match=r"without locks.*Choose another --out, on a local disk"):
        take(tmp_path / "owner.lock", tmp_path, DatasetError, needed=True)
    assert take(tmp_path / "shard.lock", tmp_path, DatasetError)[1] == ""
