"""A press in words: the table of its frames, whether it can be trusted, and notes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.core.text_table import text_table
from vsfsim.generate.press_result import Column, PressResult


def table(columns: Sequence[Column], converged: np.ndarray, resolved: np.ndarray | None = None) -> str:
    """Columns as text; rows that did not converge (T,), or are not resolved by the mesh (T,), are marked."""
    if any(found := marks(converged, resolved)):
        columns = (*columns, Column("", found))
    return text_table([c.heading for c in columns], list(zip(*(c.cells() for c in columns), strict=True)), right=True,
                      rule=False)


def marks(converged: np.ndarray, resolved: np.ndarray | None) -> list[str]:
    """What is wrong with each frame (T,), in two words; empty for a good one."""
    mesh = np.ones(len(converged), bool) if resolved is None else resolved
    return ["NOT CONVERGED" if not good else "" if held else "NOT RESOLVED"
            for good, held in zip(converged, mesh, strict=True)]


def text(result: PressResult) -> str:
    """The result for people."""
    return "\n".join([table(result.columns, result.converged, result.resolved), *result.words,
                      *(f"note: {sentence}" for sentence in result.notes)])
