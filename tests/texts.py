"""Scenes, tasks and studies of tests: the files of `tests/texts`, and what a test changes in them."""

import re
from pathlib import Path

FOLDER = Path(__file__).parent / "texts"


def changed(text, /, *pairs, **values):
    """``text`` with the first of each pair replaced by the second, and with the lines of keys set to ``values``, which
    are Python numbers and lists or text of TOML; None takes a key out, and a key that is not there goes to the end."""
    for old, new in pairs:
        assert old in text, old
        text = text.replace(old, new)
    for key, value in values.items():
        line = "" if value is None else f"{key} = {value}\n"
        text, found = re.subn(rf"(?m)^{key} = .*\n", lambda _, line=line: line, text)
        assert found < 2, f"{key} stands in {found} places"
        text += "" if found else line
    return text


def text(name, /, *pairs, **values):
    """A file's text, changed."""
    return changed((FOLDER / f"{name}.toml").read_text(), *pairs, **values)


def scene(name, /, *pairs, **values):
    """The scene of a file, changed."""
    from vsfsim.core.scene import parse_scene

    return parse_scene(text(name, *pairs, **values), f"{name}.toml")
