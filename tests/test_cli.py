"""The command line as a user meets it: fast help, exit codes, one-paragraph errors."""

import subprocess
import sys

import pytest

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
    assert "..." not in out.stdout.split("Commands:")[1], "the list of commands has whole sentences"


def test_the_old_spelling_of_measure_works_and_names_the_new_one(vsfsim, tmp_path):
    old, new = (vsfsim(name, "solver", "--tier", "fen", cwd=tmp_path) for name in ("bench", "measure"))
    assert old.returncode == new.returncode == 2 and "Did you mean 'fem'?" in new.stderr
    assert old.stderr == "note: `vsfsim bench` is now `vsfsim measure`\n" + new.stderr


@pytest.mark.parametrize(("words", "message"), [
    (("evalute",), "unknown command 'evalute'. Did you mean 'evaluate'?"),
    (("evaluate", "--method", "gausian", "--task", "fewshot-shoes-v3-mini-v1"),
     "unknown method 'gausian'. Did you mean 'gaussian'?"),
    (("evaluate", "--method", "gaussian", "--task", "fewshot-shoe-v3-mini-v1"),
     "unknown task 'fewshot-shoe-v3-mini-v1'. Did you mean 'fewshot-shoes-v3-mini-v1'?"),
    (("check", "gaussian", "--set", "spcing=1"),
     "no parameter 'spcing'. Did you mean 'spacing'?"),
    (("evaluate", "--method", "gaussian", "--task", "fewshot-shoes-v3-mini-v1"),
     "vsfsim generate shoes-v3-mini --objects"),
])
def test_a_mistake_is_one_paragraph_and_exit_code_2(vsfsim, words, message, tmp_path):
    out = vsfsim(*words, cwd=tmp_path)
    assert out.returncode == 2, out.stderr
    assert out.stderr.startswith("error: ") and message in out.stderr
    assert "Traceback" not in out.stderr and out.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_a_bug_keeps_its_traceback_and_says_that_it_is_one(tmp_path):
    code = ("import sys; sys.argv = ['vsfsim', 'methods']; import vsfsim.core.shelf as s; s.methods = lambda: 1 / 0; "
            "from vsfsim.cli.main import main; main()")
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 1 and "ZeroDivisionError" in out.stderr and "this is a bug in vsfsim" in out.stderr


def test_a_method_that_cannot_be_imported_is_named_without_a_traceback(vsfsim, tmp_path):
    (tmp_path / "broken.py").write_text("1 / 0")
    out = vsfsim("check", "broken:X", cwd=tmp_path)
    assert out.returncode == 2 and "ZeroDivisionError" in out.stderr and "Traceback" not in out.stderr
