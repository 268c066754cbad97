"""What a dataset was made from: enough to make it again."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from vsfsim.core.errors import DatasetError
from vsfsim.core.system.content import differences
from vsfsim.core.table import typed


@dataclass(frozen=True)
class Recipe:
    """The input of `vsfsim generate`; two datasets of one recipe and one version of the code hold the same bits."""

    scene: str
    """Name of the scene."""
    scene_text: str
    """The whole scene file."""
    seed: int
    """Root of all random streams, >= 0."""
    objects: int
    """Number of objects."""
    views: int
    """Of each object."""
    touches: int
    """Of each view."""
    splits: Mapping[str, int]
    """Number of objects by split, in order."""
    device: str
    """"cpu" or "cuda", the kind that decides the bits."""
    tier: str
    """Fidelity asked for."""
    precision: str
    """"float32" or "float64"."""
    renderer: str
    """"warp" or "pyrender"."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Anything else that changes the numbers, e.g. {"resolution": 0.004}; plain JSON values."""
    files: Mapping[str, str] = field(default_factory=dict)
    """sha256 of every file that the scene names (a mesh) and of the source of every plug-in that it uses, by name."""

    @property
    def scene_sha256(self) -> str:
        """sha256 of the scene text."""
        return text_sha256(self.scene_text)

    def table(self) -> dict[str, Any]:
        """As JSON values; `Recipe.read` takes them back."""
        out = dataclasses.asdict(self)
        out["splits"], out["options"] = dict(self.splits), dict(self.options)
        files = dict(out.pop("files"))
        # without a file as it was before there were any, so that a finished dataset keeps its bytes
        return {**out, "scene_sha256": self.scene_sha256, **({"files": files} if files else {})}

    @classmethod
    def read(cls, table: Any, where: str) -> Recipe:
        """The recipe in a dataset.json.

        Raises:
            DatasetError: a key is missing or unknown, or a value is not allowed.
        """
        return typed(table, cls, f"{where}: the recipe", also=("scene_sha256",), error=DatasetError)

    def differences(self, other: Recipe) -> list[str]:
        """Differences of ``other`` from this recipe, the one on disk; a phrase a field: "seed 0 there, 1 asked for"."""
        out = []
        mine, theirs = self.table(), other.table()
        for key in mine:
            if key == "files" or mine[key] == theirs[key] or key == "scene_text":
                continue
            if key == "scene_sha256":
                out.append(_text_difference(self.scene_text, other.scene_text))
            else:
                out.append(f"{key} {mine[key]!r} there, {theirs[key]!r} asked for")
        return out + differences(self.files, other.files)


def text_sha256(text: str) -> str:
    """sha256 of a text in UTF-8, hexadecimal."""
    return hashlib.sha256(text.encode()).hexdigest()


def _text_difference(there: str, asked: str) -> str:
    for number, (a, b) in enumerate(zip(there.splitlines(), asked.splitlines()), start=1):
        if a != b:
            return f"scene text, first in line {number}: {a.strip()!r} there, {b.strip()!r} asked for"
    return "scene text of another length"
