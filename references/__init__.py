"""Reference values: the data behind every number that a test, a benchmark or a page calls a reference.

`references/README.md` is the index: number, file, script that computes it, who uses it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def load(name: str) -> dict[str, Any]:
    """The contents of ``references/NAME.json``; units are in the keys (`force_N`), `origin` says where it comes from.

    Raises:
        FileNotFoundError: there is no such reference.
    """
    return json.loads((Path(__file__).parent / f"{name}.json").read_text())
