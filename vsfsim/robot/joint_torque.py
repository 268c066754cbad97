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


def body_torque(arm: Arm, at: Postures | np.ndarray, force: np.ndarray, *, moment: np.ndarray) -> np.ndarray:
    """Joint torques (T, 7) [N m] of the forces and moments on the arm's K capsules.

    Args:
        at: postures, or joint angles (T, 7) [rad].
        force: on each capsule (T, K, 3) [N], in the world.
        moment: on each capsule about its centre (T, K, 3) [N m].

    Raises:
        ArmError: a shape does not fit.
    """
    at = at if isinstance(at, Postures) else arm.postures(at)
    shape = (len(at.tool), len(arm.shapes), 3)
    force, moment = _fits("force", force, shape), _fits("moment", moment, shape)
    # a . (m + p x f) - (a x o) . f needs no array (T, K, 7, 3)
    about_base = moment + np.cross(arm.capsule_poses(at)[..., :3, 3], force)
    turn = (np.einsum("tnc,tjc->tnj", about_base, at.axes)
            - np.einsum("tnc,tjc->tnj", force, np.cross(at.axes, at.anchors)))
    # joint j carries the links from j + 1 on, the Punyo included
    return np.where(np.arange(gen3.JOINTS) < arm.capsule_links[:, None], turn, 0.0).sum(axis=1)


def _fits(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    value = np.asarray(value, float)
    if value.shape != shape:
        raise ArmError(f"{name} has the shape {value.shape}; it must be {shape}.")
    if not np.isfinite(value).all():
        frame = np.argwhere(~np.isfinite(value))[0][0]
        raise ArmError(f"{name} of frame {frame} is not finite; leave out frames that did not converge.")
    return value
