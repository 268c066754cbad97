"""Observation matrices of a VSF: a sensor's reading is linear in the stiffnesses, z = W K.

Each function computes the rows of W of one touch from its displacements; stack touches with `scipy.sparse.vstack`.

    force_sum_rows      SBML eq. 8         sum of |f_i|: the papers' pressure, up to a factor
    normal_force_rows                      force along an axis
    joint_torque_rows   SBML eq. 7         J^T f at the joints of an arm
    dense_force_rows    Neural VSF eq. 3   forces on the vertices of a sensor's surface
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from vsfsim.core.errors import VsfError
from vsfsim.vsf.sticking import Contacts, Displacements


def force_sum_rows(displacements: Displacements, particles: int) -> sparse.csr_matrix:
    """Rows of the pressure model, W[t, i] = |u_i| (SBML eq. 8).

    Args:
        displacements: of one touch.
        particles: how many particles the VSF has, n.

    Returns:
        W (T, n) [m]: times stiffnesses [N/m] it gives a sum of force magnitudes [N]. The stiffness absorbs the factor
        between that and a sensor's pressure, as in the paper.
    """
    return _rows(displacements, np.linalg.norm(displacements.displacement, axis=1), particles)


def normal_force_rows(displacements: Displacements, particles: int, axis: np.ndarray) -> sparse.csr_matrix:
    """Rows of the force along an axis, W[t, i] = u_i . axis.

    Args:
        displacements: of one touch.
        particles: how many particles the VSF has, n.
        axis: unit press direction, world (3,), or one a frame (T, 3) [-]; then W K is the force with which the object
            resists the press. Over the area of a bubble's base it is openvsf's pressure [Pa]: 7.1827e-3 m^2 for its
            mesh of the Punyo alone, 6.6019e-3 m^2 for that on the arm, whose frame is tilted
            (references/openvsf_base_area.json).

    Returns:
        W (T, n) [m]. Entries may be negative (a particle dragged against the axis).

    Raises:
        VsfError: the axis is not a unit vector, or one a frame.
    """
    axis = np.asarray(axis, np.float64)
    shapes = ((3,), (displacements.frames, 3))
    if axis.shape not in shapes or not (np.abs(np.linalg.norm(axis, axis=-1) - 1.0) < 1e-6).all():
        raise VsfError(f"vsf.normal_force_rows: axis is {axis.tolist()}; give a unit vector (3,), the press direction "
                       f"in the world, or one a frame, ({displacements.frames}, 3).")
    if axis.ndim == 1:
        return _rows(displacements, displacements.displacement @ axis, particles)
    frame = np.repeat(np.arange(displacements.frames), np.diff(displacements.pointer))
    values = np.einsum("ki,ki->k", displacements.displacement, axis[frame])
    return _rows(displacements, values, particles)


def joint_torque_rows(displacements: Displacements, rest: np.ndarray, axes: np.ndarray,
                      origins: np.ndarray) -> sparse.csr_matrix:
    """Rows of the joint torques, W[(t, j), i] = -J_i^T u_i (SBML eq. 7): the torque of the contact on joint j in frame
    t.

    Column j of J(p) is axis_j x (p - origin_j) for a revolute joint; the force of particle i on the arm is -K_i u_i at
    p_i = p0_i + u_i.

    Args:
        displacements: of one touch.
        rest: positions of all particles, world (n, 3) [m].
        axes: unit axis of every joint in every frame, world (T, J, 3) [-]; zero for a joint past the touched link,
            which has no torque.
        origins: a point on each of them, world (T, J, 3) [m].

    Returns:
        W (T J, n) [m^2], frame by frame: times stiffnesses [N/m] it gives torques [N m].
    """
    frames = displacements.frames
    joints = axes.shape[1]
    frame = np.repeat(np.arange(frames), np.diff(displacements.pointer))
    u = displacements.displacement
    arm = (rest[displacements.particle] + u)[:, None] - origins[frame]
    torque = -np.einsum("kji,ki->kj", np.cross(axes[frame], arm), u)
    row = frame[:, None] * joints + np.arange(joints)
    column = np.broadcast_to(displacements.particle[:, None], row.shape)
    return sparse.csr_matrix((torque.ravel(), (row.ravel(), column.ravel())), shape=(frames * joints, len(rest)))


def dense_force_rows(contacts: Contacts, particles: int, triangles: np.ndarray, vertices: int) -> sparse.csr_matrix:
    """Rows of the forces on a sensor's vertices, W[(t, v, x), i] = -(A_i^T u_i)[v, x] (Neural VSF eq. 3, by virtual
    work).

    A particle is held by three vertices, so a column has 9 entries a frame.

    Args:
        contacts: of one touch. particles: how many particles the VSF has, n.
        triangles: corners (m, 3), as given to `stick`. vertices: how many the surface has, N.

    Returns:
        W (T N 3, n) [m], frame by frame, vertex by vertex, x y z: times stiffnesses [N/m] it gives the force of the
        object on each vertex, world [N].
    """
    frames = contacts.frames
    frame = np.repeat(np.arange(frames), np.diff(contacts.pointer))
    values = -contacts.weight[:, :, None] * contacts.displacement[:, None, :]
    row = ((frame[:, None] * vertices + triangles[contacts.triangle])[:, :, None] * 3 + np.arange(3))
    column = np.broadcast_to(contacts.particle[:, None, None], row.shape)
    return sparse.csr_matrix((values.ravel(), (row.ravel(), column.ravel())), shape=(frames * vertices * 3, particles))


def _rows(displacements: Displacements, values: np.ndarray, particles: int) -> sparse.csr_matrix:
    shape = (displacements.frames, particles)
    return sparse.csr_matrix((values, displacements.particle, displacements.pointer), shape=shape)
