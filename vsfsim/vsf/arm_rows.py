"""Joint torques of a VSF touched by a whole arm: the particles that its capsules displace, and the rows of SBML eq. 7.

Each capsule displaces particles by the stick-slip motion of `vsf.dynamics`. A particle in contact with several capsules
moves with the one that displaces it most. A particle in contact with link l loads only the joints before l.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse

from vsfsim.core.chain import Chain
from vsfsim.core.shape import Capsule
from vsfsim.vsf.displacements import Displacements
from vsfsim.vsf.dynamics import simulate_each
from vsfsim.vsf.observe import joint_torque_rows


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


def arm_torque_rows(particles: np.ndarray, chain: Chain, q: np.ndarray, *, friction: float, device: str = "cpu",
                    max_step: float = 2e-3) -> sparse.csr_matrix:
    """W (T dof, n) [m^2], frame by frame: times stiffnesses [N/m] it gives the torques [N m] of the contact on the
    joints (SBML eq. 7)."""
    return arm_torque_rows_each(particles, chain, [q], friction=friction, device=device, max_step=max_step)[0]


def arm_torque_rows_each(particles: np.ndarray, chain: Chain, touches: Sequence[np.ndarray], *, friction: float,
                         device: str = "cpu", max_step: float = 2e-3) -> list[sparse.csr_matrix]:
    """`arm_torque_rows` of several touches, each through particles at rest."""
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
