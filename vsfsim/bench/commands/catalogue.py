"""The tasks and methods that can be evaluated, as `vsfsim list` shows them, and
presets: named settings of the methods that ship, read from baselines/presets.toml without importing a method."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from vsfsim.bench.task import Task, load_task
from vsfsim.core import shelf
from vsfsim.core.errors import MethodError, VsfsimError, did_you_mean
from vsfsim.core.system.interactive import html_table
from vsfsim.core.table import parse_toml, read_text
from vsfsim.core.text_table import text_table

T = TypeVar("T")


class Catalogue(dict[str, T]):
    """Things by name; it prints as a table.

    Args:
        kind: what one of them is, e.g. "task".
        found: by name.
        head: headings of the table; the first column is the name.
        rows: its cells, one row a name.
    """

    def __init__(self, kind: str, found: Mapping[str, T], head: Sequence[str], rows: Sequence[Sequence[str]]):
        super().__init__(found)
        self.kind, self.head, self.rows = kind, head, rows

    def __missing__(self, name: str) -> T:
        """Raises:
            VsfsimError: there is none of this name.
        """
        raise VsfsimError(f"unknown {self.kind} '{name}'. {did_you_mean(name, self)}")

    def __repr__(self) -> str:
        return text_table(self.head, self.rows)

    def _repr_html_(self) -> str:
        return html_table(f"{len(self)} {self.kind}s", self.head, self.rows)

    def table(self) -> list[dict[str, Any]]:
        """For JSON: one object a row."""
        return [dict(zip(self.head, row, strict=True)) for row in self.rows]


def tasks() -> Catalogue[Task]:
    """The tasks that ship, by name.

    Returns:
        A mapping; ``tasks()["fewshot-shoes-v3-mini-v1"].protocol.shots`` is a part of one.
    """
    found = {name: load_task(name) for name in shelf.tasks()}
    rows = [(name, t.observation.name, t.dataset.folder, t.description) for name, t in found.items()]
    return Catalogue("task", found, ("task", "observation", "dataset", "description"), rows)


def methods() -> Catalogue[str]:
    """The installed methods: their classes as module:attribute, by name.

    No method is imported; `vsfsim.bench.method.find_method` does that.
    """
    found = {name: entry.value for name, entry in sorted(shelf.methods().items())}
    return Catalogue("method", found, ("method", "class"), tuple(found.items()))


PRESETS = ("paper", "exact", "tuned")
"""Names: the literal text of a paper, its algorithm solved to the end, and ours."""


@dataclass(frozen=True)
class Choice:
    """A method with a preset: one row of a leaderboard."""

    method: str
    """Name of the method."""
    preset: str
    """One of `PRESETS`; "" for none."""
    parameters: Mapping[str, Any]
    """Of its constructor, over its defaults."""

    @property
    def stem(self) -> str:
        """Of its result file."""
        return f"{self.method}.{self.preset}" if self.preset else self.method


def _table() -> dict[str, Any]:
    path = shelf.folder("baselines") / "presets.toml"
    return parse_toml(read_text(path, "presets", MethodError), path, "presets", MethodError)


def preset(method: str, name: str, observation: str, answer: str = "readings") -> Choice:
    """The settings of a method for tasks with an observation.

    Args:
        method: its name.
        name: of the preset; "" for the settings of its constructor.
        observation: name of what is read.
        answer: what is asked of it, a value of `vsfsim.bench.metrics.Answer`.

    Raises:
        MethodError: the method has no presets, or not this one.
    """
    if not name:
        return Choice(method, "", {})
    table = _table()
    if method not in table:
        raise MethodError(f"--preset: the method '{method}' has no presets. {did_you_mean(method, table)} Give its "
                          f"parameters by --set.")
    known = [key for key in PRESETS if key in table[method]]
    if name not in known:
        raise MethodError(f"--preset is '{name}', but {method} has {' and '.join(known)}. {did_you_mean(name, known)}")
    given = table[method][name]
    of_observation = given.get(observation, {})
    return Choice(method, name, {**_values(given), **_values(of_observation), **of_observation.get(answer, {})})


def _values(table: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in table.items() if not isinstance(value, dict)}


def choices(observation: str, device: str = "", answer: str = "readings", *, chosen: bool = False) -> list[Choice]:
    """All methods with all their presets that a task can rank, the one with the papers' settings first, but those that
    are too slow to be asked other than by name.

    Args:
        observation: name of what is read.
        device: that the methods use which a GPU makes faster; "" for their own.
        answer: what the task's metric scores, a value of `vsfsim.bench.metrics.Answer`.
        chosen: its support is chosen by the method, so that methods which differ by their choice alone take part.
    """
    out = []
    for method, table in _table().items():
        if table.get("by_name", False) or (table.get("chooses", False) and not chosen):
            continue
        if observation in table.get("observations", [observation]) and answer in table.get("answers", [answer]):
            own = {"device": device} if device and observation in table.get("gpu", []) else {}
            found = [preset(method, name, observation, answer) for name in PRESETS if name in table]
            out += [replace(one, parameters={**one.parameters, **own}) for one in found]
    return out
