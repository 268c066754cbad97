"""From solved frames to the record of a touch, for every effector: readings, whether each frame is an equilibrium, why
not, and the audit."""

from __future__ import annotations

from typing import Any

import numpy as np

from vsfsim.data.records import AUDIT_COLUMNS, Touch
from vsfsim.physics.solve.frames import Reason
from vsfsim.robot.path import times

BALANCE = 1e-3  # design: force on the probe and reaction of the supports agree to this share
OUT_OF_BALANCE = "force on the probe and reaction of the supports differ by over 0.1 %"
REASONS = (*(reason.text for reason in Reason if reason != Reason.NONE), OUT_OF_BALANCE)
"""What the codes of `Touch.reason` mean, from 1: the solver's own reasons keep their codes, the audit's comes after
them."""


def batches(count: int, most: int) -> list[slice]:
    """``count`` touches in batches of at most ``most``, as even as can be; what is solved together fixes the bits."""
    size = -(-count // -(-count // most)) if count else 1
    return [slice(start, start + size) for start in range(0, count, size)]


def recorded(frames: Any, k: int, poses: np.ndarray, force: np.ndarray, *, found: np.ndarray
             | bool = True, columns: tuple[str, ...] = AUDIT_COLUMNS, **more: Any) -> Touch:
    """The record of touch ``k`` of solved frames.

    Args:
        frames: of the solver; the first T count.
        k: its column.
        poses: of the mount (T, 4, 4) [m].
        force: on the effector (T, 3) [N].
        found: whether the readings of a frame that converged are finite (T,).
        columns: of the audit.
        more: fields of the `Touch` besides those that frames hold.
    """
    kept = slice(len(poses))
    found = frames.converged[kept, k] & found
    converged = found & (frames.force_balance[kept, k] <= BALANCE)
    reason = np.where(found, len(REASONS), np.maximum(frames.reason[kept, k], 1)).astype(np.int64)
    return Touch(time=times(len(poses)), mount_pose=poses, force=force,
                 reaction=frames.reaction[kept, k], residual=frames.residual[kept, k],
                 iterations=frames.iterations[kept, k].astype(np.int64),
                 audit={name: getattr(frames, name)[kept, k] for name in columns},
                 converged=converged, reason=np.where(converged, 0, reason), reason_names=REASONS,
                 **more)
