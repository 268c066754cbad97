"""One cell of the trust map: a press as a user makes it against the same press on a finer mesh and path."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from measurements.stability.team import Late, processor_time
from measurements.trust.design import Press, press
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.shape import MeshFile
from vsfsim.core.shape import extent as bounds
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import PressRequest, PressResult
from vsfsim.physics import tiers

HOPELESS = 2.0
"""A press ends when the time that its frames will take, by those done, is this many times its limit."""
LATE = "took too long"
"""The last words on a cell that came to its limit."""
FINER = 0.7
"""Element size of the reference, at tier fem, over the smaller of the press's own and the tier's."""
FRAMES = 3
"""Frames of each part of the path that the reference has at least."""
WRONG = 0.10
"""Error from which a frame that is not marked is wrong in silence [-]."""
LEAST = 0.75
"""Largest element of a reference, over the press's own [-]."""
CUBES = (3_000, 6_500)
"""Cubes of an element's size in the bounding box of a reference: no more than the first, 15,000 tetrahedra, but where
`LEAST` needs them, or where a probe has edges; a cell that needs more than the second has no reference."""
SURE = 0.04
"""Largest estimated error of a reference by its mesh [-]; past it the cell has none."""
SMALL = 0.1
"""Forces count as this part of the largest of the reference at least [-]."""


@dataclass(frozen=True)
class Verdict:
    """What became of one cell."""

    number: int
    outcome: str
    """"sound", "wrong", "marked" (every frame is), "no reference", "not judged" (the press took too long), "refused" or
    "crashed"."""
    kinds: tuple[str, ...] = ()
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


class _NoReference(Exception):
    """Why there is none, in words."""


def extent(sample: Scene) -> np.ndarray:
    """Edges of the object's bounding box (3,) [m]."""
    shape = sample.object.shape
    if isinstance(shape, MeshFile):
        from vsfsim.physics.mesh.repair import extents

        return extents(shape)
    return np.array(bounds(shape))


def judge(cell: tuple[int, int], *, limit: float) -> Verdict:
    """Press a cell, a seed and a number, and its reference; ``limit`` of the processor time of each [s]. What goes
    wrong is a verdict, too."""
    began, (seed, number) = time.process_time(), cell
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        one = press(seed, number, folder)
        found = Verdict(number, "crashed", one.kinds)
        try:
            found = _judge(number, one, folder, limit)
        except _NoReference as why:
            found = dataclasses.replace(found, outcome="no reference", words=str(why))
        except VsfsimError as error:
            found = dataclasses.replace(found, outcome="refused", words=str(error))
        except Late:
            found = dataclasses.replace(found, outcome="not judged", words=f"the press {LATE}")
        except Exception as error:  # of any cell that a user could write: it counts, and the others go on
            found = dataclasses.replace(found, words=f"{type(error).__name__}: {error}")
    return dataclasses.replace(found, seconds=time.process_time() - began)


def _judge(number: int, cell: Press, folder: Path, limit: float) -> Verdict:
    sample = cell.scene(folder).sample(0)
    size = tiers.element_size(sample.object, cell.tier, sample.probe)
    least, (usual, most) = LEAST * cell.coarse * size, (np.prod(extent(sample)) / np.array(CUBES)) ** (1.0 / 3.0)
    finest = min(max(FINER * min(size, tiers.element_size(sample.object, "fem", sample.probe)), float(usual)), least)
    if finest < most:
        raise _NoReference("it would be too large")
    own = cell.scene(folder, resolution=None if cell.coarse == 1.0 else cell.coarse * size)
    pressed = _press(own, cell.tier, folder, limit)
    if pressed.resolved is not None and not _trusted(pressed).any():
        return Verdict(number, "marked", cell.kinds, told=1.0, words="; ".join(_figures(pressed)))
    try:
        exact = _press(cell.scene(folder, times=_times(cell), resolution=max(finest, 1e-5)), "fem", folder, limit)
    except Late:
        raise _NoReference(f"it {LATE}") from None
    except VsfsimError as error:
        raise _NoReference(f"it was refused: {error}") from None
    return _compare(number, cell, pressed, exact)


def _press(scene: SceneFile, tier: str, folder: Path, limit: float) -> PressResult:
    began = time.process_time()

    def hopeless(done: int, total: int, what: str) -> None:
        if what == "frames" and (time.process_time() - began) * total > HOPELESS * limit * max(done, 1):
            raise Late

    with processor_time(limit):
        return effector_of(scene.sample(0)).press(scene, PressRequest(tier=tier, cache=folder, seconds=limit,
                                                                      progress=hopeless))


def _trusted(own: PressResult) -> np.ndarray:
    """Which frames are not marked (T,) bool."""
    told = "no longer small strain" in "".join(own.words)
    assert own.resolved is not None
    return own.converged & own.resolved & (not told)


def _figures(*results: PressResult) -> list[str]:
    """What notes say of the mesh's faults, with a figure."""
    return [note for result in results for note in result.notes if "off by" in note or " too " in note]


def _times(cell: Press) -> tuple[int, ...]:
    """So many frames has the reference for one of each part of the path."""
    return tuple(-(-FRAMES // n) for n in cell.frames)


def _compare(number: int, cell: Press, own: PressResult, exact: PressResult) -> Verdict:
    times = _times(cell)
    at = np.cumsum(np.repeat((*times, times[0]), (*cell.frames, cell.retract))) - 1
    known = exact.converged[at]
    if own.resolved is None or not known.any():
        return Verdict(number, "no reference", cell.kinds, words="it did not converge")
    force, size = exact.force[at], np.linalg.norm(exact.force[at], axis=1)
    large = float(np.nanmax(size))
    if large == 0.0:
        return Verdict(number, "sound" if (own.force[own.converged] == 0.0).all() else "wrong", cell.kinds, error=0.0)
    error = np.linalg.norm(own.force - force, axis=1) / np.maximum(size, SMALL * large)
    trusted = _trusted(own)
    sure = known & ~(np.asarray(exact.more["mesh_error"])[at] > SURE)
    touch = (size > 0.0) | (own.force != 0.0).any(axis=1)
    judged = trusted & sure & touch
    marked = ~trusted & sure & np.isfinite(error)
    told = float(1.0 - trusted.mean())
    most = float(error[judged].max()) if judged.any() else None
    outcome = "wrong" if most is not None and most > WRONG else "sound"
    if most is None:
        outcome = "marked" if not (trusted & touch).any() else "no reference"
    words = "; ".join([str([round(float(e), 3) for e in error]), *_figures(own, exact)])
    return Verdict(number, outcome, cell.kinds, most, told, float(error[marked].max()) if marked.any() else None, words)
