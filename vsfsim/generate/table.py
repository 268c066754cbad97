"""A result as plain lists and numbers, for JSON."""

from __future__ import annotations

from typing import Any

import numpy as np


def plain(result: Any) -> dict[str, Any]:
    """The fields of a dataclass without its ``state``: arrays and tuples as lists, also those inside a dictionary."""
    return {key: _plain(value) for key, value in vars(result).items() if key != "state"}


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    return list(value) if isinstance(value, tuple) else value
