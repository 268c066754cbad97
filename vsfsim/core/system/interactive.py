"""What a Python user meets: packages that can be called, figures and tables that a notebook shows.

`vsfsim.press`, `vsfsim.generate` and `vsfsim.tasks` are packages with modules of their own, and importing one of those
binds the package to the name in `vsfsim`. A function of the same name would be replaced by it, so the package itself is
made callable (Python reference 3.3.2.1, customizing module attribute access).
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence
from html import escape
from io import BytesIO
from pkgutil import resolve_name
from types import ModuleType
from typing import Any


def make_callable(package: str, function: str) -> None:
    """Let calls of a package run a function.

    Args:
        package: ``__name__`` of the package.
        function: as module:name; it is imported at the first use, because that is slow.
    """
    class Package(ModuleType):
        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return resolve_name(function)(*arguments, **options)

        # for `help` and for notebooks
        __signature__ = property(lambda _: inspect.signature(resolve_name(function)))

    sys.modules[package].__class__ = Package


def new_figure(**options: Any) -> Any:
    """An empty `matplotlib.figure.Figure`; ``options`` are those of its constructor.

    Nothing of pyplot is loaded: there is no window, no global state, and a figure that is no longer used is freed.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    class Shown(Figure):
        def _repr_png_(self) -> bytes:
            """For notebooks."""
            buffer = BytesIO()
            self.savefig(buffer, format="png")
            return buffer.getvalue()

    figure = Shown(**options)
    FigureCanvasAgg(figure)
    return figure


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
