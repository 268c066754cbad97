"""From a shipped scene to a score, through the command line: the two commands that a user begins with."""

import json

import pytest

from vsfsim.bench.task import load_task
from vsfsim.core.shelf import find_scene, find_task

OBJECTS, TOUCHES, QUERY = 3, 10, 4


@pytest.fixture(scope="module")
def task(tmp_path_factory):
    """The released task of the scene, for fewer objects and touches, scored by the error of the force."""
    text = find_task("inclusion-mini-v3").read_text()
    released = load_task("inclusion-mini-v3")
    for old, new in ((f"objects = {released.dataset.objects} ", f"objects = {OBJECTS} "),
                     (f"touches = {released.dataset.touches}", f"touches = {TOUCHES}"),
                     (f"query = {released.protocol.query} ", f"query = {QUERY} "), ("seeds = 3", "seeds = 2"),
                     (released.dataset.scene_sha256, ""),  # another resolution, see below
                     ("shots = [20]", "shots = [0, 5]"), ('primary = "mask_f1"', 'primary = "rmse"'),
                     ('name = "inclusion-mini-v3"', 'name = "small-v1"')):
        assert old in text, old
        text = text.replace(old, new)
    path = tmp_path_factory.mktemp("task") / "small-v1.toml"
    path.write_text(text)
    return path


def test_two_commands_give_a_score(vsfsim, task, tmp_path):
    """Two slabs to train on, one to be scored on: what was touched predicts what was not. The shipped scene, on a mesh
    three times as coarse."""
    text = find_scene("inclusion-pieces-mini").read_text()
    assert "resolution = 0.007" in text
    (tmp_path / "inclusion-pieces-mini.toml").write_text(text.replace("resolution = 0.007", "resolution = 0.021"))
    made = vsfsim("generate", "inclusion-pieces-mini.toml", "--objects", OBJECTS, "--touches", TOUCHES, "--workers", 1,
                  "--out", "data", cwd=tmp_path)
    assert made.returncode == 0 and f"{OBJECTS} object views, {OBJECTS * TOUCHES} touches" in made.stdout, made.stderr
    ratio = {}
    for method in ("gaussian", "point-vsf"):
        scored = vsfsim("evaluate", "--method", method, "--task", task, "--dataset", "data", "--out", f"{method}.json",
                        cwd=tmp_path)
        assert scored.returncode == 0, scored.stderr
        result = json.loads((tmp_path / f"{method}.json").read_text())
        ratio[method] = {label: row["mean"] for label, row in result["scores"]["rmse_ratio"].items()}
        print(method, ratio[method], "of the error of predicting zero")
    assert ratio["gaussian"]["all"] < ratio["gaussian"]["0"] < 0.5
    assert ratio["point-vsf"]["all"] < ratio["point-vsf"]["5"] < ratio["point-vsf"]["0"] < 1.1
    assert ratio["point-vsf"]["all"] < 0.85
