"""What a dataset will cost: CPU time and bytes of a view, learned from the views that this machine has made.

Every finished view adds a line to a file of the user's cache ($VSFSIM_COSTS): scene, tier, device, kind of machine,
code, touches, CPU seconds and bytes. Views of other code do not count: a solver that became faster misleads. A view
costs a part of its own (meshing, picture, truth) and a part a touch; with views of one number of touches alone, all is
taken for the touches'.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.core.plain_text import from_json
from vsfsim.data.provenance import made_by, processor
from vsfsim.data.recipe import Recipe

_LATEST = 200
"""Views that the model is fitted to, the latest ones."""


@dataclass(frozen=True)
class Cost:
    """What making some views will take on one kind of machine."""

    views: int
    """Object views."""
    touches: int
    """Touches of all of them."""
    cpu_seconds: float
    """CPU time of all of them [s]."""
    bytes: float
    """On disk [bytes]."""
    seen: int
    """Views that the figures rest on."""
    spread: float
    """Standard deviation of the CPU time of one view over its fit [-]."""

    def hours(self, workers: int, machines: int = 1) -> float:
        """Time on the clock [h] of ``machines`` with ``workers`` processes each, which take whole views."""
        rounds = -(-self.views // (workers * machines))
        return rounds * self.cpu_seconds / self.views / 3600.0

    def text(self, workers: int, machines: int, price: float | None) -> str:
        """For the terminal; ``price`` is that of a machine's hour."""
        lines = [f"{self.views} object views, {self.touches} touches, {self.bytes / 1e6:.1f} MB, "
                 f"{self.cpu_seconds / 3600.0:.2f} CPU hours (from {self.seen} views of this scene on this kind of "
                 f"machine, whose times scatter by {100.0 * self.spread:.0f} %)"]
        for count in dict.fromkeys((1, machines)):
            hours = self.hours(workers, count)
            cost = "" if price is None else f", {hours * count * price:.2f} at {price:g} a machine's hour"
            lines.append(f"{count} machine{'s' * (count > 1)} with {workers} processes: {hours:.2f} h{cost}")
        return "\n".join(lines)

    def table(self, workers: int, machines: int, price: float | None) -> dict[str, Any]:
        """For JSON."""
        return {**asdict(self), "workers": workers, "machines": machines, "hours": self.hours(workers, machines),
                "price": None if price is None else self.hours(workers, machines) * machines * price}


def stored() -> Path:
    """The file of the costs."""
    return Path(os.environ.get("VSFSIM_COSTS") or Path.home() / ".cache" / "vsfsim" / "costs.jsonl")


def record(recipe: Recipe, seconds: float, size: int) -> None:
    """Add a finished view. A disk that refuses is no reason to lose the view: nothing is then added.

    Args:
        recipe: of the dataset. seconds: CPU time of its process. size: of its file [byte].
    """
    line = json.dumps({"key": _key(recipe), "touches": recipe.touches, "seconds": seconds, "bytes": size})
    with contextlib.suppress(OSError):
        stored().parent.mkdir(parents=True, exist_ok=True)
        with open(stored(), "a") as file:  # one short write, so that lines of several processes do not mix
            file.write(line + "\n")


def estimate(recipe: Recipe, views: int) -> Cost:
    """The cost of ``views`` views of a recipe.

    Raises:
        DatasetError: no view of this scene was made on this kind of machine yet.
    """
    rows = [row for row in _rows() if row["key"] == _key(recipe)][-_LATEST:]
    if not rows:
        raise DatasetError(f"--dry-run: no view of the scene '{recipe.scene}' at tier {recipe.tier} was made by this "
                           f"code on this kind of machine yet, so that nothing is known of its cost. Make one first: "
                           f"vsfsim generate {recipe.scene} --objects 1 --views 1 --touches {min(recipe.touches, 2)} "
                           f"--out /tmp/{recipe.scene}-cost.")
    touches = np.array([row["touches"] for row in rows], float)
    seconds, spread = _fit(touches, np.array([row["seconds"] for row in rows]), recipe.touches)
    size, _ = _fit(touches, np.array([row["bytes"] for row in rows], float), recipe.touches)
    return Cost(views, views * recipe.touches, views * seconds, views * size, len(rows), spread)


def _fit(touches: np.ndarray, values: np.ndarray, wanted: int) -> tuple[float, float]:
    """The value at ``wanted`` touches of a line through the means at each number of touches, never falling, and the
    standard deviation of one view relative to it."""
    counts = np.unique(touches)
    means = np.array([values[touches == n].mean() for n in counts])
    if len(counts) == 1:
        slope, start = means[0] / counts[0], 0.0
    else:
        slope = max(float(np.polyfit(counts, means, 1)[0]), 0.0)
        start = max(float((means - slope * counts).mean()), 0.0)
    apart = values / np.maximum(start + slope * touches, 1e-300) - 1.0
    return start + slope * wanted, float(np.std(apart))


def _key(recipe: Recipe) -> Sequence[str]:
    finer = [f"{name} {recipe.options[name]:.3g}" for name in ("resolution", "contact", "parts")
             if name in recipe.options]
    return [recipe.scene_sha256, recipe.tier, recipe.device, processor(),
            *map(str, made_by().values()), *finer]


def _rows() -> list[dict[str, Any]]:
    out = []
    try:
        lines = stored().read_text(errors="replace").splitlines()
    except OSError:
        return []
    for line in lines:
        with contextlib.suppress(ValueError, TypeError, KeyError):  # a line cut by a full disk
            row = from_json(line)
            if min(row["touches"], row["seconds"], row["bytes"]) > 0 and row["key"]:
                out.append(row)
    return out
