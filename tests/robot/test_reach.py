"""Straight touches: met along the whole line, or refused with the reason; and gaps, against MuJoCo's distances."""

import mujoco
import numpy as np
import pytest

from vsfsim.core.rotation import rotation_matrix, rotation_vector
from vsfsim.robot import gen3, reach
from vsfsim.robot.arm import Arm
from vsfsim.robot.inverse_kinematics import solve
from vsfsim.robot.reach import Reason, Unreachable, straight_touch

FORWARD = rotation_matrix((0.0, np.pi / 2, 0.0))  # the flange looks along x
START, STOP = np.array([0.45, 0.05, 0.35]), np.array([0.57, -0.02, 0.30])


@pytest.fixture(scope="module")
def arm():
    return Arm()


def off(arm, q, start, stop, rotation):
    """Largest distance [m] of the tool from the line, and angle [rad] from the orientation, over postures (T, 7)."""
    tool = arm.postures(q).tool
    along = (stop - start) / np.linalg.norm(stop - start)
    away = tool[:, :3, 3] - start
    away = np.linalg.norm(away - (away @ along)[:, None] * along, axis=1)
    return away.max(), max(np.linalg.norm(rotation_vector(t[:3, :3] @ rotation.T)) for t in tool)


@pytest.mark.parametrize("punyo", [False, True])
def test_the_whole_line_is_met(punyo):
    arm = Arm(punyo=punyo)
    home = arm.postures(np.array([gen3.HOME])).tool[0]  # there the dome looks down, along its way
    start, turn = (home[:3, 3], home[:3, :3]) if punyo else (START, FORWARD)
    stop = start + 0.1 * turn[:, 2] if punyo else STOP
    q = straight_touch(arm, start, stop, turn, frames=60)
    tool = arm.postures(q).tool
    want = start + np.linspace(0, 1, 60)[:, None] * (stop - start)
    assert np.linalg.norm(tool[:, :3, 3] - want, axis=1).max() < 1e-5
    assert max(np.linalg.norm(rotation_vector(t[:3, :3] @ turn.T)) for t in tool) < 1e-4
    # 2.4 mm between the frames: joints that turn evenly leave the line by h^2 / 8 R, microns
    between = (q[1:] + q[:-1]) / 2
    assert all(a < b for a, b in zip(off(arm, between, start, stop, turn), (1e-5, 1e-4), strict=True))
    assert np.abs(np.diff(q, axis=0)).max() < 0.05
    assert (q >= arm.least).all() and (q <= arm.most).all()
    at = arm.postures(q)
    assert reach.self_gaps(arm, at)[0].min() >= 0.005 and reach.table_gaps(arm, at, 0.0)[0].min() >= 0.005
    assert np.array_equal(q, straight_touch(arm, start, stop, turn, frames=60)), "the same bits again"


def test_every_pose_that_the_arm_can_take_is_found(arm):
    """Poses made from random joint angles can be had; one start of five is enough for each."""
    rng = np.random.default_rng(11)
    low, high = np.where(np.isfinite(arm.least), arm.least, -np.pi), np.where(np.isfinite(arm.most), arm.most, np.pi)
    for _ in range(60):
        target, _ = arm.tool_jacobian(rng.uniform(low, high))
        tries = [solve(arm, target, rng.uniform(low, high)) for _ in range(5)]
        best = min(tries, key=lambda s: s.position + s.angle)
        assert best.found
        pose, _ = arm.tool_jacobian(best.q)
        assert np.abs(pose - target).max() < 2e-6
        assert (best.q >= arm.least).all() and (best.q <= arm.most).all()


@pytest.mark.parametrize("joint", [1, 5])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_no_path_leads_into_the_margin_of_a_joint(arm, joint, side):
    """A pose 1 mrad from a limit is made otherwise or refused, whatever posture the search begins at."""
    q = np.array([0.3, 0.5, 2.6, -1.9, 0.4, 1.1, 1.0])
    q[joint] = arm.upper[joint] - 1e-3 if side > 0.0 else arm.lower[joint] + 1e-3
    target, _ = arm.tool_jacobian(q)
    found = solve(arm, target, q)
    assert (found.q >= arm.lower + np.radians(3.0) - 1e-12).all()
    assert (found.q <= arm.upper - np.radians(3.0) + 1e-12).all()
    assert found.found or found.at_limit


@pytest.mark.parametrize(("start", "stop", "turn", "limits", "reason"), [
    ([0.7, 0.0, 0.4], [1.2, 0.0, 0.4], FORWARD, {}, Reason.TOO_FAR),
    ([0.5, 0.0, 0.2], [0.5, 0.0, -0.1], FORWARD, {}, Reason.TABLE),
    ([0.5, 0.0, 0.3], [0.5, 0.0, 0.25], FORWARD, {"table": 0.26}, Reason.TABLE),
    ([0.3, 0.0, 0.10], [0.0, 0.0, 0.10], rotation_matrix((0.0, -np.pi / 2, 0.0)), {"table": None},
     Reason.SELF_COLLISION),
    ([0.35, 0.0, 0.3], [0.18, 0.0, 0.3], FORWARD, {}, Reason.LIMITS),
])
def test_what_cannot_be_had_is_refused_with_its_reason(arm, start, stop, turn, limits, reason):
    with pytest.raises(Unreachable, match="cannot be made") as error:
        straight_touch(arm, start, stop, turn, frames=20, **limits)
    assert error.value.reason is reason and reason.value in str(error.value)


@pytest.mark.parametrize(("q", "way"), [
    ((0.308, -0.205, -1.418, -0.059, 2.654, -1.216, 1.462), (-0.009, -0.788, -0.616)),
    ((-2.643, -1.631, 1.941, 0.152, -3.06, -0.068, 2.791), (-0.995, -0.096, -0.02)),
])
def test_a_path_through_a_singular_posture_is_not_taken(arm, q, way, monkeypatch):
    """On these two lines of 0.4 m the first postures found jump by 0.4 and 0.7 rad in a step of 5 mm; others lead along
    without."""
    pose = arm.tool_jacobian(np.array(q))[0]
    line = pose[:3, 3], pose[:3, 3] + 0.4 * np.array(way) / np.linalg.norm(way), pose[:3, :3]
    found = straight_touch(arm, *line, frames=81, table=None, restarts=3)
    assert np.abs(np.diff(found, axis=0)).max() < 0.25
    # no step keeps to this limit, so the reason is reported
    monkeypatch.setattr(reach, "JUMP", 1e-6)
    with pytest.raises(Unreachable, match="would jump") as error:
        straight_touch(arm, *line, frames=81, table=None, restarts=3)
    assert error.value.reason is Reason.SINGULAR


@pytest.mark.parametrize("punyo", [False, True])
def test_gaps_are_mujocos(punyo):
    arm = Arm(punyo=punyo)
    data = mujoco.MjData(arm.model)
    ids = range(len(arm.capsules))  # MuJoCo's geoms are the capsules
    assert arm.model.geom_bodyid.tolist() == arm.body_ids[arm.capsule_links].tolist()
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
