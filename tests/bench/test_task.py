"""Task files: what ships loads, what is wrong is refused, and a missing dataset says how to make it."""

import pytest
from texts import text

from vsfsim.bench import leaderboard
from vsfsim.bench.task import load_task, open_dataset, parse_task
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
        if task.observation.unit != "hPa":
            assert not any(row.comparable for row in task.paper if row.unit == "hPa")
        assert task.dataset.touches >= task.protocol.query + max(task.protocol.shots)


def test_a_task_that_is_superseded_keeps_its_identity():
    mended = load_task("bag-punyo-mini-v2")
    without = shelf.find_task(mended.name).read_text()
    with_name = f'superseded_by = "{mended.name}"\n{without}'
    old = parse_task(with_name, "t")
    other = parse_task(without.replace("query = 2 ", "query = 3 "), "t")
    assert old.sha256 == parse_task(without, "t").sha256 != other.sha256
    assert "superseded_by" not in without
    said = f"superseded by {mended.name}: the rows that ship were made on data of an earlier vsfsim"
    assert said in leaderboard.text(leaderboard.collect(old))
    assert "superseded" not in leaderboard.text(leaderboard.collect(mended))


@pytest.mark.parametrize("name", list(shelf.tasks()))
def test_the_scene_as_shipped_makes_the_dataset_that_the_task_wants(name):
    """So `vsfsim generate SCENE --out FOLDER` is enough, with `--seed` for a second version on fresh objects; the
    longer command that the error prints makes the same."""
    wanted = load_task(name).dataset
    scene = load_scene(shelf.find_scene(wanted.scene))
    recipe = make_recipe(scene, seed=wanted.seed)
    assert (recipe.scene, recipe.seed, recipe.objects, recipe.views, recipe.touches, recipe.tier) == \
        (wanted.scene, wanted.seed, wanted.objects, wanted.views, wanted.touches, wanted.tier)
    assert load_task(name).superseded_by or wanted.scene_sha256 in ("", recipe.scene_sha256)


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
