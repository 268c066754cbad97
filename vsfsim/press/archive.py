"""Every number of a press in one file."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.data.disk import write_atomic
from vsfsim.generate.press_result import PressResult


def save(result: PressResult, path: Path) -> None:
    """Write the arrays of a result that kept them to ``path`` (.npz), with their shapes and units as JSON in ``units``.

    Raises:
        DatasetError: the result kept no arrays, or the file cannot be written.
    """
    if not result.arrays:
        raise DatasetError(f"{path} is not written: the press was made with keep=False. Press again with keep=True.")
    units = {name: words for name, (_, words) in result.arrays.items()}
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {name: values for name, (values, _) in result.arrays.items()}
    np.savez_compressed(buffer, units=np.array(json.dumps(units)), **arrays)
    write_atomic(path, buffer.getvalue())
