"""What a touch records of its frames besides readings: whether they are equilibria, why not, and the audit."""

from __future__ import annotations

from typing import Any

import numpy as np

from vsfsim.data.records import AUDIT_COLUMNS
from vsfsim.physics.solve.frames import Reason

BALANCE = 1e-3  # design: force on the probe and reaction of the supports agree to this share
OUT_OF_BALANCE = "force on the probe and reaction of the supports differ by over 0.1 %"
REASONS = (*(reason.text for reason in Reason if reason != Reason.NONE), OUT_OF_BALANCE)
"""What the codes of `Touch.reason` mean, from 1: the solver's own reasons keep their codes, the audit's comes after
them."""


def batches(count: int, most: int) -> list[slice]:
    """``count`` touches in batches of at most ``most``, as even as can be; what is solved together fixes the bits."""
    size = -(-count // -(-count // most)) if count else 1
    return [slice(start, start + size) for start in range(0, count, size)]


def audit(frames: Any, column: int, *, frames_kept: int | None = None,
          columns: tuple[str, ...] = AUDIT_COLUMNS) -> dict[str, np.ndarray]:
    """The audit columns (T,) of one touch, by the names of the dataset."""
    return {name: getattr(frames, name)[:frames_kept, column] for name in columns}


def verdict(found: np.ndarray, force_balance: np.ndarray, reason: np.ndarray) -> dict[str, Any]:
    """The fields ``converged``, ``reason`` and ``reason_names`` of a `Touch` of T frames.

    Args:
        found: the solver found an equilibrium of finite readings (T,).
        force_balance: of the audit (T,) [-].
        reason: the solver's code where it did not (T,).
    """
    converged = found & (force_balance <= BALANCE)
    code = np.where(converged, 0, np.where(found, len(REASONS), reason))
    return {"converged": converged, "reason": code, "reason_names": REASONS}
