"""Shipped files by name, a user's own by path."""

import re

import pytest

from vsfsim.core import shelf
from vsfsim.core.errors import SceneError, TaskError


def test_names_are_the_files_and_paths_work_too(tmp_path):
    assert shelf.find_scene("indent") == shelf.folder("scenes") / "indent.toml"
    assert shelf.find_scene("indent").is_file() and "shoe" in shelf.families()
    for name, path in shelf.tasks().items():
        assert shelf.find_task(name) == path
    own = tmp_path / "own.toml"
    own.write_text("")
    assert shelf.find_scene(str(own)) == own and shelf.find_task(str(own)) == own


@pytest.mark.parametrize(("find", "given", "error", "message"), [
    (shelf.find_scene, "indnt", SceneError, "unknown scene 'indnt'. Did you mean 'indent'?"),
    (shelf.find_scene, "indnt", SceneError, "`vsfsim scenes` lists them; a path to a .toml file works too."),
    (shelf.find_scene, "nowhere/x.toml", SceneError,
     "there is no scene file (.toml) 'nowhere/x.toml': there is no folder 'nowhere'."),
    (shelf.find_task, "fewshot-shoe-v3-mini-v1", TaskError, "Did you mean 'fewshot-shoes-v3-mini-v1'?"),
    (shelf.find_task, "x.toml", TaskError, "there is no task file (.toml) 'x.toml'."),
])
def test_neither_a_name_nor_a_file(find, given, error, message):
    with pytest.raises(error, match=re.escape(message)):
        find(given)
