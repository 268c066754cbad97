"""Rows that a measurement keeps as they are made, so that the same command goes on after an interruption."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.data.disk import write_atomic


class Kept:
    """A file of JSON lines: first the circumstances, then the rows, each with its ``key``. A last line that was cut off
    by an interruption is left out.

    Args:
        file: with its folder made if it is not there.
        circumstances: what must be the same for rows to be comparable.

    Raises:
        VsfsimError: it is no such file, or was made under other circumstances.
    """

    def __init__(self, file: Path, circumstances: Mapping[str, Any]):
        self.file, self.rows = file, dict[str, dict[str, Any]]()
        if file.exists():
            try:
                head, *rows = map(from_json, file.read_text().split("\n")[:-1])
                self.rows, found = {row["key"]: row for row in rows}, dict(head)
            except (ValueError, KeyError, TypeError) as error:
                raise VsfsimError(f"{file} is not a file of this command ({error}). Give another --out.") from None
            for name, value in circumstances.items():
                if found.get(name) != value:
                    raise VsfsimError(f"{file} was made with {name} {found.get(name)!r}, and this run has {value!r}; "
                                      f"their rows cannot be put together. Give another --out, or delete the file.")
        write_atomic(file, "".join(json.dumps(row) + "\n" for row in (circumstances, *self.rows.values())).encode())

    def add(self, row: dict[str, Any]) -> dict[str, Any]:
        """Keep a row."""
        self.rows[row["key"]] = row
        with open(self.file, "a") as file:
            file.write(json.dumps(row) + "\n")
        return row

    def made(self, key: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """The row of a key, which is made if it is not there."""
        return self.rows[key] if key in self.rows else self.add({"key": key, **make()})
