"""A matplotlib figure that is drawn without a window and that a notebook shows by itself."""

from __future__ import annotations

from io import BytesIO
from typing import Any


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
