"""Are two datasets of one recipe the same? Bit by bit, to 1e-3, or not: `vsfsim verify --against`."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.records import Touch, values_of

CLOSE = 1e-3
"""Largest difference of the force, over the largest force of the touch, of touches that count as equal."""


@dataclass(frozen=True)
class Alike:
    """What `compare` found, in touches."""

    equal: int
    """Every reading is equal to the bit."""
    close: int
    """Forces are equal to `CLOSE`."""
    other: int
    """The rest."""
    worst: float
    """Largest relative difference of a force [-]."""
    first: str
    """The first touch that is not equal to the bit, "" if there is none."""
    kinds: tuple[str, ...]
    """Kinds of machines of the first dataset, then of the second."""

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)

    def text(self) -> str:
        """For the terminal."""
        total = max(self.equal + self.close + self.other, 1)
        lines = [f"{name:<18}{n:6d} touches  {100.0 * n / total:5.1f} %" for name, n in
                 (("bit-equal", self.equal), (f"equal to {CLOSE:g}", self.close), ("other", self.other))]
        lines.append(f"largest difference of a force: {self.worst:.1e} of the largest of its touch"
                     + f", first in {self.first}" * bool(self.first))
        return "\n".join([*lines, *(f"made on {kind}" for kind in self.kinds)])


def compare(one: str | Path, other: str | Path, progress: Progress | None = None) -> Alike:
    """Compare two datasets touch by touch. ``progress`` is called with (views done, of how many, name).

    Raises:
        DatasetError: one of them is none, or they are of different recipes or code.
    """
    a, b = Dataset.open(one, progress=progress), Dataset.open(other)
    differences = a.recipe.differences(b.recipe)
    if differences:
        raise DatasetError(f"{one} and {other} are of different recipes: {'; '.join(differences)}.")
    if set(a.names()) != set(b.names()):
        raise DatasetError(f"{one} and {other} hold different object views: "
                           f"{', '.join(sorted(set(a.names()) ^ set(b.names()))[:5])} in one only.")
    counts, worst, first = [0, 0, 0], 0.0, ""
    for view in a:
        for index, (p, q) in enumerate(zip(view.touches, b.load(view.name).touches, strict=True)):
            mine, theirs = values_of(p), values_of(q)
            if mine.keys() == theirs.keys() and all(np.asarray(mine[k]).tobytes() == np.asarray(theirs[k]).tobytes()
                                                    for k in mine):
                counts[0] += 1
                continue
            apart = difference(p, q)
            worst, first = max(worst, apart), first or f"{view.name} touches/{index:03d}"
            counts[1 if apart <= CLOSE else 2] += 1
    kinds = tuple(dict.fromkeys(e.made_on or "not recorded" for data in (a, b) for e in data.entries))
    return Alike(counts[0], counts[1], counts[2], worst, first, kinds)


def difference(one: Touch, other: Touch) -> float:
    """Largest difference of the force over the largest force of a touch [-]; infinite where frames or their marks
    differ."""
    if one.force.shape != other.force.shape or not np.array_equal(one.converged, other.converged):
        return float("inf")
    good = one.converged
    size = float(np.linalg.norm(one.force[good], axis=1).max(initial=0.0))
    apart = float(np.linalg.norm((one.force - other.force)[good], axis=1).max(initial=0.0))
    return apart / size if size > 0.0 else (0.0 if apart == 0.0 else float("inf"))
