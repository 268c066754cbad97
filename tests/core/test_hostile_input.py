"""Input that used to end in a traceback: an error that names it instead."""

from collections.abc import Callable
from pathlib import Path

import pytest

from vsfsim.cli.options import result_path
from vsfsim.core import shelf
from vsfsim.core.errors import SceneError, VsfsimError
from vsfsim.core.plain_text import file_stem
from vsfsim.core.table import parse_toml


@pytest.mark.parametrize("text", ["[" + ".".join("a" * 3000) + "]", "a." * 60 + "b = 1", "x = " + "[" * 80 + "]" * 80])
def test_deep_tables_are_refused(text: str) -> None:
    with pytest.raises(SceneError, match=r"more than 50 deep|not valid TOML"):
        parse_toml(text, Path("deep.toml"), "scene", SceneError)


@pytest.mark.parametrize(("name", "ask"), [("scenes", shelf.scenes), ("tasks", shelf.tasks),
                                           ("baselines", shelf.methods)])
def test_two_copies_are_not_mixed(name: str, ask: Callable[[], object], tmp_path: Path,
                                  monkeypatch: pytest.MonkeyPatch) -> None:
    for part in ("vsfsim/core", name):
        (tmp_path / part).mkdir(parents=True)
    (tmp_path / "pyproject.toml").touch()
    monkeypatch.setattr(shelf, "__file__", str(tmp_path / "vsfsim" / "core" / "shelf.py"))
    with pytest.raises(VsfsimError, match=f"two copies of vsfsim are mixed.*its {name} are those"):
        ask()


def test_names_of_other_alphabets_and_long_ones_stay_apart():
    names = ["\u65b9\u6cd5", "\u65b9\u6848", "m\u00e9thode", "m\u00e8thode", "x" * 300, "x" * 299 + "y",
             "mine", "my.mine"]
    stems = [file_stem(name) for name in names]
    assert len(set(stems)) == len(names) and all(stem.isascii() and len(stem) < 120 for stem in stems)
    assert stems[-2:] == ["mine", "my.mine"] and stems[0].startswith("unnamed-") and file_stem("") == "unnamed"


@pytest.mark.parametrize("name", ["x" * 300 + ".json", "\u65b9" * 90 + ".json", "x" * 300 + "/r.json"])
def test_an_out_with_a_name_that_no_file_can_have_is_refused(name, tmp_path):
    with pytest.raises(VsfsimError, match=r"a name of \d+ letters; a file name has at most 200 bytes"):
        result_path(tmp_path / name, "toy-v1", "mine")
    assert result_path(None, "toy-v1", "x" * 300).name.endswith(".json")
