"""What a scan stands on: its base face, or a foot where it is round below."""

from __future__ import annotations

import numpy as np

from vsfsim.core.solid import Solid

BASE = 0.01
"""Height of the part of a scan whose nodes are its base face, over the scan's: below it the filling is cut flat [-]."""
FOOT = 0.05
"""Part of a scan's height that is held where it has no flat base to stand on [-]. A ball of 80 mm then stands on a foot
of 35 mm; with 2 % it was 22 mm, held by a dozen nodes, and a lumpy blob tipped over under 0.4 N."""
NARROW = 1 / 3
"""Part of the body's width or depth under which a base is no face to stand on, and a foot narrow enough for a warning
[-]."""


def scan_foot(solid: Solid) -> tuple[float, str]:
    """What ``fixed = "bottom"`` holds of a scan: its base face, or a foot where the base is round.

    Args:
        solid: the scan in its own frame.

    Returns:
        The height of the part that is held [m], and a sentence, with a warning where it is a narrow foot.
    """
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    height, whole = float(high[2] - low[2]), (high - low)[:2]

    def held(tolerance: float) -> np.ndarray:
        return np.ptp(solid.vertices[solid.vertices[:, 2] <= low[2] + tolerance][:, :2], axis=0)

    body = f"{1e3 * whole[0]:.0f} x {1e3 * whole[1]:.0f} mm"
    base = held(BASE * height)
    if (base >= NARROW * whole).all():
        return BASE * height, (f"fixed = \"bottom\" holds the scan's base face, {1e3 * base[0]:.0f} x "
                               f"{1e3 * base[1]:.0f} mm under a body of {body}.")
    foot = held(FOOT * height)
    note = (f"The scan has no flat base: fixed = \"bottom\" holds its lowest {100 * FOOT:g} %, "
            f"{1e3 * FOOT * height:.1f} mm, a foot of {1e3 * foot[0]:.0f} x {1e3 * foot[1]:.0f} mm under a body of "
            f"{body}.")
    if (foot < NARROW * whole).any():
        box = ", ".join(f"{v:.3f}" for v in (*(low - 0.001), *(high[:2] + 0.001), low[2] + 0.25 * height))
        note += (f" On so narrow a foot the body may tip rather than be indented; fixed = [{box}] would hold its "
                 f"lowest quarter.")
    return FOOT * height, note
