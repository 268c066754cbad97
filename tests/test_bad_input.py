"""Wrong input through the command line: one paragraph, exit code 2, nothing half-written; `--debug` shows the
traceback."""

import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from mock_dataset import TASK, contents, written
from texts import text

HERE = Path(__file__).parent
PATH = "[press]\npath = [[0.0, 0.0, 0.05], [0.0, 0.0, 0.048]]\nframes = 2\n"
BOX = text("small", ("[touches]", PATH + "[touches]"), ("[probe]", 'tier = "linear"\n[probe]'),
           needs=None, name='"box"', young_modulus="1e5", resolution=0.015)
FLAT = "v 0 0 0\nv 0.1 0 0\nv 0.1 0.1 0\nv 0 0.1 0\nf 1 2 3\nf 1 3 4\n"
PRESS, GENERATE = ("press", "box.toml"), ("generate", "box.toml", "--out", "out")
MESH = ('box = [0.06, 0.06, 0.03]', 'mesh = "flat.obj"')
EVALUATE = ("evaluate", "--method", "toy_methods:Constant", "--task", "toy-v1.toml", "--dataset", "toy")


def run(*words, cwd, **options):
    """`vsfsim WORDS` in folder ``cwd``, as a process of its own, with -P like the console script; most tests take the
    fixture ``vsfsim``, which gives the same sooner."""
    env = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(HERE / "bench")}
    # without bytecode, which a limit of the size of files would cut for everybody else
    return subprocess.run([sys.executable, "-PB", "-c", "from vsfsim.cli.main import main; main()", *words],
                          capture_output=True, text=True, cwd=cwd, env=env, stdin=subprocess.DEVNULL, **options)


def assert_refused(out, message):
    """Exit code 2 and one paragraph that holds ``message``."""
    assert out.returncode == 2, out.stdout + out.stderr
    # before it, a run has told how far it is
    said = [line for line in out.stderr.strip().splitlines() if not re.match(r"[a-z]+( \S+)?: \d+/\d+ ", line)]
    assert said[0].startswith("error: ") and message in said[0], out.stderr
    assert len(said) == 1, "more than one paragraph"
    assert out.stdout == "" and "Traceback" not in out.stderr


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """The folder of a mock dataset and of a task on it."""
    written(tmp_path / "toy")
    (tmp_path / "toy-v1.toml").write_text(TASK)
    monkeypatch.syspath_prepend(HERE / "bench")  # of toy_methods
    return tmp_path


@pytest.mark.parametrize(("words", "old", "new", "message"), [
    (PRESS, "young_modulus", "young_modulos",
     "box.toml [object]: unknown key 'young_modulos'. Did you mean 'young_modulus'?"),
    (GENERATE, "young_modulus = 1e5", "young_modulus = { uniform = [-1e5, 1e5] }", "young_modulus is -100000.0"),
    (PRESS, *MESH, "volume"),
    (PRESS, "= 1e5", "== 1e5", "box.toml' is not valid TOML"),
    (PRESS, "{ sphere = 0.02 }", '{ mesh = "flat.obj" }', "mesh file 'flat.obj' is a flat sheet"),
    (PRESS, "{ sphere = 0.02 }", '{ mesh = "flat.obj", scale = 100 }', "box is 10 m long after a scale of 100"),
])
def test_a_wrong_scene_is_refused_and_leaves_nothing(vsfsim, tmp_path, words, old, new, message):
    (tmp_path / "box.toml").write_text((BOX[:BOX.index("[touches]")] if words == PRESS else BOX).replace(old, new))
    (tmp_path / "flat.obj").write_text(FLAT)
    before = contents(tmp_path)
    assert_refused(vsfsim(*words, cwd=tmp_path), message)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(("words", "message"), [
    (("evaluate", "--method", "nowhere:Mine", "--task", "toy-v1.toml", "--dataset", "toy"),
     "method 'nowhere:Mine' cannot be loaded: ModuleNotFoundError"),
    ((*EVALUATE, "--out", "toy-v1.toml/x.json"), "'toy-v1.toml' is no folder"),
    ((*EVALUATE, "--out", "toy-v1.toml"), "which has the ending of a file that is read, not written"),
    (("press", "indent", "--picture", "nowhere/x.png"),
     "--picture is 'nowhere/x.png', but there is no folder 'nowhere'"),
    (("press", "indent", "--save", "x.h5"), "--save is 'x.h5'; it must end in .npz"),
    (("press", "indent", "--plot", "x.tex"), "--plot is 'x.tex'; it must end in .png or .jpg"),
    (("check", "gaussian", "--set", "x=" + 3000 * "[" + 3000 * "]"), "--set x: its value is nested too deep"),
    (("generate", "shoes-mini", "--renderer", "pyrendr", "--out", "out"),
     "--renderer is 'pyrendr'. Did you mean 'pyrender'?"),
])
def test_a_wrong_word_is_refused_and_leaves_nothing(vsfsim, toy, words, message):
    before = contents(toy)
    assert_refused(vsfsim(*words, cwd=toy), message)
    assert contents(toy) == before


def test_a_method_that_fails_is_named_and_the_next_is_scored(vsfsim, toy):
    out = vsfsim("evaluate", "--method", "toy_methods:Crashes", *EVALUATE[1:], "--seeds", 1, cwd=toy)
    assert out.returncode == 2 and "error: toy_methods:Crashes: " in out.stderr
    assert re.search(r"(?m)^toy_methods:Constant .*\n-+\nrmse", out.stdout)
    assert (toy / "results" / "toy-v1" / "toy_methods.Constant.json").is_file()


@pytest.mark.parametrize("name", ["mock-0000-v0.h5", "mock-0002-v0.h5", "dataset.json"])
def test_one_flipped_byte_of_a_dataset_is_never_scored(vsfsim, toy, name):
    path = toy / "toy" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(bytes(content))
    before = contents(toy)
    assert_refused(vsfsim(*EVALUATE, cwd=toy), name)
    assert contents(toy) == before


def test_a_full_disk_under_a_result(toy):
    before = contents(toy)
    # a file-size limit fails a write as a quota does, on any machine and without rights
    out = run(*EVALUATE, cwd=toy, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500)))
    assert_refused(out, "results/toy-v1/toy_methods.Constant.parts/")
    assert "cannot be written: File too large" in out.stderr
    files, there_before = ({path: data for path, data in folder.items() if data is not None}
                           for folder in (contents(toy), before))
    kept = set(files) - set(there_before)
    assert all(name.endswith(".log") for name in kept), kept
    assert {name: files[name] for name in there_before} == there_before


def test_a_home_folder_that_cannot_be_written(tmp_path, monkeypatch):
    """A file in place of the folder stops every user, root too."""
    (tmp_path / "box.toml").write_text(BOX)
    (tmp_path / "home").touch()
    for name in ("XDG_CACHE_HOME", "WARP_CACHE_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert_refused(run(*PRESS, cwd=tmp_path), "export WARP_CACHE_PATH=")


@pytest.mark.parametrize("words", [("--debug", *PRESS), (*PRESS, "--debug")])
def test_debug_shows_the_traceback(vsfsim, tmp_path, words):
    (tmp_path / "box.toml").write_text(BOX.replace("young_modulus", "young_modulos"))
    out = vsfsim(*words, cwd=tmp_path)
    assert out.returncode == 2 and "Traceback" in out.stderr and "error: box.toml [object]: unknown key" in out.stderr
