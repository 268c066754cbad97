"""Rows that a leaderboard lacks, with the reason: `leaderboard/absent.toml`, printed under the table."""

from __future__ import annotations

from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import folder
from vsfsim.core.table import parse_toml, read_text


def absent(task: str) -> dict[str, str]:
    """Why rows are absent, by the names of their methods, separated by commas; {} where nothing is said.

    Args:
        task: name of the task.

    Raises:
        TaskError: the file is damaged.
    """
    path = folder("leaderboard") / "absent.toml"
    if not path.is_file():
        return {}
    said = parse_toml(read_text(path, "leaderboard", TaskError), path, "leaderboard", TaskError).get(task, {})
    if not isinstance(said, dict):
        raise TaskError(f"{path}: '{task}' is {said!r}; give a table of names of methods and reasons, as "
                        f"[{task}] and below it fem-map = \"why\".")
    return said
