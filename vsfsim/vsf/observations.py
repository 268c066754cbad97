"""Observation rows of whole touches: what the table of `vsfsim.bench.observations` names under ``rows``.

Each function moves the particles of one object through one touch and returns W (T d, n), frame by frame: W times the
particles' stiffnesses [N/m] is the reading times the ``force_per_unit`` of its table row. All have one signature, so
that a caller needs the table only. `vsfsim.vsf.observe` has the algebra of the rows.

Of an arm, each capsule displaces particles by the stick-slip motion of `vsf.dynamics`. A particle in contact with
several capsules moves with the one that displaces it most. A particle in contact with link l loads only the joints
before l.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from scipy import sparse

from vsfsim.core.chain import Chain
from vsfsim.core.errors import VsfError
from vsfsim.core.shape import Capsule, ProbeShape
from vsfsim.vsf.dynamics import simulate, simulate_each
from vsfsim.vsf.observe import force_sum_rows, joint_torque_rows, normal_force_rows
from vsfsim.vsf.sticking import Displacements


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
    return arm_torque_rows_each(particles, motion.probe, [motion.q], friction=friction, device=device)[0]


def arm_displacements_each(particles: np.ndarray, chain: Chain, touches: Sequence[np.ndarray], *, friction: float,
                           device: str = "cpu", max_step: float = 2e-3) -> list[list[tuple[int, Displacements]]]:
    """The displaced particles of every frame of several touches, each through particles at rest, by the link in contact
    with them: (link, displacements) of the links that displace any. On a GPU together, see `dynamics.simulate_each`.

    Args:
        particles: at rest (n, 3) [m]. chain: the arm. touches: its joint angles, each (T, dof) [rad]. friction: [-].
        device: Warp device. max_step: see `dynamics.simulate` [m].
    """
    low, high = (particles.min(axis=0), particles.max(axis=0)) if len(particles) else (np.zeros(3), np.zeros(3))
    moves: list[tuple[Capsule, np.ndarray]] = []
    which: list[tuple[int, int, int, int]] = []
    for number, q in enumerate(touches):
        poses = chain.capsule_poses(chain.links(q))
        for k, capsule in enumerate(chain.capsules):
            if chain.joints[capsule.link] < 0 and not chain.moves(capsule.link).any():
                continue  # the base turns no joint
            length = float(np.linalg.norm(np.subtract(capsule.stop, capsule.start)))
            reach = capsule.radius + 0.5 * length
            centre = poses[:, k, :3, 3]
            near = np.flatnonzero(((centre + reach >= low) & (centre - reach <= high)).all(axis=1))
            if not len(near):
                continue
            # frames before the first and after the last that can reach a particle are left out
            begin, end = max(0, near[0] - 1), min(len(q), near[-1] + 2)
            moves.append((Capsule(capsule.radius, length), poses[begin:end, k]))
            which.append((number, capsule.link, begin, end))
    found: list[list[tuple[int, Displacements]]] = [[] for _ in touches]
    every = simulate_each(particles, moves, friction=friction, device=device, max_step=max_step)
    for (number, link, begin, end), moved in zip(which, every, strict=True):
        if len(moved.particle):
            pointer = np.concatenate([np.zeros(begin, np.int64), moved.pointer,
                                      np.full(len(touches[number]) - end, moved.pointer[-1])])
            found[number].append((link, Displacements(pointer, moved.particle, moved.displacement)))
    return [_assigned(some, len(q)) for some, q in zip(found, touches, strict=True)]


def _assigned(found: list[tuple[int, Displacements]], frames: int) -> list[tuple[int, Displacements]]:
    """The displacements by link, with each particle in each frame assigned to the capsule that displaces it most."""
    if not found:
        return []
    link = np.concatenate([np.full(len(d.particle), number) for number, d in found])
    frame = np.concatenate([np.repeat(np.arange(frames), np.diff(d.pointer)) for _, d in found])
    particle = np.concatenate([d.particle for _, d in found])
    moved = np.concatenate([d.displacement for _, d in found])
    order = np.lexsort((-np.linalg.norm(moved, axis=1), particle, frame))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(frame[order]) != 0) | (np.diff(particle[order]) != 0)
    order = order[first]
    out = []
    for number in np.unique(link):
        mine = order[link[order] == number]
        if len(mine):
            pointer = np.concatenate([[0], np.cumsum(np.bincount(frame[mine], minlength=frames))]).astype(np.int64)
            out.append((int(number), Displacements(pointer, particle[mine], moved[mine])))
    return out


def arm_torque_rows_each(particles: np.ndarray, chain: Chain, touches: Sequence[np.ndarray], *, friction: float,
                         device: str = "cpu", max_step: float = 2e-3) -> list[sparse.csr_matrix]:
    """W (T dof, n) [m^2] of several touches, each through particles at rest, frame by frame: times stiffnesses [N/m] it
    gives the torques [N m] of the contact on the joints (SBML eq. 7)."""
    out = []
    every = arm_displacements_each(particles, chain, touches, friction=friction, device=device, max_step=max_step)
    for q, found in zip(touches, every, strict=True):
        axes, origins = chain.joint_axes(chain.links(q))
        total = sparse.csr_matrix((len(q) * chain.dof, len(particles)))
        for link, moved in found:
            total = total + joint_torque_rows(moved, particles, np.where(chain.moves(link)[None, :, None], axes, 0.0),
                                              origins)
        out.append(sparse.csr_matrix(total))
    return out
