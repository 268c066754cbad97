"""The arm as the kinematic chain that a dataset stores, with the numbers of its MuJoCo model."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from vsfsim.core.chain import Chain, ChainCapsule
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm


def chain_of(arm: Arm) -> Chain:
    """The chain with the links ``arm.links`` and the same kinematics."""
    ids = arm.body_ids
    base = arm.postures(np.zeros((1, gen3.JOINTS))).links[0, 0]
    positions = [(0.0, 0.0, 0.0), *(tuple(map(float, arm.model.body_pos[i])) for i in ids[1:])]
    quaternions = [(1.0, 0.0, 0.0, 0.0), *(tuple(map(float, arm.model.body_quat[i])) for i in ids[1:])]
    joints = tuple(int(arm.model.body_jntadr[i]) if arm.model.body_jntnum[i] else -1 for i in ids)
    capsules = tuple(ChainCapsule(int(link), _point(c.start), _point(c.stop), float(c.radius))
                     for link, c in zip(arm.capsule_links, arm.capsules, strict=True))
    return Chain(tuple(tuple(map(float, row)) for row in base[:3]), tuple(positions), tuple(quaternions), joints,
                 capsules)


def _point(values: Iterable[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
