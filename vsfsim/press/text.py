"""A press in words: the table of its frames, whether it can be trusted, and notes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.core.text_table import text_table
from vsfsim.generate.press_result import Column, PressResult


def table(columns: Sequence[Column], converged: np.ndarray) -> str:
    """Columns as text; rows that did not converge (T,) are marked."""
    if not np.all(converged):
        columns = (*columns, Column("", ["" if good else "NOT CONVERGED" for good in converged]))
    return text_table([c.heading for c in columns], list(zip(*(c.cells() for c in columns), strict=True)), right=True,
                      rule=False)


def text(result: PressResult) -> str:
    """The result for people."""
    return "\n".join([table(result.columns, result.converged), *result.words,
                      *(f"note: {sentence}" for sentence in result.notes)])
