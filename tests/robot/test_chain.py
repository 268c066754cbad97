"""The arm as a dataset stores it, `core.chain`, against the robot's own kinematics."""

import json

import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shape import parse_probe_shapes, probe_table
from vsfsim.robot.arm import Arm, chain_of


@pytest.mark.parametrize("punyo", [False, True])
def test_the_chain_of_a_dataset_is_the_arm(punyo):
    base = np.eye(4)
    base[:3, :3], base[:3, 3] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], [-0.6, 0.1, 0.02]
    arm = Arm(punyo=punyo, base=base)
    chain = chain_of(arm)
    assert parse_probe_shapes(json.loads(json.dumps(probe_table(chain))), "test") == (chain,)
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (5, 7))
    at, links = arm.postures(q), chain.links(q)
    assert np.abs(links - at.links).max() < 1e-12
    assert np.abs(chain.capsule_poses(links)[..., :3, 3] - arm.capsule_poses(at)[..., :3, 3]).max() < 1e-12
    axes, anchors = chain.joint_axes(links)
    assert np.abs(axes - at.axes).max() < 1e-12 and np.abs(np.cross(anchors - at.anchors, axes)).max() < 1e-12
    with pytest.raises(SceneError, match="unknown shape 'chain'"):
        parse_scene('[object]\nshape = { box = [0.1, 0.1, 0.1] }\nyoung_modulus = 1e5\n[probe]\nshape = '
                    '{ chain = {} }\n', "x.toml")
