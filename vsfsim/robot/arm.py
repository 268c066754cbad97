"""The arm: poses of its links, capsules and tool at joint angles, and its gravity torques, computed by MuJoCo.

The capsules are rigid bodies for `vsfsim.physics.solve.touches.Solver(model, arm.shapes).run(arm.body_poses(q))`.

`body_torque` gives quasi-static joint torques of contact forces, tau = sum of J^T f (SBML, eq. 7).

The joint angles are given, forces do not change them, and the arm's gravity compensation removes its weight. A torque
is that of the contact on the joint, positive in the sense of positive angles; the motor balances it.

For a joint with axis a through the point o, a force f at p and a moment m on a link behind the joint give the torque
a . (m + (p - o) x f); on the links before it they give none.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.core.chain import Chain, ChainCapsule, capsule_pose
from vsfsim.core.errors import VsfsimError
from vsfsim.core.shape import Capsule
from vsfsim.core.system.exact import product
from vsfsim.robot import gen3

if TYPE_CHECKING:
    import mujoco

_EYE = np.eye(4)


@dataclass(frozen=True)
class Postures:
    """The arm at T sets of joint angles, in the world."""

    links: np.ndarray
    """Poses of the bodies of the chain, the base first (T, L, 4, 4) [m]."""
    tool: np.ndarray
    """Pose of the tool (T, 4, 4) [m]."""
    anchors: np.ndarray
    """A point on each joint's axis (T, 7, 3) [m]."""
    axes: np.ndarray
    """Unit direction of each joint's axis (T, 7, 3) [-]."""


class Arm:
    """A Kinova Gen3. Everything is in the world's frame, whose z is up.

    Args:
        punyo: whether it carries a Punyo.
        tool: what `Postures.tool` follows, "punyo", "punyo_rim" or "flange"; by default the Punyo, without one the
            flange.
        base: pose of the base in the world (4, 4) [m], by default the origin.
    """

    punyo: bool
    """Whether the arm carries a Punyo."""
    tool: str
    """What `Postures.tool` follows: "flange", with its z outwards, "punyo", the apex of the dome with its z along the
    dome's axis, or "punyo_rim", the same at the middle of the rim."""
    base: np.ndarray
    """Pose of the base in the world (4, 4) [m]."""
    model: mujoco.MjModel
    """MuJoCo's model."""
    links: tuple[str, ...]
    """Names of the bodies of the chain (L,)."""
    body_ids: np.ndarray
    """Numbers of the links in MuJoCo's model (L,)."""
    lower: np.ndarray
    """Lower joint limits (7,) [rad], infinite for a continuous joint."""
    upper: np.ndarray
    """Upper joint limits (7,) [rad], infinite for a continuous joint."""
    least: np.ndarray
    """Least joint angles that a path is planned with (7,) [rad]: `gen3.MARGIN` from the limit, for a joint at its stop
    does not feel all of a contact's torque."""
    most: np.ndarray
    """Greatest ones (7,) [rad]."""
    capsules: tuple[ChainCapsule, ...]
    """The capsules, each with the number of its body in `links` (K,)."""
    shapes: tuple[Capsule, ...]
    """The shapes of the capsules, as the solver takes them (K,)."""
    capsule_links: np.ndarray
    """Number in `links` of the body that each capsule is fixed to (K,)."""
    capsule_offsets: np.ndarray
    """Poses of the capsules in the frames of their bodies (K, 4, 4) [m]."""
    reach: float
    """Upper bound on the distance from joint 2 to the tool [m]."""

    def __init__(self, *, punyo: bool = False, tool: str | None = None, base: np.ndarray | None = None):
        mujoco = _mujoco()
        self.punyo, self.tool = punyo, tool or ("punyo" if punyo else "flange")
        spec = mujoco.MjSpec.from_file(str(gen3.MODEL))
        if not punyo:
            spec.delete(spec.body("punyo"))
        self.base = np.eye(4) if base is None else np.asarray(base, float)
        self.links = tuple(body.name for body in spec.bodies[1:])  # a chain, after the world
        root = spec.body(self.links[0])
        root.pos, root.quat = self.base[:3, 3], quaternion(self.base[:3, :3])
        self.capsules = tuple(ChainCapsule(self.links.index(geom.parent.name), tuple(geom.fromto[:3].tolist()),
                                           tuple(geom.fromto[3:].tolist()), float(geom.size[0]))
                              for geom in spec.geoms)
        self._mujoco, self.model = mujoco, spec.compile()
        self._data = mujoco.MjData(self.model)
        self.body_ids = np.array([self.model.body(name).id for name in self.links])
        self._site = self.model.site(self.tool).id
        # views into MuJoCo's memory, as looking them up takes as long as the kinematics
        self._qpos, self._tool = self._data.qpos, (self._data.site_xpos[self._site],
                                                   self._data.site_xmat[self._site].reshape(3, 3))
        limited = self.model.jnt_limited.astype(bool)
        self.lower = np.where(limited, self.model.jnt_range[:, 0], -np.inf)
        self.upper = np.where(limited, self.model.jnt_range[:, 1], np.inf)
        self.least, self.most = self.lower + gen3.MARGIN, self.upper - gen3.MARGIN
        self.shapes = tuple(Capsule(c.radius, float(np.linalg.norm(np.subtract(c.stop, c.start))))
                            for c in self.capsules)
        self.capsule_links = np.array([c.link for c in self.capsules])
        self.capsule_offsets = np.stack([capsule_pose(np.array(c.start), np.array(c.stop)) for c in self.capsules])
        at = self.postures(np.zeros((1, gen3.JOINTS)))
        chain = np.concatenate([at.anchors[0, 1:], at.tool[0, None, :3, 3]])
        self.reach = float(np.linalg.norm(np.diff(chain, axis=0), axis=1).sum())

    def postures(self, q: np.ndarray) -> Postures:
        """Forward kinematics of joint angles ``q`` (T, 7) [rad]."""
        links, tool = (np.tile(np.eye(4), (len(q), *n, 1, 1)) for n in ((len(self.links),), ()))
        anchors, axes = np.empty((len(q), gen3.JOINTS, 3)), np.empty((len(q), gen3.JOINTS, 3))
        data = self._data
        for t, angles in enumerate(q):
            data.qpos[:] = angles
            self._mujoco.mj_kinematics(self.model, data)
            links[t, :, :3, 3] = data.xpos[self.body_ids]
            links[t, :, :3, :3] = data.xmat[self.body_ids].reshape(-1, 3, 3)
            tool[t, :3, 3], tool[t, :3, :3] = data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3)
            anchors[t], axes[t] = data.xanchor, data.xaxis
        return Postures(links, tool, anchors, axes)

    def tool_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The tool's pose (4, 4) [m] at ``q`` (7,) [rad], and the Jacobian (6, 7) of its position [m/rad] and rotation
        [rad/rad]."""
        data, out, pose = self._data, np.empty((6, gen3.JOINTS)), _EYE.copy()
        self._qpos[:] = q
        self._mujoco.mj_kinematics(self.model, data)
        self._mujoco.mj_comPos(self.model, data)
        self._mujoco.mj_jacSite(self.model, data, out[:3], out[3:], self._site)
        pose[:3, 3], pose[:3, :3] = self._tool
        return pose, out

    def body_poses(self, q: np.ndarray) -> np.ndarray:
        """Poses (T, K, 4, 4) [m] of the capsules at ``q`` (T, 7) [rad]: centre of the capsule, its axis along z."""
        return self.capsule_poses(self.postures(q))

    def capsule_poses(self, at: Postures) -> np.ndarray:
        """As `body_poses`, of known postures."""
        return product(at.links[:, self.capsule_links], self.capsule_offsets)

    def gravity_torque(self, q: np.ndarray) -> np.ndarray:
        """Torques (T, 7) [N m] that the motors need to hold the arm against its weight at ``q`` (T, 7) [rad]."""
        out = np.empty((len(q), gen3.JOINTS))
        self._data.qvel[:] = 0.0
        for t, angles in enumerate(q):
            self._data.qpos[:] = angles
            self._mujoco.mj_kinematics(self.model, self._data)
            self._mujoco.mj_comPos(self.model, self._data)
            self._mujoco.mj_comVel(self.model, self._data)
            self._mujoco.mj_rne(self.model, self._data, 0, out[t])
        return out


def body_torque(arm: Arm, at: Postures, force: np.ndarray, *, moment: np.ndarray) -> np.ndarray:
    """Joint torques (T, 7) [N m] of the forces and moments on the arm's K capsules.

    Args:
        at: postures.
        force: on each capsule (T, K, 3) [N], in the world.
        moment: on each capsule about its centre (T, K, 3) [N m].
    """
    # a . (m + p x f) - (a x o) . f needs no array (T, K, 7, 3)
    about_base = moment + np.cross(arm.capsule_poses(at)[..., :3, 3], force)
    turn = (np.einsum("tnc,tjc->tnj", about_base, at.axes)
            - np.einsum("tnc,tjc->tnj", force, np.cross(at.axes, at.anchors)))
    # joint j carries the links from j + 1 on, the Punyo included
    return np.where(np.arange(gen3.JOINTS) < arm.capsule_links[:, None], turn, 0.0).sum(axis=1)


def chain_of(arm: Arm) -> Chain:
    """The arm as the kinematic chain that a dataset stores, with the links ``arm.links`` and the same kinematics."""
    ids = arm.body_ids
    base = arm.postures(np.zeros((1, gen3.JOINTS))).links[0, 0]
    positions = [(0.0, 0.0, 0.0), *(tuple(map(float, arm.model.body_pos[i])) for i in ids[1:])]
    quaternions = [(1.0, 0.0, 0.0, 0.0), *(tuple(map(float, arm.model.body_quat[i])) for i in ids[1:])]
    joints = tuple(int(arm.model.body_jntadr[i]) if arm.model.body_jntnum[i] else -1 for i in ids)
    return Chain(tuple(tuple(map(float, row)) for row in base[:3]),  # type: ignore[arg-type]
                 tuple(positions), tuple(quaternions), joints, arm.capsules)  # type: ignore[arg-type]


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """w x y z (4,) of a rotation (3, 3), of the nearest one if it is rounded."""
    u, _, v = np.linalg.svd(rotation)
    out = np.zeros(4)
    _mujoco().mju_mat2Quat(out, np.ascontiguousarray(u @ v).ravel())
    return out


def _mujoco() -> ModuleType:
    """MuJoCo, of which nothing is drawn here.

    Raises:
        VsfsimError: it cannot load the OpenGL that the environment asks it for.
    """
    try:
        import mujoco
    except ModuleNotFoundError:
        raise
    except Exception as error:  # of whatever kind the OpenGL's loader raises
        raise VsfsimError(f"MuJoCo cannot load the OpenGL that MUJOCO_GL={os.environ.get('MUJOCO_GL')} asks it for: "
                          f"{error}. vsfsim draws nothing with MuJoCo: unset MUJOCO_GL, or set it to 'disable'."
                          ) from error
    return mujoco
