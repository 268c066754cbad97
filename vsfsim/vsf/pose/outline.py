"""The pose of a known object on one of its flat sides, from its outline: the loss of Neural VSF eq. 7, seen from above.

Touch reaches a few millimetres deep, and a stiff object under a soft layer stiffens the layer above it before a probe
reaches it. The stiff points of an estimate are therefore a thin sheet above the object, to which a registration of
surfaces fits it in many ways. Such a sheet determines the outline of the object. So the stiffness of each column of
touched points is compared with the outline at all angles and positions,

    L = sum over columns under the outline of max(threshold - K, 0) + threshold * (number of stiff columns outside it)

on a grid first, then by a random search of shrinking steps, of which only improvements are taken. An outline that
covers no stiff column is no answer: it explains none of the contacts, and where nothing was touched it costs nothing.
The threshold makes the same fraction of the columns stiff as the outline has of the area that can be touched, so that
the cover's stiffness need not be known. An object turned over has nearly the same outline, mirrored; that is tried only
on request.
"""

from __future__ import annotations

import numpy as np

from vsfsim.core.errors import VsfError
from vsfsim.vsf.pose.localise import KnownObject, Pose

_ANGLES = 48
"""Angles of the grid, over a whole turn."""
_STEPS, _STEP = 6, 0.004
"""Positions of the grid on either side of the centre of the stiff columns, and their distance [m]."""
_MOST_STIFF = 0.5
"""The largest fraction of the columns that counts as stiff."""
_COLUMNS = 500
"""The most columns that are evaluated on the grid."""


def outline_area(known: KnownObject) -> float:
    """Area of the object's outline from above [m^2]."""
    return float(known.inside.any(axis=2).sum()) * known.cell**2


def outline_pose(known: KnownObject, columns: np.ndarray, stiffness: np.ndarray, *, area: float, top: float,
                 turned: bool = False, refine: int = 400, seed: int = 0) -> Pose:
    """The pose that best explains the stiffness of columns.

    Args:
        known: the object, upright as in its own frame.
        columns: positions of the columns, world (n, 2) [m].
        stiffness: of each column, >= 0 (n,).
        area: the area that can be touched [m^2].
        top: z of the object's upper side [m].
        turned: whether the object may be turned over, about its x axis.
        refine: steps of the random search.
        seed: of the random search.

    Raises:
        VsfError: fewer than 10 columns, or all of one stiffness.
    """
    if len(columns) < 10 or not np.ptp(stiffness) > 0.0:
        raise VsfError(f"vsf.outline: {len(columns)} columns of stiffnesses {np.min(stiffness, initial=0.0):g} to "
                       f"{np.max(stiffness, initial=0.0):g} do not determine a pose; touch more.")
    share = min(outline_area(known) / area, _MOST_STIFF)
    cut = float(np.quantile(stiffness, 1.0 - share))
    if not cut > 0.0:
        cut = float(stiffness[stiffness > 0.0].min())
    stiff = stiffness >= cut
    # What covering a column takes off the loss of an outline that covers nothing.
    gain = np.where(stiff, 1.0, -np.maximum(cut - stiffness, 0.0) / cut)
    flat = np.pad(known.inside.any(axis=2), 1).astype(float)
    middle = np.average(columns[stiff], axis=0)
    shifts = _STEP * np.stack(np.meshgrid(*[np.arange(-_STEPS, _STEPS + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)

    def covered(angle: float, face: int, places: np.ndarray, every: int = 1) -> np.ndarray:
        """Gain (p,) of the outline at positions ``places`` (p, 2), from every ``every``-th column; -inf where it covers
        no stiff one."""
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]) * [1.0, face] / known.cell
        index = (columns[::every] @ turn - known.low[:2] / known.cell)[None] - (places @ turn)[:, None]
        # Columns off the outline's grid fall into the zeros padded around it.
        index = np.clip(np.floor(index).astype(np.int32) + 1, 0, np.array(flat.shape, np.int32) - 1)
        under = flat[index[..., 0], index[..., 1]]
        return np.where((under * stiff[::every]).any(axis=1), (under * gain[::every]).sum(axis=1), -np.inf)

    best, most, every = (0.0, 1, middle), -np.inf, -(-len(columns) // _COLUMNS)
    for face in (1, -1) if turned else (1,):
        for angle in 2.0 * np.pi * np.arange(_ANGLES) / _ANGLES:
            gains = covered(angle, face, middle + shifts, every)
            k = int(np.argmax(gains))
            if gains[k] > most:
                best, most = (angle, face, middle + shifts[k]), float(gains[k])
    most = float(covered(best[0], best[1], best[2][None])[0])
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2,)))
    for step in range(refine):
        size = 20.0 ** (-step / max(refine, 1))
        trial = (best[0] + 0.15 * size * rng.standard_normal(), best[1],
                 best[2] + _STEP * size * rng.standard_normal(2))
        found = float(covered(trial[0], trial[1], trial[2][None])[0])
        if found > most:  # of equal poses the search would drift along
            best, most = trial, found
    angle, face, place = best
    high = known.low[2] + known.cell * (1 + int(np.flatnonzero(known.inside.any(axis=(0, 1)))[-1]))
    low = known.low[2] + known.cell * int(np.flatnonzero(known.inside.any(axis=(0, 1)))[0])
    c, s = np.cos(angle), np.sin(angle)
    out = np.eye(4)
    out[:3, :3] = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ np.diag([1.0, face, face])
    out[:3, 3] = [*place, top - (high if face > 0 else -low)]
    return Pose(out, float(stiff.sum() - most) * cut)
