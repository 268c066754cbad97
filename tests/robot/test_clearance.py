"""Gaps between capsules, against MuJoCo's own distances."""

import mujoco
import numpy as np
import pytest

from vsfsim.robot import gen3, reach
from vsfsim.robot.arm import Arm


@pytest.mark.parametrize("punyo", [False, True])
def test_gaps_are_mujocos(punyo):
    arm = Arm(punyo=punyo)
    data = mujoco.MjData(arm.model)
    geom = {(c.link, i): arm.model.geom(f"{c.link}_{i}").id for link in arm.links for i,
            c in enumerate(c for c in arm.capsules if c.link == link)}
    ids = list(geom.values())
    q = np.random.default_rng(5).uniform(-2.0, 2.0, (6, 7))
    gaps, pairs = reach.self_gaps(arm, arm.postures(q))
    table, moving = reach.table_gaps(arm, arm.postures(q), 0.1)
    assert len(pairs) > 80
    for t in range(len(q)):
        data.qpos[:] = q[t]
        mujoco.mj_kinematics(arm.model, data)
        for p, (i, j) in enumerate(pairs):
            want = mujoco.mj_geomDistance(arm.model, data, ids[i], ids[j], 5.0, None)
            # MuJoCo stops at 1e-6 m where capsules are nearly parallel
            assert gaps[t, p] == pytest.approx(want, abs=2e-6)
        for m, k in enumerate(moving):
            half = arm.shapes[k].length / 2 * data.geom_xmat[ids[k]].reshape(3, 3)[2, 2]
            ends = data.geom_xpos[ids[k]][2] + np.array([-half, half])
            assert table[t, m] == pytest.approx(ends.min() - arm.shapes[k].radius - 0.1, abs=1e-12)


def test_the_home_posture_is_free():
    arm = Arm(punyo=True)
    at = arm.postures(np.array([gen3.HOME]))
    assert reach.self_gaps(arm, at)[0].min() > 0.04 and reach.table_gaps(arm, at, 0.0)[0].min() > 0.2
