"""The synthetic palpation that the estimators are compared on: observation matrices, readings and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from measurements.palpation import layer_with_inclusion, palpate
from vsfsim.core.errors import VsfError
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.sticking import stick

NOISE, MEAN, STD = 0.05, 20.0, 30.0
"""Standard deviation of a reading [N]; mean and standard deviation of the prior [N/m]."""


@dataclass(frozen=True)
class Workload:
    """Observation matrices of a synthetic palpation, z = W K + noise; T frames of all touches, n particles."""

    pressure: sparse.csr_matrix
    """W of the force sums (T, n) [m]."""
    pressure_z: np.ndarray
    """Their readings (T,) [N]."""
    touch: np.ndarray
    """Number of the touch of each frame (T,)."""
    dense: sparse.csr_matrix
    """W of the contact forces on N vertices (3 N T, n) [m]."""
    dense_z: np.ndarray
    """Their readings (3 N T,) [N]."""
    frame: int
    """Rows of ``dense`` in a frame [-]."""
    frames: int
    """Frames of a touch [-]."""

    @classmethod
    def of(cls, particles: int, touches: int, frames: int, *, seed: int = 0) -> Workload:
        """About ``particles`` particles in a 16 x 12 x 1.5 cm volume under ``touches`` presses of ``frames`` frames.

        Raises:
            VsfError: a size below 1, or fewer than two frames.
        """
        points, spacing = volume_points(particles, touches, frames)
        field = layer_with_inclusion()
        truth = field(points) * spacing**3
        sums, forces, vertices = [], [], 0
        for t in palpate(field, touches=touches, frames=frames, extent=(0.12, 0.08), substeps=1, seed=seed):
            contacts, vertices = stick(points, t.vertices, t.triangles), t.vertices.shape[1]
            sums.append(force_sum_rows(contacts.displacements(), len(points)))
            forces.append(dense_force_rows(contacts, len(points), t.triangles, vertices))
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
        pressure, dense = sparse.vstack(sums).tocsr(), sparse.vstack(forces).tocsr()
        z = [w @ truth + NOISE * rng.standard_normal(w.shape[0]) for w in (pressure, dense)]
        return cls(pressure, z[0], np.repeat(np.arange(touches), frames), dense, z[1], 3 * vertices, frames)

    def first(self, touches: int) -> Workload:
        """The same with the first ``touches`` touches only."""
        rows = touches * self.frames
        return Workload(self.pressure[:rows], self.pressure_z[:rows], self.touch[:rows], self.dense[:rows * self.frame],
                        self.dense_z[:rows * self.frame], self.frame, self.frames)

    @property
    def touches(self) -> int:
        """How many there are."""
        return len(self.pressure_z) // self.frames


def volume_points(particles: int, touches: int, frames: int) -> tuple[np.ndarray, float]:
    """About ``particles`` points (n, 3) [m] on a lattice under z = 0, 16 x 12 x 1.5 cm, and its spacing [m].

    Raises:
        VsfError: a size of the workload is below 1, or there are fewer than two frames.
    """
    if min(particles, touches) < 1 or frames < 2:
        raise VsfError(f"measure methods: {particles} particles, {touches} touches, {frames} frames; give at least "
                       f"1, 1 and 2.")
    spacing = (0.16 * 0.12 * 0.015 / particles) ** (1 / 3)
    axes = [np.arange(-half + 0.5 * spacing, half, spacing) for half in (0.08, 0.06)]
    axes.append(np.arange(-0.015 + 0.5 * spacing, 0.0, spacing))
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), spacing
