"""Input that used to end in a traceback: an error that names it instead."""

from collections.abc import Callable
from pathlib import Path

import pytest

from vsfsim.core import shelf
from vsfsim.core.errors import SceneError, VsfsimError
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
