"""Menagerie's arm: an error that helps where it cannot be had, and the same arm as ours where it can.

No test downloads. The model that the made-up package gives is ours in Menagerie's dress: servos, a key frame, meshes'
contact, another site.
"""

import sys
import types

import mujoco
import numpy as np
import pytest

from vsfsim.robot import gen3
from vsfsim.robot.arm import ArmError, load_arm
from vsfsim.robot.dynamic import simulate
from vsfsim.robot.mujoco_model import JointParameters, arm_model


def dressed():
    spec = arm_model()
    for old in (*spec.actuators, *spec.sites):
        spec.delete(old)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 1
    for j in range(7):
        servo = spec.add_actuator(name=f"joint_{j + 1}", target=f"joint_{j + 1}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=2000.0)
    spec.body("bracelet_link").add_site(name="pinch_site")
    spec.add_key(name="home", qpos=list(gen3.HOME), ctrl=list(gen3.HOME))
    spec.option.timestep, spec.option.gravity = 0.002, [0, 0, -9.8]
    return spec


@pytest.fixture
def package(monkeypatch):
    made_up = types.ModuleType("mujoco_menagerie")
    made_up.MenagerieError = type("MenagerieError", (Exception,), {})
    made_up.get = lambda name: types.SimpleNamespace(default_model="gen3", spec=lambda entry: dressed())
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", made_up)
    return made_up


def test_it_is_the_same_arm_as_ours(package):
    q = np.random.default_rng(2).uniform(-2, 2, (5, 7))
    theirs, ours = load_arm("menagerie", punyo=True), load_arm(punyo=True)
    assert np.abs(theirs.body_poses(q) - ours.body_poses(q)).max() < 1e-12
    assert np.abs(theirs.gravity_torque(q) - ours.gravity_torque(q)).max() < 1e-9
    assert np.array_equal(theirs.lower, ours.lower) and theirs.shapes == ours.shapes
    path = np.array([gen3.HOME, gen3.HOME]) + np.array([[0.0], [0.02]])
    a, b = (simulate(arm, path, np.array([0.0, 0.2])) for arm in (theirs, ours))
    assert a.torque == pytest.approx(b.torque, abs=1e-9) and a.q == pytest.approx(b.q, abs=1e-12)


def test_friction_reaches_it(package):
    figures = JointParameters(coulomb=(1.0,) * 7, viscous=(3.0,) * 7, armature=(0.1,) * 7)
    model = load_arm("menagerie", joints=figures).model
    assert ((model.dof_frictionloss == 1.0).all() and (model.dof_damping == 3.0).all()
            and (model.dof_armature == 0.1).all())


def test_without_the_package_the_error_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    with pytest.raises(ArmError, match=r"pip install mujoco-menagerie.*or use the arm 'gen3'"):
        load_arm("menagerie")


@pytest.mark.parametrize("inside", [True, False], ids=["all of Menagerie", "its folder kinova_gen3"])
def test_a_copy_on_this_machine_is_used(monkeypatch, tmp_path, inside):
    """Ours, written out with a mesh on a link, as a file of Menagerie's name: no package, no network, and the mesh is
    there."""
    spec = dressed()
    spec.compile()
    text = spec.to_xml()
    (tmp_path / "kinova_gen3").mkdir()
    (tmp_path / "kinova_gen3" / "tip.obj").write_text("v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 2 3 "
                                                      "4\nf 1 4 3\n")
    text = text.replace("<worldbody>", '<asset><mesh name="tip" file="tip.obj"/></asset>\n<worldbody>', 1)
    place = text.index(">", text.index('name="bracelet_link"')) + 1
    text = text[:place] + '<geom type="mesh" mesh="tip" mass="0"/>' + text[place:]
    (tmp_path / "kinova_gen3" / "gen3.xml").write_text(text)
    monkeypatch.setitem(sys.modules, "mujoco_menagerie", None)
    monkeypatch.setenv("VSFSIM_MENAGERIE", str(tmp_path if inside else tmp_path / "kinova_gen3"))
    q = np.random.default_rng(3).uniform(-2, 2, (3, 7))
    theirs, ours = load_arm("menagerie"), load_arm()
    assert theirs.model.nmesh == 1
    # a file holds six digits
    assert np.abs(theirs.body_poses(q) - ours.body_poses(q)).max() < 1e-5
    assert np.abs(theirs.gravity_torque(q) - ours.gravity_torque(q)).max() < 1e-3
