"""The HTML that a notebook shows for a result, a dataset or a list: one table."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape


def html_table(title: str, head: Sequence[str], rows: Sequence[Sequence[object]], *, most: int = 60) -> str:
    """A table as HTML; every text is escaped.

    Args:
        title: the line above the table.
        head: heading of each column.
        rows: cells, one for each column.
        most: rows that are shown; a line below the table counts the others.
    """
    def cells(tag: str, row: Sequence[object]) -> str:
        return "".join(f'<{tag} style="text-align: left">{escape(str(cell))}</{tag}>' for cell in row)

    body = "".join(f"<tr>{cells('td', row)}</tr>" for row in rows[:most])
    left = f"<p>and {len(rows) - most} more</p>" if len(rows) > most else ""
    return (f"<p>{escape(title)}</p><table><thead><tr>{cells('th', head)}</tr></thead><tbody>{body}</tbody></table>"
            f"{left}")
