"""The figures of the two papers' tables, of `figures.toml`; claims name them by table, column and row.

"SBML 2/broad/10" is the cell of SBML's table 2 in the column *broad* and the row of 10 touches. A test compares every
cell with the papers' text, in the order in which it is printed, where that text is at hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.core.table import parse_toml, read_text, typed


@dataclass(frozen=True)
class PaperTable:
    """A table of a paper."""

    unit: str
    """Of its cells."""
    rows: tuple[str, ...]
    """Names of its rows."""
    columns: Mapping[str, tuple[tuple[float, float] | float, ...]]
    """Cells of each column, from the first row on."""
    printed: str
    """Order of the cells in the text: "columns", "rows", or "halves" (by columns, first the upper two rows)."""
    alone: Mapping[str, float] = field(default_factory=dict)
    """Numbers below the table, by their words."""


_PATH = Path(__file__).with_name("figures.toml")
_GIVEN = parse_toml(read_text(_PATH, "table of figures", TaskError), _PATH, "table of figures", TaskError)
TEXTS: Mapping[str, str] = _GIVEN.pop("texts")
"""sha256 of the text of each paper that the cells were compared with."""
TABLES: Mapping[str, PaperTable] = {name: typed(given, PaperTable, f"{_PATH} [{name}]", error=TaskError)
                                   for name, given in _GIVEN.items()}
"""By paper and number."""


def figure(name: str) -> tuple[float, str]:
    """The mean, or the only number, in the cell that "TABLE/COLUMN/ROW" names, and its unit, "" for a share; the row
    "all" is the number below the table.

    Raises:
        TaskError: there is no such cell.
    """
    of, column, row = (*name.split("/"), "", "")[:3]
    if of not in TABLES:
        raise TaskError(f"figures: '{name}' names no table. {did_you_mean(of, TABLES)}")
    table = TABLES[of]
    if row == "all" and table.alone:
        return next(iter(table.alone.values())), table.unit
    for part, known in ((column, table.columns), (row, table.rows)):
        if part not in known:
            raise TaskError(f"figures: '{name}' names no cell of {of}. {did_you_mean(part, known)}")
    cell = table.columns[column][table.rows.index(row)]
    return (cell[0] if isinstance(cell, tuple) else cell), table.unit


def said(names: tuple[str, ...], words: str) -> str:
    """The figures of both sides with their unit, or ``words`` where there are none."""
    if not names:
        return words
    values, (unit, *_) = zip(*map(figure, names), strict=True)
    kind = "" if unit else names[0].split("/")[1] + " "
    return f"{kind}{' and '.join(f'{value:.{2 if unit else 3}f}' for value in values)} {unit}".rstrip()
