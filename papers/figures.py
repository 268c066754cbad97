"""The figures of the two papers' tables, transcribed once; claims name them by table, column and row.

"SBML 2/broad/10" is the cell of SBML's table 2 in the column *broad* and the row of 10 touches. A test compares every
cell with the papers' text, in the order in which it is printed, where that text is at hand.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from vsfsim.core.errors import TaskError, did_you_mean

TEXTS = {"SBML": "2b992a21a4b48cd8dc4d1a0d68982ff9a8878168fd146289e717e027ad738c9d",
         "Neural VSF": "a53ef6dd8b1059c3100dc7be81e93cf31368718abeaaebb01cfba6fa39078f37"}
"""sha256 of the text of each paper that the cells were compared with."""

_SHOTS, _PARTS = ("0", "1", "5", "10"), ("10 %", "40 %", "70 %", "100 %")


@dataclass(frozen=True)
class Figure:
    """A cell."""

    value: float
    """Mean, or the only number [unit of the table]."""
    spread: float | None
    """Standard deviation over the paper's seeds; None where it prints none."""
    unit: str
    """Of both; "" for a share."""


@dataclass(frozen=True)
class PaperTable:
    """A table of a paper."""

    unit: str
    """Of its cells."""
    rows: tuple[str, ...]
    """Names of its rows."""
    columns: Mapping[str, tuple[tuple[float, float], ...] | tuple[float, ...]]
    """Cells of each column, from the first row on."""
    printed: str
    """Order of the cells in the text: "columns", "rows", or "halves" (by columns, first the upper two rows)."""
    alone: Mapping[str, float]
    """Numbers below the table, by their words."""


_VSF_PLANTS, _VSF_SHOES = {"VSF all-shot": 2.57}, {"VSF all-shot": 4.10}

TABLES: Mapping[str, PaperTable] = {
    "SBML 1": PaperTable("N m", _SHOTS, {
        "imaml-vision": ((3.86, 0.84), (4.99, 2.04), (4.63, 1.26), (4.51, 1.03)),
        "average": ((5.23, 0.00), (5.04, 0.04), (4.42, 0.07), (3.88, 0.09)),
        "narrow": ((2.82, 0.04), (2.78, 0.03), (2.71, 0.05), (2.66, 0.03)),
        "broad": ((2.80, 0.05), (2.76, 0.05), (2.67, 0.05), (2.61, 0.04))}, "columns", _VSF_PLANTS),
    "SBML 2": PaperTable("hPa", _SHOTS, {
        "imaml-vision": ((9.95, 6.71), (6.30, 1.00), (6.21, 0.96), (6.15, 0.91)),
        "average": ((8.27, 0.00), (7.46, 0.13), (5.54, 0.21), (4.62, 0.08)),
        "narrow": ((5.66, 0.23), (5.48, 0.19), (4.91, 0.12), (4.54, 0.07)),
        "broad": ((7.43, 0.25), (6.77, 0.26), (5.05, 0.20), (4.18, 0.04))}, "columns", _VSF_SHOES),
    "SBML 3": PaperTable("hPa", _SHOTS, {
        "HE": ((9.76, 0.75), (8.58, 0.68), (5.82, 0.31), (4.73, 0.10)),
        "HE+SEG": ((9.23, 0.86), (7.57, 0.57), (5.00, 0.26), (4.36, 0.07)),
        "HE+HO": ((9.13, 0.77), (8.10, 1.38), (5.32, 0.17), (4.49, 0.07))}, "columns", _VSF_SHOES),
    "SBML 4": PaperTable("N m", _SHOTS, {
        "imaml": ((3.95, 0.85), (5.71, 3.52), (5.10, 2.16), (4.40, 0.93)),
        "zero": ((3.55, 0.00), (3.43, 0.03), (3.09, 0.04), (2.88, 0.03))}, "rows", _VSF_PLANTS),
    "SBML 5": PaperTable("hPa", _SHOTS, {
        "imaml": ((7.44, 1.93), (7.22, 2.77), (6.38, 1.23), (6.22, 0.89)),
        "zero": ((9.21, 0.00), (8.08, 0.14), (5.65, 0.22), (4.63, 0.09))}, "rows", _VSF_SHOES),
    "SBML 6": PaperTable("N m", _SHOTS, {
        "plants": ((2.80, 0.05), (2.76, 0.05), (2.67, 0.05), (2.61, 0.04)),
        "unified": ((2.95, 0.07), (2.92, 0.07), (2.83, 0.06), (2.77, 0.05))}, "halves", _VSF_PLANTS),
    "SBML 7": PaperTable("hPa", _SHOTS, {
        "shoes": ((7.43, 0.25), (6.77, 0.26), (5.05, 0.20), (4.18, 0.04)),
        "unified": ((7.05, 0.49), (6.52, 0.41), (5.06, 0.20), (4.32, 0.06))}, "rows", _VSF_SHOES),
    "SBML 10": PaperTable("N m", _PARTS, {
        "10 %": ((4.97, 2.17), (4.07, 1.48), (3.66, 1.24), (3.18, 0.36)),
        "40 %": ((4.24, 2.09), (3.04, 0.19), (3.24, 0.27), (3.33, 0.29)),
        "70 %": ((3.94, 1.13), (2.85, 0.21), (2.82, 0.17), (2.82, 0.07)),
        "100 %": ((3.41, 0.49), (3.27, 0.66), (2.83, 0.14), (2.80, 0.05))}, "rows", {}),
    "SBML 11": PaperTable("hPa", _PARTS, {
        "10 %": ((8.84, 1.88), (9.68, 2.07), (12.17, 2.81), (9.70, 1.57)),
        "40 %": ((8.49, 1.90), (8.87, 2.26), (9.07, 2.26), (7.50, 0.56)),
        "70 %": ((8.10, 0.99), (8.82, 1.41), (8.17, 2.42), (7.03, 0.63)),
        "100 %": ((8.38, 1.10), (8.76, 0.92), (8.44, 1.45), (7.43, 0.26))}, "rows", {}),
    "Neural VSF I": PaperTable("", ("pressure only", "points, 1k", "points, 20k", "neural"), {
        "recall": (0.346, 0.025, 0.338, 0.712),
        "precision": (0.290, 0.251, 0.335, 0.382),
        "F1": (0.314, 0.044, 0.329, 0.493)}, "rows", {})}
"""By paper and number. Columns of tables 10 and 11 are shares of the touches, rows shares of the objects."""


def figure(name: str) -> Figure:
    """The cell that "TABLE/COLUMN/ROW" names; the row "all" is the number below the table.

    Raises:
        TaskError: there is no such cell.
    """
    of, column, row = (*name.split("/"), "", "")[:3]
    if of not in TABLES:
        raise TaskError(f"figures: '{name}' names no table. {did_you_mean(of, TABLES)}")
    table = TABLES[of]
    if row == "all" and table.alone:
        return Figure(next(iter(table.alone.values())), None, table.unit)
    for part, known in ((column, table.columns), (row, table.rows)):
        if part not in known:
            raise TaskError(f"figures: '{name}' names no cell of {of}. {did_you_mean(part, known)}")
    cell = table.columns[column][table.rows.index(row)]
    return Figure(*cell, table.unit) if isinstance(cell, tuple) else Figure(cell, None, table.unit)


def printed(table: PaperTable) -> list[float]:
    """All numbers of a table's columns in the order of the paper's text."""
    columns, count = list(table.columns.values()), len(table.rows)
    parts = {"columns": [(0, count)], "halves": [(0, 2), (2, count)], "rows": [(k, k + 1) for k in range(count)]}
    cells = [cell for first, end in parts[table.printed] for column in columns for cell in column[first:end]]
    return [number for cell in cells for number in (cell if isinstance(cell, tuple) else (cell,))]


def said(names: tuple[str, ...], words: str) -> str:
    """The figures of both sides with their unit, or ``words`` where there are none."""
    if not names:
        return words
    found = [figure(name) for name in names]
    digits = 3 if not found[0].unit else 2
    kind = "" if found[0].unit else names[0].split("/")[1] + " "
    return f"{kind}{' and '.join(f'{one.value:.{digits}f}' for one in found)} {found[0].unit}".rstrip()
