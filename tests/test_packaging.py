"""What lands in site-packages: one package, with the scenes, tasks, baselines and leaderboard inside it.

The wheel is built from a copy of the tree, so that no `build/` is left in it, and without the network.
"""

import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest
from mock_dataset import TASK
from packaging.requirements import Requirement

from vsfsim.core.extras import EXTRA_OF

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FOLDERS = {"scenes": ("*.toml", "*.py", "tables/*.toml", "scans/*.obj"),
           "tasks": ("*.toml", "*.py", "records/*.json", "studies/*.toml", "archives/*.zip"),
           "baselines": ("*.toml", "**/*.py"),
           "leaderboard": ("*.toml", "**/*.json", "**/*.md", "*.py")}
METHODS = {"gaussian", "gaussian-zero", "point-vsf"}

LOOK = """
import json, pathlib, vsfsim
from vsfsim.core import shelf
from vsfsim.core.scene import load_scene
from vsfsim.bench.task import load_task
from vsfsim.bench.method import find_method
import vsfsim.scenes.shoe
print(json.dumps({
    "package": str(pathlib.Path(vsfsim.__file__).parent),
    "folders": {name: str(shelf.folder(name)) for name in ("scenes", "tasks", "baselines", "leaderboard")},
    "scenes": [load_scene(path).name for path in shelf.scenes().values()],
    "tasks": [load_task(name).name for name in shelf.tasks()],
    "families": shelf.families(),
    "methods": {name: find_method(name).__module__ for name, entry in shelf.methods().items()
                if entry.value.startswith("vsfsim.")},
    "leaderboard": sorted(p.name for p in shelf.folder("leaderboard").glob("*/*.json")),
    "schema": __import__("vsfsim.data.schema", fromlist=["x"]).SCHEMA_VERSION,
}))
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    setuptools = importlib.metadata.version("setuptools")
    if int(setuptools.split(".")[0]) < 77:
        pytest.skip(f"setuptools {setuptools} cannot read pyproject.toml's licence (77 can); `pip install -c "
                    f"constraints.txt setuptools`")
    tree = tmp_path_factory.mktemp("tree")
    for name in ("vsfsim", *FOLDERS):
        shutil.copytree(ROOT / name, tree / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, tree / name)
    made_up = tree / "leaderboard" / "made-up-v1"  # a row must land in the wheel even while the shipped folder has none
    made_up.mkdir()
    (made_up / "somebody.json").write_text("{}")
    out = tmp_path_factory.mktemp("wheel")
    subprocess.run([sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "--no-index", "-w",
                    str(out), str(tree)],
                   check=True, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    (path,) = out.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    target = tmp_path_factory.mktemp("site")
    zipfile.ZipFile(wheel).extractall(target)
    return target


def look(cwd: Path, first: Path) -> dict:
    """What a fresh interpreter sees; ``first`` goes before site-packages."""
    env = {**os.environ, "PYTHONPATH": str(first)}
    out = subprocess.run([sys.executable, "-P", "-c", LOOK], capture_output=True, text=True, cwd=cwd, env=env)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


def test_the_wheel_holds_vsfsim_and_nothing_beside_it(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"vsfsim"} and len(tops) == 2
    want = {p.relative_to(ROOT).as_posix() for p in (ROOT / "vsfsim").rglob("*.*")
            if p.is_file() and p.suffix != ".pyc"}
    for folder, patterns in FOLDERS.items():
        want |= {"vsfsim/" + p.relative_to(ROOT).as_posix() for pattern in patterns
                 for p in (ROOT / folder).glob(pattern)}
    want.add("vsfsim/leaderboard/made-up-v1/somebody.json")
    assert {name for name in names if name.startswith("vsfsim/")} == want
    for must in ("vsfsim/scenes/shoes-v3-mini.toml", "vsfsim/scenes/footwear.py",
                 "vsfsim/tasks/fewshot-shoes-v3-mini-v1.toml",
                 "vsfsim/baselines/gaussian.py", "vsfsim/baselines/presets.toml"):
        assert must in names
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_an_installed_wheel_finds_its_scenes_tasks_and_methods(installed, tmp_path):
    seen = look(tmp_path, installed)
    assert Path(seen["package"]) == installed / "vsfsim"
    assert {Path(folder).parent for folder in seen["folders"].values()} == {installed / "vsfsim"}
    assert seen["scenes"] and sorted(seen["scenes"]) == sorted(p.stem for p in (ROOT / "scenes").glob("*.toml"))
    assert sorted(seen["tasks"]) == sorted(p.stem for p in (ROOT / "tasks").glob("*.toml"))
    assert "shoe" in seen["families"] and "somebody.json" in seen["leaderboard"]
    assert set(seen["methods"]) >= METHODS
    (dist,) = importlib.metadata.distributions(path=[str(installed)])
    assert dist.entry_points.select(group="console_scripts")["vsfsim"].value == "vsfsim.cli:start"
    assert all(module.startswith("vsfsim.baselines.") for module in seen["methods"].values())


# ------------------------------------------------------------------------------------------------- weight


BASE = {"numpy", "scipy", "h5py", "typer", "rich", "filelock", "msgspec", "jinja2", "fsspec"}
IMPORTED_AS = {"mat-io": "matio", "pyyaml": "yaml", "warp-lang": "warp", "pillow": "PIL", "scikit-learn": "sklearn",
               "scikit-fem": "skfem"}
"""Distributions whose package has another name."""

TOY = f"""
import sys
sys.path.append({str(ROOT / "tests")!r})
import numpy as np
from mock_dataset import written
from vsfsim.bench.predictions import questions
from vsfsim.bench.task import load_task
answers = {{key: np.zeros((len(action.poses), 1)) for question in questions(load_task("toy-v1.toml"), written("toy"))
            for key, action in zip(question.keys, question.actions)}}
np.savez("predictions.npz", **answers)
"""


@pytest.fixture(scope="module")
def bare(wheel, tmp_path_factory) -> Path:
    """The interpreter of a venv with the wheel and what it asks for without an extra: links to the installed packages,
    since a download takes minutes and the network."""
    folder = tmp_path_factory.mktemp("bare")
    venv.create(folder, with_pip=False)
    (site,) = folder.glob("lib/python*/site-packages")
    zipfile.ZipFile(wheel).extractall(site)
    (itself,) = importlib.metadata.distributions(path=[str(site)])
    waiting, linked = list(itself.requires), set()
    while waiting:
        requirement = Requirement(waiting.pop())
        if requirement.name in linked or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        linked.add(requirement.name)
        found = importlib.metadata.distribution(requirement.name)
        waiting += found.requires or []
        for top in {path.parts[0] for path in found.files if path.parts[0] not in ("..", "__pycache__")}:
            (site / top).symlink_to(found.locate_file(top))
    return folder / "bin" / "python"


def in_bare(python: Path, *words: str, cwd: Path) -> subprocess.CompletedProcess:
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    return subprocess.run([str(python), "-P", *words], capture_output=True, text=True, cwd=cwd, env=env)


def test_the_base_packages_score_predictions_and_print_a_leaderboard(bare, tmp_path):
    def vsfsim(*words):
        return in_bare(bare, "-c", "from vsfsim.cli.main import main; main()", *words, cwd=tmp_path)

    (tmp_path / "toy-v1.toml").write_text(TASK)
    made = in_bare(bare, "-c", TOY, cwd=tmp_path)
    assert made.returncode == 0, made.stderr
    scored = vsfsim("lab", "score", "predictions.npz", "--task", "toy-v1.toml", "--dataset", "toy", "--name", "zeros")
    assert scored.returncode == 0 and "all-shot" in scored.stdout, scored.stderr
    board = vsfsim("leaderboard", "--task", "toy-v1.toml")
    assert board.returncode == 0 and "zeros" in board.stdout, board.stderr
    shipped = vsfsim("leaderboard", "--task", "fewshot-shoes-v3-mini-v1")
    assert shipped.returncode == 0 and "imaml-vision" in shipped.stdout, shipped.stderr
    assert vsfsim("verify", "toy").returncode == 0
    for words, extra in ((("press", "indent"), "sim"), (("check", "gaussian"), "methods"),
                         (("show", "toy"), "render")):
        out = vsfsim(*words)
        assert out.returncode == 2 and f'pip install ".[{extra}]"' in out.stderr, (words, out.stderr)
        assert "Traceback" not in out.stderr


def test_the_extras_bring_what_the_messages_promise():
    names = {extra: {Requirement(line).name for line in lines}
             for extra, lines in PROJECT["optional-dependencies"].items()}
    assert {Requirement(line).name for line in PROJECT["dependencies"]} == BASE
    (everything,) = PROJECT["optional-dependencies"]["all"]
    assert Requirement(everything).extras == {"sim", "methods", "render"}
    for package, extra in EXTRA_OF.items():
        assert package in {IMPORTED_AS.get(name, name) for name in names[extra]}
    brought = {IMPORTED_AS.get(name, name) for extra in names if extra not in ("all", "test", "docs")
               for name in names[extra]}
    assert brought == set(EXTRA_OF)


def test_ci_resolves_every_extra():
    for path in (".ci/run", ".github/workflows/test.yml"):
        (code,) = re.findall(r'extras=\$\(\S+ -c "(.+)"\)', (ROOT / path).read_text())
        names = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True).stdout
        assert set(names.strip().split(",")) == set(PROJECT["optional-dependencies"])


def test_every_requirement_is_pinned_in_the_constraints():
    pinned = {re.sub(r"[-_.]+", "-", line.split("==")[0]).lower()
              for line in (ROOT / "constraints.txt").read_text().splitlines() if line and line[0] != "#"}
    asked = {Requirement(line).name for lines in (PROJECT["dependencies"], *PROJECT["optional-dependencies"].values())
             for line in lines}
    assert asked - {"vsfsim"} <= pinned
