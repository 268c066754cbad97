"""Arrays and pictures as text inside a page."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np

STEPS = 65535
"""The largest number of 16 bits: a length is kept to the span of its column over this."""


def base64_of(array: np.ndarray) -> str:
    """The bytes of an array in row-major order, numbers of several bytes in little-endian order, as base64."""
    return base64.b64encode(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()).decode()


def quantised(values: np.ndarray) -> dict[str, Any]:
    """Rows (n, k) as 16-bit numbers: value = low + data / `STEPS` * span, to half a step, column by column.

    Returns:
        ``low`` (k,), ``span`` (k,) and ``data``, the base64 of (n, k) uint16.
    """
    values = np.asarray(values, float)
    low = values.min(axis=0) if len(values) else np.zeros(values.shape[1])
    span = np.maximum(values.max(axis=0) - low, 1e-12) if len(values) else np.ones(values.shape[1])
    return {"low": low.tolist(), "span": span.tolist(),
            "data": base64_of(np.rint((values - low) / span * STEPS).astype(np.uint16))}


def values_of(table: dict[str, Any]) -> np.ndarray:
    """The rows (n, k) of what `quantised` made."""
    raw = np.frombuffer(base64.b64decode(table["data"]), "<u2").reshape(-1, len(table["low"]))
    return np.array(table["low"]) + raw / STEPS * np.array(table["span"])


def rounded(values: np.ndarray, digits: int) -> Any:
    """Numbers as lists, rounded to ``digits`` decimals; None where there is none (NaN, infinite)."""
    values = np.asarray(values, float)
    if values.ndim:
        return [rounded(part, digits) for part in values]
    return round(float(values), digits) + 0.0 if np.isfinite(values) else None
