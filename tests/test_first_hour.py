"""What a new user types in the first hour: info, help, completion, JSON, a mistyped file, a method of one's own; and
what works on a system without POSIX."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mock_dataset import TASK

from vsfsim.core import shelf

ROOT = Path(__file__).parents[1]


def test_python_m_is_the_command_and_h_is_help():
    out = subprocess.run([sys.executable, "-m", "vsfsim", "-h"], capture_output=True, text=True)
    assert out.returncode == 0 and "evaluate" in out.stdout and "--install-completion" in out.stdout


@pytest.mark.parametrize(("typed", "found"), [
    ("vsfsim press inde", "indent-homogeneous"),
    ("vsfsim leaderboard --task fewshot-shoes-v3-pu", "fewshot-shoes-v3-punyo-v1"),
])
def test_a_shell_completes_commands_and_names(typed, found):
    """As bash asks for it (the script of `vsfsim --show-completion bash`)."""
    env = {**os.environ, "_VSFSIM_COMPLETE": "complete_bash", "COMP_WORDS": typed,
           "COMP_CWORD": str(len(typed.split()) - 1)}
    code = "import sys; sys.argv[0] = 'vsfsim'\nfrom vsfsim.cli.main import main; main()"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert found in out.stdout.split(), out.stdout + out.stderr


def test_info_says_what_is_there_and_what_to_do(vsfsim, tmp_path, monkeypatch):
    monkeypatch.setenv("VSFSIM_DATASETS", str(tmp_path / "data"))
    (tmp_path / "data" / "bag-punyo-v1").mkdir(parents=True)
    (tmp_path / "data" / "bag-punyo-v1" / "dataset.json").write_bytes(bytes(1000))
    facts = json.loads(vsfsim("info", "--json", "-", cwd=tmp_path).stdout)
    by_name = {(fact["group"], fact["name"]): fact for fact in facts}
    assert {group for group, _ in by_name} == {"versions", "devices", "datasets"}
    assert by_name["versions", "numpy"]["value"] == np.__version__
    assert by_name["datasets", "bag-punyo-v1"]["value"].endswith("0.0 MB")
    missing = by_name["datasets", "rope-punyo-v1"]
    assert missing["todo"].startswith("vsfsim generate rope-punyo --objects") and str(tmp_path) in missing["todo"]
    text = vsfsim("info", cwd=tmp_path).stdout
    assert all(fact["name"] in text and fact["todo"] in text for fact in facts)


def test_every_command_that_reports_writes_json(vsfsim, tmp_path):
    """Those that need no dataset; `test_python.py` and `test_press_cli.py` hold the others."""
    scenes = json.loads(vsfsim("list", "scenes", "--json", "-", cwd=tmp_path).stdout)
    assert {row["scene"] for row in scenes if row["description"]} == set(shelf.scenes())
    assert "lerobot" in vsfsim("list", "formats", cwd=tmp_path).stdout
    board = json.loads(vsfsim("leaderboard", "--task", "fewshot-shoes-v3-mini-v1", "--json", "-", cwd=tmp_path).stdout)
    ranks = [row["rank"] for row in board["rows"] if row["rank"]]
    assert len(ranks) >= 5 and ranks == sorted(ranks) and ranks[0] == 1
    assert all(row["not_ranked_because"] for row in board["rows"] if row["rank"] is None)
    assert {row["origin"] for row in board["rows"]} == {"shipped"}
    made = vsfsim("check", "gaussian", "--json", "check.json", cwd=tmp_path)
    checked = json.loads((tmp_path / "check.json").read_text())
    assert "gaussian conforms" in made.stdout
    assert checked["conforms"] and {clause["outcome"] for clause in checked["clauses"]} <= {"ok", "not offered"}
    from typer.main import get_command

    from vsfsim.cli.main import app

    silent = {"lab", "measure", "papers", "cluster"}
    for name, command in get_command(app).commands.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert "--json" in options or name in silent, name


@pytest.mark.parametrize(("words", "message"), [
    (("press", "fom.toml"), "there is no scene file (.toml) 'fom.toml'. Did you mean 'foam.toml'?"),
    (("press", "there/foam.toml"), "there is no folder 'there'"),
    (("press", "notes.txt"), "'notes.txt' is a file, not a scene file (.toml)."),
    (("verify", "data/trry"), "no folder of a dataset 'data/trry'. Did you mean 'data/try'?"),
    (("check", "mine.py:Mine"), "without .py: mine:Mine"),
    (("check", "mine:Min"), "has no class 'Min'. Did you mean 'Mine'?"),
    (("lab", "score", "predictions.npz", "--name", "x", "--task", "fewshot-shoes-v3-mini-v1", "--dataset",
      "data/try"),
     "there is no file of predictions 'predictions.npz'. Did you mean 'prediction.npz'?"),])
def test_a_mistyped_file_is_said_to_be_no_such_file(vsfsim, tmp_path, words, message, monkeypatch):
    for file in ("foam.toml", "notes.txt", "prediction.npz"):
        (tmp_path / file).write_text("")
    (tmp_path / "mine.py").write_text("class Mine:\n    pass\n")
    (tmp_path / "data" / "try").mkdir(parents=True)
    monkeypatch.syspath_prepend(str(tmp_path))
    sys.modules.pop("mine", None)
    if words[0] == "lab":
        monkeypatch.setattr("vsfsim.bench.task.open_dataset", lambda *_: None)
    out = vsfsim(*words, cwd=tmp_path)
    assert out.returncode == 2 and message in out.stderr and "Traceback" not in out.stderr, out.stderr


# ------------------------------------------------------------------------------------------ a method of one's own


def test_new_method_makes_a_package_that_passes_check_and_its_own_tests(vsfsim, tmp_path):
    out = vsfsim("lab", "new-method", "my-springs", cwd=tmp_path)
    assert out.returncode == 0 and "vsfsim check my_springs:MySprings" in out.stdout, out.stderr
    folder = tmp_path / "my-springs"
    assert {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()} == {
        "pyproject.toml", "README.md", "my_springs.py", "tests/test_my_springs.py"}
    tested = subprocess.run([sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
                            capture_output=True, text=True, cwd=folder)
    assert tested.returncode == 0 and "2 passed" in tested.stdout, tested.stdout + tested.stderr


# --------------------------------------------------------------------------------------------- names of folders


def test_the_default_folder_of_a_dataset_is_where_its_task_looks(monkeypatch):
    import vsfsim
    from vsfsim.core.scene import load_scene

    monkeypatch.delenv("VSFSIM_DATASETS", raising=False)
    for root in ("datasets", "elsewhere"):
        if root == "elsewhere":
            monkeypatch.setenv("VSFSIM_DATASETS", root)
        for task in (one for one in vsfsim.tasks().values() if not one.dataset.recorded):
            want, scene = task.dataset, load_scene(shelf.find_scene(task.dataset.scene))
            given = {name: getattr(want, name) for name in ("seed", "objects", "views", "touches", "tier")}
            folder = shelf.dataset_folder(want.scene, text=scene.text, **given)
            assert folder == want.path() and folder.parts[0] == root, task.name
            other = shelf.dataset_folder(want.scene, text=scene.text, **{**given, "seed": want.seed + 1})
            assert other == Path(root) / want.scene, "another dataset of the scene does not take the task's place"


def test_a_script_without_a_main_guard_can_use_workers(tmp_path):
    """A spawned worker does not run the script again."""
    (tmp_path / "script.py").write_text("""
from vsfsim.generate.workers import process_pool, submit
import math
print("begins")
with process_pool(1, 1) as pool:
    print([submit(pool, math.sqrt, x).result() for x in (4.0, 9.0)], __file__[-9:])
""")
    out = subprocess.run([sys.executable, "script.py"], capture_output=True, text=True, cwd=tmp_path)
    assert out.returncode == 0 and out.stdout == "begins\n[2.0, 3.0] script.py\n", out.stdout + out.stderr


# --------------------------------------------------------------------------------- systems without POSIX


WITHOUT_POSIX = f"""
import builtins, os, signal, sys
sys.path.insert(0, {str(ROOT / "tests")!r})
BLOCKED = {{"fcntl", "resource", "pwd", "grp", "termios"}}
real = builtins.__import__
def blocked(name, *more, **options):
    if name.split(".")[0] in BLOCKED and "vsfsim" in str((more[0] if more else {{}} or {{}}).get("__name__", "")):
        raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
    return real(name, *more, **options)
builtins.__import__ = blocked
for name in ("fork", "pread", "pwrite"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGALRM", "setitimer", "alarm"):
    if hasattr(signal, name):
        delattr(signal, name)
"""


def test_imports_datasets_and_scores_work_without_posix(tmp_path):
    """Every module but those of the simulator's own processes is imported; a dataset is made, verified and scored.

    A module that vsfsim itself imports from `fcntl` or `resource` is refused, and `os.fork` and `signal.SIGKILL` are
    not there, as on Windows.
    """
    (tmp_path / "toy-v1.toml").write_text(TASK)
    code = WITHOUT_POSIX + """
import importlib, pkgutil
import vsfsim
for found in pkgutil.walk_packages(vsfsim.__path__, "vsfsim."):
    importlib.import_module(found.name)
import numpy as np
from mock_dataset import written
from vsfsim.bench.predictions import questions
from vsfsim.bench.task import load_task
from vsfsim.cli.main import main
data = written("toy")
asked = [(key, action) for q in questions(load_task("toy-v1.toml"), data) for key, action in zip(q.keys, q.actions)]
np.savez("p.npz", **{key: np.zeros((len(action.time), action.size)) for key, action in asked})
score = ["lab", "score", "p.npz", "--task", "toy-v1.toml", "--dataset", "toy", "--name", "zeros"]
for words in (["verify", "toy"], score, ["leaderboard", "--task", "toy-v1.toml"]):
    sys.argv = ["vsfsim", *words]
    try:
        main()
    except SystemExit as end:
        assert not end.code, (words, end.code)
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert out.returncode == 0 and "zeros" in out.stdout, out.stdout + out.stderr
