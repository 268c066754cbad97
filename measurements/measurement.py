"""The record that every measurement returns, and its one report: text tables and JSON."""

from __future__ import annotations

import datetime
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

import numpy as np

import vsfsim
from vsfsim.cli.console import without_nan
from vsfsim.core.text_table import text_table
from vsfsim.data.provenance import commit
from vsfsim.physics.model import Model

Progress = Callable[[str], None]
"""Called with a sentence about what is going on."""


def factorise(model: Model) -> None:
    """Make the factor that all touches of a body share, which is made at its first use: costs are counted apart."""
    model.preconditioner.solve(np.zeros((model.preconditioner.size, 1)))


_FACTORS = {("m", "mm"): 1e3, ("1", "%"): 100.0}
"""What a value in the first unit is multiplied by to be printed in the second."""


@dataclass(frozen=True)
class Column:
    """One quantity of a table: how it is stored and how it is printed."""

    key: str
    """Its key in the rows; "a.b" is key "b" of the row's "a", or its element b if that is a list."""
    heading: str
    """What is printed above it, before its unit."""
    unit: str = ""
    """Unit of the stored value: SI, "1" for a number without one, empty for text."""
    printed: str = ""
    """Unit that it is printed in; empty: the stored one."""
    form: str = ""
    """Format specification of the printed number."""

    def title(self) -> str:
        """Heading and unit."""
        unit = self.printed or self.unit
        return self.heading if unit in ("", "1") else f"{self.heading} [{unit}]"

    def cell(self, row: Mapping[str, Any]) -> str:
        """The value as text; "-" where there is none."""
        value: Any = row
        for part in self.key.split("."):
            value = value[int(part)] if isinstance(value, (list, tuple)) else value.get(part)
        if value is None or value != value:  # NaN
            return "-"
        if self.printed and self.printed != self.unit:
            value *= _FACTORS[self.unit, self.printed]
        return format(value, self.form)


@dataclass(frozen=True)
class Table:
    """Rows that were measured, and how to print them."""

    title: str
    """A sentence above it."""
    columns: Sequence[Column]
    """What is printed of each row."""
    rows: Sequence[Mapping[str, Any]]
    """One mapping a row; it may hold more than is printed."""
    name: str = ""
    """Key of the rows in the JSON; empty where another key holds the same numbers."""

    def text(self) -> str:
        """For a terminal."""
        words = takewhile(lambda c: not c.unit and not c.form, self.columns)
        return f"{self.title}:\n" + text_table([c.title() for c in self.columns],
                                               [[c.cell(row) for c in self.columns] for row in self.rows],
                                               right=True, left=len(list(words)))


@dataclass(frozen=True)
class Measurement:
    """What a measurement found, with all that is needed to make it again. Make one with `Measurement.of`."""

    command: str
    """Name of the command, as `vsfsim measure NAME`."""
    settings: Mapping[str, Any]
    """What it was called with, after defaults."""
    tables: Sequence[Table]
    """What was measured."""
    notes: Sequence[str] = ()
    """Sentences about what the numbers hold for."""
    numbers: Mapping[str, Any] = field(default_factory=dict)
    """Further entries of the JSON, by key."""
    machine: str = ""
    """Processor, number of cores, and the GPU if one was used."""
    version: str = ""
    """Of vsfsim."""
    commit: str = ""
    """Of the checkout, see `vsfsim.data.provenance.commit`; empty outside a repository."""
    date: str = ""
    """When it ended, ISO 8601 in UTC."""

    @classmethod
    def of(cls, command: str, settings: Mapping[str, Any], tables: Sequence[Table], *, notes: Sequence[str] = (),
           numbers: Mapping[str, Any] | None = None) -> Measurement:
        """A measurement that ended now, on this machine."""
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        return cls(command, settings, tables, notes, numbers or {}, machine(str(settings.get("device", "cpu"))),
                   vsfsim.__version__, commit() or "", now)

    def text(self) -> str:
        """All tables and notes for a terminal."""
        said = [f"{table.text()}\n" for table in self.tables] + [f"note: {sentence}" for sentence in self.notes]
        said.append(f"vsfsim {self.version}{f' ({self.commit})' if self.commit else ''}, {self.machine}, {self.date}")
        return "\n".join(said)

    def record(self) -> dict[str, Any]:
        """Every number, the units of the tables' columns, and the circumstances of the run, as JSON values."""
        stored = [table for table in self.tables if table.name]
        rows = {table.name: list(table.rows) for table in stored}
        units = {table.name: {c.key: c.unit for c in table.columns if c.unit} for table in stored}
        run = {"command": f"vsfsim measure {self.command}", "settings": dict(self.settings),
               "notes": list(self.notes), "machine": self.machine, "version": self.version, "commit": self.commit,
               "date": self.date, "units": units}
        return without_nan({**run, **self.numbers, **rows})


def machine(device: str = "cpu") -> str:
    """The processor, its cores, and the name of the GPU if ``device`` is one."""
    out = f"{platform.machine()}, {os.cpu_count()} CPU cores"
    if device == "cpu":
        return out
    import torch

    return f"{out}, {torch.cuda.get_device_name(device)}"
