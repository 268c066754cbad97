"""Where a touch moves the particles of a VSF: the result of every motion model, and the input of every observation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Displacements:
    """The displaced particles of each frame of a touch, in CSR form."""
    pointer: np.ndarray
    """Entries of frame t are pointer[t] : pointer[t + 1] (T + 1,) int64."""
    particle: np.ndarray
    """Index of the displaced particle, increasing within a frame (k,) int64."""
    displacement: np.ndarray
    """u = p - p0 of that particle, world (k, 3) float64 [m]."""

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.pointer) - 1

    def frame(self, t: int) -> tuple[np.ndarray, np.ndarray]:
        """Particles (j,) and displacements (j, 3) [m] of frame ``t``."""
        part = slice(self.pointer[t], self.pointer[t + 1])
        return self.particle[part], self.displacement[part]
