"""The arm as the chain that a dataset keeps: the numbers of MuJoCo's model, whichever it is."""

from __future__ import annotations

import numpy as np

from vsfsim.core.chain import Chain, ChainCapsule
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm


def chain_of(arm: Arm) -> Chain:
    """The chain whose links are ``arm.links``, of the same poses at the same joint angles."""
    ids = arm.body_ids
    base = np.eye(4)
    first = arm.postures(np.zeros((1, gen3.JOINTS))).links[0, 0]
    base[:] = first
    positions = [(0.0, 0.0, 0.0), *(tuple(map(float, arm.model.body_pos[i])) for i in ids[1:])]
    quaternions = [(1.0, 0.0, 0.0, 0.0), *(tuple(map(float, arm.model.body_quat[i])) for i in ids[1:])]
    joints = tuple(int(arm.model.body_jntadr[i]) if arm.model.body_jntnum[i] else -1 for i in ids)
    capsules = tuple(ChainCapsule(int(link), tuple(map(float, c.start)), tuple(map(float, c.stop)), float(c.radius))
                     for link, c in zip(arm.capsule_links, arm.capsules, strict=True))  # type: ignore[arg-type]
    return Chain(tuple(tuple(map(float, row)) for row in base[:3]), tuple(positions), tuple(quaternions), joints,
                 capsules)  # type: ignore[arg-type]
