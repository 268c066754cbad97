"""Observation rows of whole touches: what the table of `vsfsim.bench.observations` names under ``rows``.

Each function moves the particles of one object through one touch and returns W (T d, n), frame by frame: W times the
particles' stiffnesses [N/m] is the reading times the ``force_per_unit`` of its table row. All have one signature, so
that a caller needs the table only. `vsfsim.vsf.observe` has the algebra of the rows.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from scipy import sparse

from vsfsim.core.chain import Chain
from vsfsim.core.errors import VsfError
from vsfsim.core.shape import ProbeShape
from vsfsim.vsf.arm_rows import arm_torque_rows
from vsfsim.vsf.dynamics import simulate
from vsfsim.vsf.observe import force_sum_rows, normal_force_rows


class Motion(Protocol):
    """What is known of a touch before it is made; `vsfsim.bench.method.Action` is one."""

    @property
    def poses(self) -> np.ndarray:
        """Probe-to-world transforms (T, 4, 4) [m]."""

    @property
    def axis(self) -> np.ndarray:
        """Unit press direction, world (3,)."""

    @property
    def probe(self) -> ProbeShape:
        """The shape that moves."""

    @property
    def q(self) -> np.ndarray | None:
        """Joint angles of an arm (T, dof) [rad], or None."""


def normal_force(particles: np.ndarray, motion: Motion, *, friction: float, device: str) -> sparse.csr_matrix:
    """Rows (T, n) [m] of the force against the press direction; ``particles`` (n, 3) [m], ``friction`` [-]."""
    moved = simulate(particles, motion.probe, motion.poses, friction=friction, device=device)
    return normal_force_rows(moved, len(particles), motion.axis)


def force_sum(particles: np.ndarray, motion: Motion, *, friction: float, device: str) -> sparse.csr_matrix:
    """Rows (T, n) [m] of the sum of the force magnitudes, the papers' pressure up to a factor (SBML eq. 8)."""
    moved = simulate(particles, motion.probe, motion.poses, friction=friction, device=device)
    return force_sum_rows(moved, len(particles))


def joint_torque(particles: np.ndarray, motion: Motion, *, friction: float, device: str) -> sparse.csr_matrix:
    """Rows (T dof, n) [m^2] of the joint torques, with contact along the whole arm (SBML eq. 7).

    Raises:
        VsfError: the probe is not an arm, or the touch has no joint angles.
    """
    if not isinstance(motion.probe, Chain) or motion.q is None:
        raise VsfError("joint torques need an arm: a touch with joint angles, and the arm's chain as its probe.")
    return arm_torque_rows(particles, motion.probe, motion.q, friction=friction, device=device)
