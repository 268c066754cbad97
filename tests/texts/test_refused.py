"""Scenes, tasks and studies that say something wrong are refused in one paragraph that names the file, by the table
`refused.toml`."""

import re
import tomllib
from pathlib import Path

import pytest
import texts

from papers.study import parse_study
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import SceneError, TaskError
from vsfsim.core.scene import parse_scene
from vsfsim.generate.recipe import make_recipe
from vsfsim.physics import tiers

TABLE = tomllib.loads((Path(__file__).parent / "refused.toml").read_text())["of"]
ROWS = [(one["text"], one.get("as", "scene"), *row) for one in TABLE for row in one["rows"]]
READ = {"scene": parse_scene, "task": parse_task, "study": parse_study,
        "recipe": lambda text, path: make_recipe(parse_scene(text, path)),
        "model": lambda text, path: tiers.build(parse_scene(text, path).sample(0), "linear")}


@pytest.mark.parametrize(("name", "read", "old", "new", "words"), ROWS)
def test_what_is_wrong_is_named(name, read, old, new, words):
    text = texts.text(name)
    assert old in text
    with pytest.raises((SceneError, TaskError), match=".*".join(map(re.escape, words.split(" ... ")))) as caught:
        READ[read](text.replace(old, new, 1), Path(f"{name}.toml"))
    assert name in str(caught.value) and "\n" not in str(caught.value)
