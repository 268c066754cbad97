"""An evaluation that is stopped keeps its finished seeds and goes on; files are written whole or not at all."""

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import numpy as np
import pytest
from conftest import TASK

from vsfsim.bench.commands.score import score_predictions
from vsfsim.bench.evaluate import evaluate, own
from vsfsim.bench.predictions import questions
from vsfsim.bench.result import Result
from vsfsim.core.errors import MethodError

HERE = Path(__file__).parent
WORDS = ["evaluate", "--method", "slow_method:Slow", "--task", "toy-v1.toml", "--dataset", "toy"]


def start(*words, cwd, **options):
    code = f"import sys; sys.path.insert(0, {str(HERE)!r}); from vsfsim.cli.main import main; main()"
    return subprocess.Popen([sys.executable, "-c", code, *words], cwd=cwd, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, start_new_session=True,
                            # a shell starts what runs in its background, these tests perhaps, with Ctrl-C ignored
                            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
                            env={**os.environ, "PYTHONPATH": f"{HERE}:{os.environ.get('PYTHONPATH', '')}", **options})


@pytest.fixture
def folder(tmp_path, toy_dataset):
    (tmp_path / "toy-v1.toml").write_text(TASK)
    (tmp_path / "toy").symlink_to(toy_dataset.path)
    (tmp_path / "slow_method.py").write_text(
        "import os, time\nfrom toy_methods import Constant\n\n\nclass Slow(Constant):\n"
        "    def __init__(self, *, seed=0):\n        super().__init__()\n\n"
        "    def adapt(self, view, support):\n        super().adapt(view, support)\n"
        f"        if os.path.exists({str(tmp_path / 'slow')!r}):\n            time.sleep(0.2)\n")
    (tmp_path / "slow").touch()
    return tmp_path


def test_a_stopped_evaluation_goes_on(folder):
    parts = folder / "results" / "toy-v1" / "slow_method.Slow.parts"
    process = start(*WORDS, cwd=folder)
    until = time.monotonic() + 120.0
    while not list(parts.glob("*/*00.answers")) and process.poll() is None and time.monotonic() < until:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=60.0)
    assert process.returncode == 130 and "Traceback" not in err, err
    assert "of 3 trainings are finished and kept in" in err and "Run the same command again" in err
    assert not out and sorted(p.name for p in parts.parent.iterdir()) == [parts.name], "no half-written result"
    (first,) = parts.glob("*/*00.answers")
    kept = first.stat().st_mtime_ns
    first.with_name("fold-00-training-02.answers").write_bytes(b"half")  # as a crash of the disk could leave it
    (folder / "slow").unlink()
    process = start(*WORDS, cwd=folder)
    while parts.exists() and process.poll() is None:
        with contextlib.suppress(FileNotFoundError):
            assert first.stat().st_mtime_ns == kept
        time.sleep(0.02)
    out, err = process.communicate(timeout=60.0)
    assert process.returncode == 0 and "written to" in out, err
    found = Result.load(parts.with_suffix(".json"))
    assert not parts.exists() and found.computed() == found.scores and found.seeds == (0, 1, 2)


def header(shape, dtype, spoiled=b"}", more=b""):
    """An .npz whose headers claim more than there is; ``spoiled`` is written over the closing brace of each."""
    def write(path, keys):
        out = io.BytesIO()
        np.lib.format.write_array_header_1_0(out, {"descr": dtype, "fortran_order": False, "shape": shape})
        with zipfile.ZipFile(path, "w") as file:
            for key in keys:
                file.writestr(f"{key}.npy", out.getvalue().replace(b"}", spoiled) + more)
    return write


@pytest.mark.parametrize(("write", "message"), [
    (lambda path, keys: path.write_bytes(b"PK\x03\x04" + bytes(40)), "cannot be read"),
    (lambda path, keys: np.save(path.open("wb"), np.zeros((12, 1))), "cannot be read"),
    (header((5_000_000_000,), "<f8"), "cannot be read: "),
    (header((12, 1), "<f8"), "cannot be read: "),
    (header((12, 1), "<f8", more=bytes(1 << 20)), r"has 1048704 bytes; it must be real numbers of shape .* \(12, 1\)"),
    (header((12, 1), "|O"), "cannot be read: "),
    (header((12, 1), "<U1", more=bytes(48)), "is no array of real numbers"),
    (header((12, 2), "<f8", more=bytes(192)), r"has shape \(12, 2\)"),
    (header((12, 1), "<f8", b" "), "cannot be read: "),  # numpy looks for the end of a Python statement
])
def test_predictions_that_are_not(task, toy_dataset, tmp_path, write, message):
    path = tmp_path / "p.npz"
    write(path, [key for question in questions(task, toy_dataset) for key in question.keys])
    with pytest.raises(MethodError, match=message):
        score_predictions(path, task, toy_dataset, name="x")


def test_the_name_of_a_score_cannot_leave_its_folder(vsfsim, folder, task, toy_dataset):
    answers = {key: np.zeros((len(action.time), 1)) for question in questions(task, toy_dataset)
               for key, action in zip(question.keys, question.actions)}
    np.savez(folder / "p.npz", **answers)
    out = vsfsim("lab", "score", "p.npz", "--task", "toy-v1.toml", "--dataset", "toy", "--name", "../../../x\x1b[2J",
                 cwd=folder)
    assert out.returncode == 0, out.stderr
    (path,) = (folder / "results" / "toy-v1").iterdir()
    assert path.name == "x.2J.json" and "\x1b" not in out.stdout
    assert "\x1b" not in json.loads(path.read_text())["method"]


def test_two_evaluations_do_not_write_one_result(task, toy_dataset, tmp_path):
    """Two that were started by mistake took each other's kept answers, and one removed what the other needed."""
    out = tmp_path / "results" / "mine.json"
    options = {"out": out, "parameters": {"value": 2.0}, "seeds": 1, "check": False}
    with own(out):
        with pytest.raises(MethodError, match=rf"mine\.json' is being written by process {os.getpid()}\. Wait for it"):
            evaluate("toy_methods:Constant", task, toy_dataset, **options)
        assert evaluate("toy_methods:Constant", task, toy_dataset, **{**options, "out": out.with_name("other.json")})
        assert not out.exists()
    evaluate("toy_methods:Constant", task, toy_dataset, **options)
    assert sorted(p.name for p in out.parent.iterdir()) == ["mine.json", "other.json"], "no lock is left behind"


def test_a_lock_of_a_killed_evaluation_holds_nobody_up(tmp_path):
    out = tmp_path / "mine.json"
    (tmp_path / ".mine.json.lock").write_text("4194304\n")
    with own(out):
        pass
    assert not list(tmp_path.iterdir())
