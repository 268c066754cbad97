"""One cell of the trust map: a press as a user makes it against the same press on a finer mesh and path."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.trust.design import Press, press
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import Scene
from vsfsim.core.shape import MeshFile
from vsfsim.core.shape import extent as bounds
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import PressRequest, PressResult
from vsfsim.physics import tiers

FINER = 0.7
"""Element size of the reference, at tier fem, over the smaller of the press's own and the tier's."""
FRAMES = 3
"""Frames of each part of the path that the reference has at least."""
WRONG = 0.10
"""Error from which a frame that is not marked is wrong in silence [-]."""
MOST = 8_000
"""Three elements' cubes in the bounding box of a reference: it has 5,000 to 13,000 tetrahedra."""
LEAST = 0.75
"""Largest element of a reference, over the press's own; a cell whose reference would be coarser has none [-]."""
SURE = 0.04
"""Largest estimated error of a reference by its mesh [-]; past it the cell has none."""
SMALL = 0.1
"""Forces count as this part of the largest of the reference at least [-]."""


@dataclass(frozen=True)
class Verdict:
    """What became of one cell."""

    number: int
    outcome: str
    """"sound", "wrong", "marked" (no frame in contact is left unmarked), "no reference", "refused" or "crashed"."""
    kinds: tuple[str, ...]
    """See `Press.kinds`."""
    error: float | None = None
    """Largest error of a frame that is not marked [-]."""
    told: float = 0.0
    """Share of the frames that are marked [-]."""
    marked_error: float | None = None
    """Largest error of a frame that is marked and has a force [-]."""
    words: str = ""
    """The refusal, or what the reference lacks."""
    seconds: float = 0.0
    """Processor time [s]."""

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return dataclasses.asdict(self)


class _TooLarge(Exception):
    """A reference would take minutes."""


def extent(sample: Scene) -> np.ndarray:
    """Edges of the object's bounding box (3,) [m]."""
    shape = sample.object.shape
    if isinstance(shape, MeshFile):
        from vsfsim.physics.mesh.repair import extents

        return extents(shape)
    return np.array(bounds(shape))


def judge(seed: int, number: int, *, limit: float = 60.0) -> Verdict:
    """Press a cell and its reference; ``limit`` of a frame's processor time [s]."""
    began = time.process_time()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cell = press(seed, number, folder)
        try:
            own, exact = _both(cell, folder, limit)
            found = _compare(number, cell, own, exact)
        except _TooLarge:
            found = Verdict(number, "no reference", cell.kinds, words="it would be too large")
        except VsfsimError as error:
            found = Verdict(number, "refused", cell.kinds, words=str(error))
    return dataclasses.replace(found, seconds=time.process_time() - began)


def _both(cell: Press, folder: Path, limit: float) -> tuple[PressResult, PressResult]:
    sample = cell.scene(folder).sample(0)
    size = tiers.element_size(sample.object, cell.tier, sample.probe)
    finest = max(FINER * min(size, tiers.element_size(sample.object, "fem", sample.probe)),
                 float(3.0 * np.prod(extent(sample)) / MOST) ** (1.0 / 3.0))
    if finest > LEAST * cell.coarse * size:
        raise _TooLarge
    own = cell.scene(folder, resolution=None if cell.coarse == 1.0 else cell.coarse * size)
    exact = cell.scene(folder, times=_times(cell), resolution=max(finest, 1e-5))
    press = effector_of(sample).press
    return (press(own, PressRequest(tier=cell.tier, cache=folder, seconds=limit)),
            press(exact, PressRequest(tier="fem", cache=folder, seconds=limit)))


def _times(cell: Press) -> int:
    return -(-FRAMES // min(cell.frames))


def _compare(number: int, cell: Press, own: PressResult, exact: PressResult) -> Verdict:
    at = _times(cell) * np.arange(1, len(own.force) + 1) - 1
    known = exact.converged[at]
    if own.resolved is None or not known.any():
        return Verdict(number, "no reference", cell.kinds, words="it did not converge")
    force, size = exact.force[at], np.linalg.norm(exact.force[at], axis=1)
    large = float(np.nanmax(size))
    if large == 0.0:
        return Verdict(number, "sound" if (own.force[own.converged] == 0.0).all() else "wrong", cell.kinds, error=0.0)
    error = np.linalg.norm(own.force - force, axis=1) / np.maximum(size, SMALL * large)
    trusted = own.converged & own.resolved & ~np.full(len(at), any(told in "".join(own.words) for told in (
        "no longer small strain",)))
    sure = known & ~(np.asarray(exact.more["mesh_error"])[at] > SURE)
    judged = trusted & sure
    marked = ~trusted & sure & np.isfinite(error)
    told = float(1.0 - trusted.mean())
    most = float(error[judged].max()) if judged.any() else None
    outcome = "wrong" if most is not None and most > WRONG else "sound"
    if most is None:
        outcome = "marked" if not trusted.any() else "no reference"
    notes = "; ".join(n for n in (*own.notes, *exact.notes) if "off by" in n or " too " in n)
    return Verdict(number, outcome, cell.kinds, most, told, float(error[marked].max()) if marked.any() else None,
                   f"{[round(float(e), 3) for e in error]} {notes}")
