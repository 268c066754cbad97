"""The tasks and methods that can be evaluated, as the commands `vsfsim tasks` and `vsfsim methods` list them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from vsfsim.bench.task import Task, load_task
from vsfsim.core import shelf
from vsfsim.core.errors import VsfsimError, did_you_mean
from vsfsim.core.system.interactive import html_table
from vsfsim.core.text_table import text_table

T = TypeVar("T")


class Catalogue(dict[str, T]):
    """Things by name; it prints as a table.

    Args:
        kind: what one of them is, e.g. "task". found: by name. head: headings of the table; the first column is the
        name. rows: its cells, one row a name.
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
    """The tasks that ship, by name; superseded ones are last.

    Returns:
        A mapping; ``tasks()["fewshot-shoes-v3-mini-v1"].protocol.shots`` is a part of one.
    """
    loaded = {name: load_task(name) for name in shelf.tasks()}
    found = dict(sorted(loaded.items(), key=lambda one: bool(one[1].superseded_by)))
    rows = [(name, t.observation.name, t.dataset.folder, t.description, t.superseded_by)
                 for name, t in found.items()]
    return Catalogue("task", found, ("task", "observation", "dataset", "description", "superseded by"), rows)


def methods() -> Catalogue[str]:
    """The installed methods: their classes as module:attribute, by name.

    No method is imported; `vsfsim.bench.method.find_method` does that.
    """
    found = {name: entry.value for name, entry in sorted(shelf.methods().items())}
    return Catalogue("method", found, ("method", "class"), tuple(found.items()))
