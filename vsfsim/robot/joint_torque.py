"""The kinematic arm: quasi-static joint torques of contact forces, tau = sum of J^T f (SBML, eq. 7).

The joint angles are given, forces do not change them, and the arm's gravity compensation removes its weight. A torque
is that of the contact on the joint, positive in the sense of positive angles; the motor balances it.

For a joint with axis a through the point o, a force f at p and a moment m on a link behind the joint give the torque
a . (m + (p - o) x f); on the links before it they give none.
"""

from __future__ import annotations

import numpy as np

from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm, ArmError, Postures


def body_torque(arm: Arm, at: Postures | np.ndarray, force: np.ndarray, *, moment: np.ndarray | None = None,
                point: np.ndarray | None = None) -> np.ndarray:
    """Joint torques (T, 7) [N m] of the forces and moments on the arm's K capsules.

    Args:
        at: postures, or joint angles (T, 7) [rad].
        force: on each capsule (T, K, 3) [N], in the world.
        moment: on each capsule about its ``point`` (T, K, 3) [N m], None for none.
        point: where the forces act (T, K, 3) [m], in the world, None for the capsules' centres.

    Raises:
        ArmError: neither moment nor point is given (a force alone has no torque), or a shape does not fit.
    """
    at = _postures(arm, at)
    shape = (len(at.tool), len(arm.shapes), 3)
    if moment is None and point is None:
        raise ArmError("forces on the capsules alone do not say what they turn; give their moments about the capsules' "
                       "origins, or their points.")
    force = _fits("force", force, shape)
    moment = np.zeros(shape) if moment is None else _fits("moment", moment, shape)
    point = arm.capsule_poses(at)[..., :3, 3] if point is None else _fits("point", point, shape)
    return np.where(_moves(arm.capsule_links), _turn(at, force, moment, point), 0.0).sum(axis=1)


def contact_rows(arm: Arm, at: Postures | np.ndarray, links: np.ndarray, points: np.ndarray,
                 vectors: np.ndarray) -> np.ndarray:
    """J^T v of each contact (T, n, 7): joint torques [N m] of forces [N], or the rows of an observation
    matrix of displacements [m].

    Args:
        at: postures, or joint angles (T, 7) [rad].
        links: number in ``arm.links`` of the body of each contact (T, n) or (n,); negative for no contact, whose row is
        0.
        points: points of contact (T, n, 3) [m], in the world.
        vectors: forces on the arm (T, n, 3) [N], or displacements [m], in the world.

    Raises:
        ArmError: a shape does not fit, or the arm has no such link.
    """
    at = _postures(arm, at)
    points = np.asarray(points, float)
    if points.ndim != 3 or points.shape[0] != len(at.tool) or points.shape[2] != 3:
        raise ArmError(f"points have the shape {points.shape}; give ({len(at.tool)}, contacts, 3) in metres.")
    vectors = _fits("vectors", vectors, points.shape)
    links = np.broadcast_to(np.asarray(links, int), points.shape[:2])
    if links.size and links.max() >= len(arm.links):
        raise ArmError(f"contact on link {links.max()}, but the arm has {len(arm.links)}: 0 is {arm.links[0]}, "
                       f"{len(arm.links) - 1} is {arm.links[-1]}.")
    return np.where(_moves(links), _turn(at, vectors, np.zeros(points.shape), points), 0.0)


def jacobian(arm: Arm, at: Postures | np.ndarray, links: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Jacobians (T, n, 3, 7) [m/rad] of points (T, n, 3) [m] fixed to the links (T, n) or (n,)."""
    return np.stack([contact_rows(arm, at, links, points, np.broadcast_to(unit, np.shape(points)))
                     for unit in np.eye(3)], axis=-2)


def _turn(at: Postures, force: np.ndarray, moment: np.ndarray, point: np.ndarray) -> np.ndarray:
    """a . (m + (p - o) x f) of every contact and joint (T, n, 7)."""
    # a . (m + p x f) - (a x o) . f needs no array (T, n, 7, 3)
    about_base = moment + np.cross(point, force)
    return (np.einsum("tnc,tjc->tnj", about_base, at.axes)
            - np.einsum("tnc,tjc->tnj", force, np.cross(at.axes, at.anchors)))


def _moves(links: np.ndarray) -> np.ndarray:
    """Whether each joint moves the links (..., 7). Joint j carries the links from j + 1 on, the Punyo included."""
    return np.arange(gen3.JOINTS) < np.asarray(links)[..., None]


def _postures(arm: Arm, at: Postures | np.ndarray) -> Postures:
    return at if isinstance(at, Postures) else arm.postures(at)


def _fits(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(value, float)
    if value.shape != shape:
        raise ArmError(f"{name} has the shape {value.shape}; it must be {shape}.")
    if not np.isfinite(value).all():
        frame = np.argwhere(~np.isfinite(value))[0][0]
        raise ArmError(f"{name} of frame {frame} is not finite; leave out frames that did not converge.")
    return value
