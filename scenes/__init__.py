"""Scenes: TOML files, and procedural families as Python files with a function build, whose tables are TOML, too."""

from pathlib import Path
from typing import Any

import msgspec


def table(name: str, kind: Any) -> Any:
    """The tables of ``tables/NAME.toml`` by their name, each of class ``kind``."""
    text = Path(__file__).with_name("tables").joinpath(f"{name}.toml").read_bytes()
    return msgspec.toml.decode(text, type=dict[str, kind])
