"""The Gen3 is the one of the table: its frames, its weight, its reach; computed here without MuJoCo. As a dataset
stores it, and as rigid bodies for the solver, it is the same."""

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shape import parse_probe_shapes, probe_table
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm, chain_of

TABLE = Path(__file__).with_name("kinova_gen3.md")
EPS = 1e-5  # rad, of the difference quotients


def rotation(quaternion):
    w, x, y, z = np.array(quaternion, float) / np.linalg.norm(quaternion)
    return np.array([[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                     [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                     [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]])


def transform(position, quaternion):
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = rotation(quaternion), position
    return out


def about_z(angle):
    return transform((0, 0, 0), (np.cos(angle / 2), 0, 0, np.sin(angle / 2)))


def table():
    """The rows of the published table: name, parent, then seven columns of numbers or words."""
    rows = [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in TABLE.read_text().splitlines()
            if line.startswith("| ")]
    return [[name, parent, *(np.array(c.split(), float) if c[0] in "-0123456789" else c for c in rest)] for name,
            parent, *rest in rows[1:]]


def chain(q):
    """Poses of the table's bodies at joint angles (7,): a product of transforms."""
    pose, out, joint = np.eye(4), [], 0
    for _, _, position, quaternion, limits, *_ in table():
        pose = pose @ transform(position, quaternion)
        if not (isinstance(limits, str) and limits == "fixed"):
            pose = pose @ about_z(q[joint])
            joint += 1
        out.append(pose)
    return np.stack(out)


def height_of_weight(q):
    """Potential energy [J] of the table's masses at joint angles (7,)."""
    return sum(9.81 * mass[0] * (pose[:3, :3] @ com + pose[:3, 3])[2] for pose,
               (*_, mass, com, _, _) in zip(chain(q), table(), strict=True))


@pytest.fixture(scope="module")
def arm():
    return Arm()


@pytest.fixture(scope="module")
def angles():
    return np.concatenate([[np.zeros(7), gen3.HOME], np.random.default_rng(3).uniform(-np.pi, np.pi, (40, 7))])


def test_the_figures_are_those_of_the_table():
    spec = mujoco.MjSpec.from_file(str(gen3.MODEL))  # the Punyo is its last body
    for link, (name, _, position, quaternion, limits, mass, com, turn,
               inertia) in zip(spec.bodies[1:-1], table(), strict=True):
        assert link.name == name
        for ours, theirs in ((link.pos, position), (link.quat, quaternion), (link.mass, mass), (link.ipos, com),
                             (link.iquat, turn), (link.inertia, inertia)):
            assert np.array_equal(np.atleast_1d(ours), theirs), name
        ranges = [joint.range.tolist() for joint in link.joints]
        assert ranges == ([[-float(limits[1:]), float(limits[1:])]] if limits.startswith("±")
                          else {"fixed": [], "continuous": [[0.0, 0.0]]}[limits]), name


def test_forward_kinematics_agree_with_a_product_of_transforms(arm, angles):
    at = arm.postures(angles)
    flange = transform((0, 0, -0.061525), (0, 1, 0, 0))
    for q, links, tool in zip(angles, at.links, at.tool, strict=True):
        want = chain(q)
        assert np.abs(links - want).max() < 1e-12, ("the same numbers, so only rounding is between them (1e-6 "
                                                    "m is asked)")
        assert np.abs(tool - want[-1] @ flange).max() < 1e-12


def test_gravity_torques_are_the_slope_of_the_potential_energy(arm, angles):
    """Virtual work: the holding torque is dV/dq. The difference quotient is good to 1e-7 N m here; 1e-3 is asked."""
    got = arm.gravity_torque(angles)
    for q, torque in zip(angles, got, strict=True):
        slope = [(height_of_weight(q + EPS * e) - height_of_weight(q - EPS * e)) / (2 * EPS) for e in np.eye(7)]
        assert torque == pytest.approx(slope, abs=1e-6)
    assert np.abs(got).max() > 15.0, "stretched out the arm weighs on joint 2"


def test_capsules_have_the_girth_of_the_meshes(arm):
    """Points read off the maker's public surface meshes, on the round housings [m]: the capsules' surface is there, to
    1.5 mm."""
    points = {"half_arm_1_link": [(0.045831, -0.187393, -0.006260), (-0.004837, -0.194, 0.039369),
                                  (-0.042325, -0.186473, -0.023820)],
              "forearm_link": [(0.0, 0.046, -0.0194), (0.034996, -0.194, -0.006735), (-0.011586, -0.194, -0.039390),
                               (0.000640, -0.194, 0.028624)],
              "shoulder_link": [(0.046, -0.013, -0.128375), (0.039168, -0.024120, -0.015974)],
              "spherical_wrist_1_link": [(-0.034724, -0.004415, -0.014425), (0.0, 0.035, -0.014425),
                                         (0.0, -0.01425, -0.140925)]}
    for name, known in points.items():
        for p in np.array(known):
            gaps = []
            for c in (c for c in arm.capsules if arm.links[c.link] == name):
                a, b = np.array(c.start), np.array(c.stop)
                s = np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
                gaps.append(np.linalg.norm(p - a - s * (b - a)) - c.radius)
            # the point is on the surface of the nearest capsule, or up to 3 mm inside the next housing's cap
            assert -3e-3 < min(gaps) < 2.5e-3, (name, p, gaps)


def test_the_punyo_sits_on_its_mount(angles):
    plain, carrying = Arm(), Arm(punyo=True)
    assert len(carrying.shapes) == len(plain.shapes) + 2 and carrying.tool == "punyo"
    mount = np.eye(4)
    # design.md, section 7
    mount[:3] = [[0, -1, 0, 0], [0.34202, 0, -0.93969, 0.02111], [0.93969, 0, 0.34202, 0.096142]]
    want = plain.postures(angles).tool @ mount
    at = carrying.postures(angles)
    # the published rows have five digits
    assert np.abs(at.links[:, -1] - want).max() < 1e-5
    axis = want[:, :3, :3] @ [-0.39394, 0.0, 0.91914]
    assert np.abs(at.tool[:, :3, 2] - axis).max() < 2e-5
    rim = want @ [0.0157, 0.0, 0.0655, 1.0]
    above = np.linalg.norm(at.tool[:, :3, 3] - rim[:, :3], axis=1)
    assert above == pytest.approx(np.full(len(angles), 0.0305), abs=1e-5)
    # the stand-in's surface is at the apex
    top = carrying.body_poses(angles)[:, -2]
    across = np.einsum("ti,ti->t", at.tool[:, :3, 3] - top[:, :3, 3], at.tool[:, :3, 2])
    assert across == pytest.approx(np.full(len(angles), carrying.shapes[-2].radius), abs=1e-5)


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
    with pytest.raises(SceneError, match="the shape is 'chain'"):
        parse_scene('[object]\nshape = { box = [0.1, 0.1, 0.1] }\nyoung_modulus = 1e5\n[probe]\nshape = '
                    '{ chain = {} }\n', "x.toml")


def test_an_opengl_that_mujoco_cannot_load_is_named(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    made = subprocess.run([sys.executable, "-c", "from vsfsim.robot.arm import Arm; Arm()"], capture_output=True,
                          text=True)
    assert made.returncode and "MUJOCO_GL=nonsense" in (said := made.stderr.splitlines()[-1]) and "disable" in said
