"""The text table of every command: rich aligns it, in a terminal, a pipe and a file alike."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO

_RULE = "    \n    \n -- \n    \n    \n    \n    \n    \n"
"""Rich's eight lines of a box: a table without frames, with a line of dashes below its head."""


def text_table(head: Sequence[str], rows: Sequence[Sequence[str]], *, right: bool = False, left: int = 0,
               rule: bool = True) -> str:
    """A table as plain text without trailing blanks; columns are as wide as their widest cell, and nothing is cut.

    Args:
        head: heading of each column.
        rows: cells, one for each column.
        right: align columns to the right, for tables of numbers; default: to the left.
        left: leading columns that stay aligned to the left.
        rule: draw a line of dashes below the head.
    """
    from rich.box import Box
    from rich.console import Console
    from rich.table import Table

    table = Table(box=Box(_RULE, ascii=True) if rule else None, show_edge=False, pad_edge=False,
                  padding=(0, 1 if rule else 2, 0, 0))
    for index, heading in enumerate(head):
        table.add_column(heading, justify="right" if right and index >= left else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    width = sum(max(map(len, column)) + 3 for column in zip(head, *rows, strict=True))
    out = StringIO()
    Console(file=out, width=width, color_system=None, markup=False, highlight=False, emoji=False).print(table)
    return "\n".join(line.rstrip() for line in out.getvalue().rstrip().split("\n"))
