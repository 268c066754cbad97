"""The visible cloud of a view, or why there is none: the one place where the methods check a view; and a key of what a
method has seen, under which it keeps what it computed from it."""

from __future__ import annotations

import hashlib

import numpy as np

from vsfsim.core.errors import MethodError
from vsfsim.data.records import View


def visible_cloud(view: View) -> np.ndarray:
    """The visible cloud, world (k, 3) [m], with at least one point.

    Raises:
        MethodError: the mask is empty, or a pixel of it has no depth.
    """
    mask = np.asarray(view.mask, bool)
    if not mask.any():
        raise MethodError("the view shows no object: its mask is empty. Point the camera at the object.")
    depth = np.asarray(view.depth, np.float64)[mask]
    lost = int(np.count_nonzero(~(np.isfinite(depth) & (depth > 0.0))))
    if lost:
        raise MethodError(f"the view's depth is 0 or not a number in {lost} of the {depth.size} pixels of its mask; "
                          f"leave them out of the mask.")
    return view.points()


def digest(*arrays: np.ndarray) -> bytes:
    """A hash of the arrays' bytes."""
    out = hashlib.blake2b()
    for array in arrays:
        out.update(np.ascontiguousarray(array).tobytes())
    return out.digest()
