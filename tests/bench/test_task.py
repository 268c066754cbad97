"""Task files: what ships loads, what is wrong is refused, and a missing dataset says how to make it."""


import pytest
from texts import text

from vsfsim.bench.task import load_task, open_dataset, parse_task, retired
from vsfsim.core import shelf
from vsfsim.core.errors import TaskError
from vsfsim.core.scene import load_scene
from vsfsim.generate.recipe import make_recipe


def test_every_shipped_task_loads():
    names = list(shelf.tasks())
    assert "fewshot-shoes-v3-mini-v1" in names
    for name in names:
        task = load_task(name)
        assert task.name == name
        assert task.dataset.touches >= task.protocol.query + max(task.protocol.shots)


def test_a_retired_task_says_what_replaces_it():
    there = shelf.tasks()
    for name, entry in retired().items():
        assert name not in there and entry["by"] in there, name
    with pytest.raises(TaskError, match="transfer-shoes-v1 is retired: transfer-shoes-mini-v1 replaces it, and commit"):
        load_task("transfer-shoes-v1")


@pytest.mark.parametrize("name", [name for name in shelf.tasks() if not load_task(name).dataset.recorded])
def test_the_scene_as_shipped_makes_the_dataset_that_the_task_wants(name):
    """So `vsfsim generate SCENE --out FOLDER` is enough, with `--seed` for a second version on fresh objects; the
    longer command that the error prints makes the same."""
    wanted = load_task(name).dataset
    scene = load_scene(shelf.find_scene(wanted.scene))
    recipe = make_recipe(scene, seed=wanted.seed)
    assert (recipe.scene, recipe.seed, recipe.objects, recipe.views, recipe.touches, recipe.tier) == \
        (wanted.scene, wanted.seed, wanted.objects, wanted.views, wanted.touches, wanted.tier)
    assert wanted.scene_sha256 in ("", recipe.scene_sha256)


def test_recordings_that_are_missing_come_with_the_commands_that_get_and_import_them(tmp_path):
    with pytest.raises(TaskError, match=r"(?s)git clone https://github.com/vu-arma-dev/robot-palpation-data\n.*"
                                        r"vsfsim lab import presses --from probings .*--out .*nowhere\n"):
        open_dataset(load_task("real-palpation-v1"), tmp_path / "nowhere")


def test_a_missing_dataset_names_the_command_that_makes_it(task, tmp_path):
    with pytest.raises(TaskError,
                       match=r"vsfsim generate mock --objects 3 --views 1 --touches 12 --seed 0 --tier linear "
                             r"--out .*nowhere"):
        open_dataset(task, tmp_path / "nowhere")


@pytest.mark.parametrize(("old", "new", "message"), [
    ("seed = 0, objects", "seed = 1, objects", "seed is 0, not 1"),
    ('tier = "linear"', 'tier = "fem"', "tier is 'linear', not 'fem'"),
    ('tier = "linear"', 'tier = "linear", scene_sha256 = "00"', "sha256 of the scene text"),
    ('tier = "linear"', 'tier = "linear", sha256 = "00"', "sha256 of the content"),
])
def test_another_dataset_is_refused(task_text, toy_dataset, old, new, message):
    assert old in task_text
    with pytest.raises(TaskError, match=message):
        open_dataset(parse_task(task_text.replace(old, new), "toy.toml"), toy_dataset.path)


def test_a_development_set_is_of_the_same_scene():
    given = 'development = { folder = "other", seed = 1, objects = 2 }'
    found = parse_task(text("toy-v1", ("dataset = { ", f"dataset = {{ {given}, ")), "t")
    assert (found.development.folder, found.development.seed, found.development.objects) == ("other", 1, 2)
    assert found.development.scene == found.dataset.scene and "--seed 1" in found.development.command()
