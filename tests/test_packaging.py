"""What lands in site-packages: one package, with the scenes, tasks, baselines and leaderboard inside it.

The wheel is built from a copy of the tree, so that no `build/` is left in it, and without the network.
"""

import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {"scenes": ("*.toml", "*.py"), "tasks": ("*.toml", "*.py"), "baselines": ("*.py",),
           "leaderboard": ("**/*.json", "**/*.md", "*.py")}
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
    "methods": {name: find_method(name).__module__ for name in shelf.methods() if shelf.methods()[name].value.startswith("vsfsim.")},
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
    subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", str(target),
                    str(wheel)],
                   check=True, capture_output=True, text=True, stdin=subprocess.DEVNULL)
    return target


def look(cwd: Path, first: Path | None = None) -> dict:
    """What a fresh interpreter sees; ``first`` goes before site-packages."""
    env = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    if first is not None:
        env["PYTHONPATH"] = str(first)
    out = subprocess.run([sys.executable, "-P", "-c", LOOK], capture_output=True, text=True, cwd=cwd, env=env)
    assert out.returncode == 0, out.stderr
    return json.loads(out.stdout)


def test_the_wheel_holds_vsfsim_and_nothing_beside_it(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"vsfsim"} and len(tops) == 2
    want = {p.relative_to(ROOT).as_posix() for p in (ROOT / "vsfsim").rglob("*.py")}
    for folder, patterns in FOLDERS.items():
        want |= {"vsfsim/" + p.relative_to(ROOT).as_posix() for pattern in patterns
                 for p in (ROOT / folder).glob(pattern)}
    want.add("vsfsim/leaderboard/made-up-v1/somebody.json")
    assert {name for name in names if name.startswith("vsfsim/")} == want
    for must in ("vsfsim/scenes/shoes-mini.toml", "vsfsim/scenes/shoe.py", "vsfsim/tasks/fewshot-shoes-mini-v1.toml",
                 "vsfsim/baselines/gaussian.py"):
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
    assert all(module.startswith("vsfsim.baselines.") for module in seen["methods"].values())


def test_a_wheel_has_the_command_and_the_entry_points(installed):
    (dist,) = importlib.metadata.distributions(path=[str(installed)])
    points = {(ep.group, ep.name): ep.value for ep in dist.entry_points}
    assert points["console_scripts", "vsfsim"] == "vsfsim.cli.main:main"
    assert {name for group, name in points if group == "vsfsim.methods"} >= METHODS
    assert (installed / "bin" / "vsfsim").exists() or (installed / "Scripts" / "vsfsim.exe").exists()


def test_an_editable_install_sees_the_live_folders(tmp_path):
    # more than one may be seen: the egg-info that setuptools leaves in the checkout has no direct_url.json
    urls = [dist.read_text("direct_url.json") for dist in importlib.metadata.distributions(name="vsfsim")]
    if not any(url and json.loads(url).get("dir_info", {}).get("editable") for url in urls):
        pytest.skip("vsfsim is not installed with `pip install -e .` here")
    seen = look(tmp_path)
    assert Path(seen["package"]) == ROOT / "vsfsim"
    assert {name: Path(folder).resolve() for name,
            folder in seen["folders"].items()} == {name: ROOT / name for name in FOLDERS}
    assert set(seen["methods"]) >= METHODS


def test_every_package_folder_is_declared():
    """An undeclared sub-package works in an editable install and is missing from the wheel."""
    import tomllib

    declared = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(p.parent.relative_to(ROOT).parts) for p in (ROOT / "vsfsim").rglob("__init__.py")}
    assert declared == found | {f"vsfsim.{folder}" for folder in FOLDERS}
