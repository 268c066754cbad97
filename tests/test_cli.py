"""The command line as a user meets it: fast help, exit codes, one-paragraph errors."""

import re
import signal
import subprocess
import sys
import time

import pytest

from vsfsim.cli.console import Progress

HEAVY = ("warp", "torch", "mujoco", "numpy", "scipy", "h5py", "trimesh", "matplotlib", "rich")


def test_help_imports_nothing_heavy():
    code = f"""
import sys
sys.argv = ["vsfsim", "--help"]
from vsfsim.cli.main import main
try:
    main()
finally:
    print("HEAVY", [name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 0 and "evaluate" in out.stdout and "bench " not in out.stdout
    assert "HEAVY []" in out.stderr
    commands = out.stdout.split("Commands:")[1]
    assert "..." not in commands, "the list of commands has whole sentences"
    first, more = (re.findall(r"^  ([a-z]+)  ", part, re.M) for part in commands.split("More, for authors"))
    assert first == ["press", "generate", "show", "list", "evaluate", "submit"] and len(more) <= 8


@pytest.mark.parametrize(("words", "message"), [
    (("view", "pad"), "`vsfsim view` is now `vsfsim show --out page.html`."),
    (("evalute",), "unknown command 'evalute'. Did you mean 'evaluate'?"),
    (("evaluate", "--method", "gausian", "--task", "fewshot-shoes-v3-mini-v1"),
     "unknown method 'gausian'. Did you mean 'gaussian'?"),
    (("evaluate", "--method", "gaussian", "--task", "fewshot-shoes-v3-v1"), "vsfsim generate shoes-v3 --objects"),
    (("cluster", "--shard", "0/4", "press", "pad"), "The command of `vsfsim cluster` is 'press'."),
])
def test_a_mistake_is_one_paragraph_and_exit_code_2(vsfsim, words, message, tmp_path):
    out = vsfsim(*words, cwd=tmp_path)
    assert out.returncode == 2, out.stderr
    assert out.stderr.startswith("error: ") and message in out.stderr
    assert "Traceback" not in out.stderr and out.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_the_time_that_is_left_follows_from_what_was_done(monkeypatch, capsys):
    clock = iter((100.0, 100.0, 104.0))
    monkeypatch.setattr("vsfsim.cli.console.time.perf_counter", lambda: next(clock))
    progress = Progress("press", interval=0.0)
    progress(0, 10, "frames")
    progress(2, 10, "frames")
    assert capsys.readouterr().err.splitlines()[-1] == "press: 2/10 frames, 16 s left"


def test_a_bug_keeps_its_traceback_and_says_that_it_is_one(tmp_path):
    code = ("import sys; sys.argv = ['vsfsim', 'list', 'methods']; import vsfsim.core.shelf as s; "
            "s.methods = lambda: 1 / 0; from vsfsim.cli.main import main; main()")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 1 and "ZeroDivisionError" in out.stderr and "this is a bug in vsfsim" in out.stderr


def test_a_method_that_cannot_be_imported_is_named_without_a_traceback(vsfsim, tmp_path):
    (tmp_path / "broken.py").write_text("1 / 0")
    out = vsfsim("check", "broken:X", cwd=tmp_path)
    assert out.returncode == 2 and "ZeroDivisionError" in out.stderr and "Traceback" not in out.stderr


@pytest.mark.parametrize(("words", "found"), [
    (("press", "indent", "--tier", "fine"), "fem-fine"),
    (("generate", "shoes-mini", "--tier", "FEM"), "--tier is 'FEM'. Did you mean 'fem'?"),
    (("press", "scan.toml"), "mesh file 'none.stl' cannot be read"),
    (("press", "probe.toml"), "mesh file 'none.txt' ends in '.txt'"),
    (("show", "scan.toml"), "mesh file 'none.stl' cannot be read")])
def test_a_wrong_tier_and_a_wrong_path_are_told_before_the_simulator_is_imported(words, found, tmp_path):
    soft = "young_modulus = 1e5\npoisson_ratio = 0.3\n"
    (tmp_path / "scan.toml").write_text('[object]\nshape = { mesh = "none.stl" }\n' + soft)
    (tmp_path / "probe.toml").write_text('[object]\nshape = { sphere = 0.1 }\n' + soft +
                                         '[probe]\nshape = { mesh = "none.txt" }\n')
    code = ("import sys; from vsfsim.cli.main import main\ntry:\n    main()\nfinally:\n    assert not "
            "{'warp', 'torch', 'scipy'} & set(sys.modules)")
    out = subprocess.run([sys.executable, "-c", code, *words], cwd=tmp_path, capture_output=True, text=True)
    assert out.returncode == 2 and found in out.stderr, out.stderr


@pytest.mark.parametrize("after", [0.05, 0.8])
def test_ctrl_c_ends_in_one_line_also_while_libraries_are_imported(after, tmp_path):
    running = subprocess.Popen([sys.executable, "-c", "from vsfsim.cli import start; print('on', flush=True); start()",
                                "press", "indent"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                               text=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    assert running.stdout.readline() == "on\n"
    time.sleep(after)
    running.send_signal(signal.SIGINT)
    _, said = running.communicate(timeout=120)
    assert running.returncode == 130 and "Traceback" not in said and len(said.strip().splitlines()) == 1, said
