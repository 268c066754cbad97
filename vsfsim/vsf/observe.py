"""Observation matrices of a VSF: what a sensor reads is linear in the stiffnesses, z = W K.

Each function turns the displacements of one touch into its rows of W; stack touches with `scipy.sparse.vstack`.
The papers' other two models fit the same form: joint torques, rows -J(p)^T u (SBML eq. 7), and dense forces,
three rows a sensor vertex (Neural VSF section III-B).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from vsfsim.vsf.dynamics import Displacements, VsfError


def force_sum_rows(displacements: Displacements, particles: int) -> sparse.csr_matrix:
    """Rows of the pressure model, W[t, i] = |u_i| (SBML eq. 8).

    Args:
        displacements: of one touch.
        particles: how many particles the VSF has, n.

    Returns:
        W (T, n) [m]: times stiffnesses [N/m] it gives a sum of force magnitudes [N], and whatever factor a sensor's
        pressure has to that is taken up by the stiffness, as in the paper.

    Raises:
        VsfError: a displaced particle is not among the n.
    """
    return _rows(displacements, np.linalg.norm(displacements.displacement, axis=1), particles, "force_sum_rows")


def normal_force_rows(displacements: Displacements, particles: int, axis: np.ndarray) -> sparse.csr_matrix:
    """Rows of the force along an axis, W[t, i] = u_i . axis.

    Args:
        displacements: of one touch.
        particles: how many particles the VSF has, n.
        axis: unit press direction, world (3,) [-]; then W K is the force with which the object resists the press.

    Returns:
        W (T, n) [m]. Entries may be negative (a particle dragged against the axis).

    Raises:
        VsfError: a displaced particle is not among the n, or the axis is not a unit vector.
    """
    axis = np.asarray(axis, np.float64)
    if axis.shape != (3,) or not abs(float(np.linalg.norm(axis)) - 1.0) < 1e-6:
        raise VsfError(f"vsf.normal_force_rows: axis is {axis.tolist()}; give a unit vector (3,), the press direction in the world.")
    return _rows(displacements, displacements.displacement @ axis, particles, "normal_force_rows")


def _rows(displacements: Displacements, values: np.ndarray, particles: int, where: str) -> sparse.csr_matrix:
    if len(displacements.particle) and int(displacements.particle.max()) >= particles:
        raise VsfError(
            f"vsf.{where}: the touch displaces particle {int(displacements.particle.max())}, but the VSF is said to have "
            f"{particles}; give the number of particles that `simulate` was run with."
        )
    shape = (displacements.frames, particles)
    return sparse.csr_matrix((values, displacements.particle, displacements.pointer), shape=shape)
