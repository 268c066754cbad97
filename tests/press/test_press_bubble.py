"""A bubble pressed on rigid bodies, from the scene to the file."""

import json

import matplotlib.image
import numpy as np
import pytest
from texts import scene

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import find_scene
from vsfsim.generate.effectors.bubble import EFFECTOR, inward_distance, result_of, solve
from vsfsim.press import figures
from vsfsim.press.command import Press
from vsfsim.press.command import press as command


@pytest.fixture(scope="module")
def down():
    place, request = "[{ shape = { sphere = 0.01 }, pose = [0.1, 0.2, 0.3] }]", Request()
    made = solve(scene("bubble", obstacles=place, press="""\
{ path = [[0.1, 0.2, 0.345], [0.1, 0.2, 0.336]], frames = 3 }""").sample(0), request)
    return made.solved, result_of(made, request)


def test_force_depth_and_pressure(down):
    _, down = down
    assert down.converged.all()
    apex = 0.3 + 0.010 + down.more["apex"]  # of the mount's origin when it first touches
    # first contact on triangles: their chord under the dome is 0.1 mm off at most
    assert down.depth == pytest.approx([max(apex - z, 0.0) for z in (0.342, 0.339, 0.336)], abs=1e-4)
    assert (np.diff(down.force[:, 2]) > 0.0).all(), "pushed back up"
    assert np.abs(down.force[:, :2]).max() < 1e-3 * down.force[-1, 2]
    assert down.touch.reaction == pytest.approx(-down.force, rel=1e-3, abs=1e-3), "it is held"
    assert down.more["body_force"][:, 0] == pytest.approx(-down.force, rel=1e-9, abs=1e-9)
    # the mount frame is turned over: +z leads downwards
    assert down.more["wrench"][:, 2] == pytest.approx(-down.force[:, 2], rel=1e-9)
    ambient, gamma, gas = 101325.0, 1.4, 150e-6
    constant = (down.more["pressure"] + ambient) * down.more["volume"]**gamma
    assert constant == pytest.approx((7820.0 + ambient) * gas**gamma, rel=1e-6)
    assert down.more["pressure_change"] == pytest.approx(down.more["pressure"] - 7820.0, abs=1e-9)


def test_what_is_saved(down, tmp_path):
    Press("small", (down[1],), "cpu").save(tmp_path / "out.npz")
    with np.load(tmp_path / "out.npz") as data:
        assert set(json.loads(str(data["units"]))) == set(data.files) - {"units"}
        assert data["node_position"].shape == data["node_force"].shape == (3, 390, 3)
        assert data["fine_force"].sum(axis=1) == pytest.approx(data["force"], rel=1e-9, abs=1e-9)
        assert data["node_force"].sum(axis=1) == pytest.approx(data["force"], rel=1e-5, abs=1e-6), "of single precision"
        at = data["mount_pose"]
        rim = data["fine_rest"][data["fine_rim"]] @ np.swapaxes(at[:, :3, :3], 1, 2) + at[:, None, :3, 3]
        assert np.abs(data["fine_position"][:, data["fine_rim"]] - rim).max() < 1e-12, "the rim is clamped"


def test_the_skin_has_a_dent_and_a_bulge_and_the_picture_shows_dots(down, tmp_path):
    solved, result = down
    depth = inward_distance(solved.sensor, solved.in_mount()[0][2])
    # the node nearest the ball's pole has gone as far as the mount has; the skin around bulges out, since the air has
    # to go somewhere
    assert depth.max() == pytest.approx(result.depth[2], rel=0.05)
    assert -0.3 * depth.max() < depth.min() < -0.01 * depth.max()
    assert np.abs(depth[solved.sensor.mesh.rim]).max() < 1e-12
    drawn, curves = figures.picture(result, "small", tmp_path / "p.png"), figures.plot(result, "small").axes
    assert drawn.get_supxlabel() == f"{result.model}; {result.caption}" and result.caption
    assert [axes.get_title() for axes in curves] == [f"small: {result.model}"] + [""] * (len(curves) - 1)
    drawn = matplotlib.image.imread(tmp_path / "p.png")
    assert drawn.shape[1] > 3 * drawn.shape[0] and np.ptp(drawn[:, -200:, 0]) > 0.3, "the camera inside sees dots"


def test_what_a_sensor_has_not_is_refused():
    with pytest.raises(SceneError, match=r"--refine refines a \[sensor\] where rigid bodies touch it"):
        command(load_scene(find_scene("punyo-block")), refine=3)
    ball, cube = (scene("bubble", obstacles=f"[{{ shape = {{ {shape} }}, pose = [0.0, 0.0, 0.0] }}]") for shape in
                  ("sphere = 0.01", "box = [0.02, 0.02, 0.02]"))
    edges = [each.sample(0).sensor.contact_edge for each in EFFECTOR.finer(ball, Request(), 3)]
    assert edges == pytest.approx([0.02 / 3.0, 0.01 / 3.0, 0.005 / 3.0]), "the mesh before the last is the scene's"
    with pytest.raises(SceneError, match="for other bodies give contact_edge"):
        EFFECTOR.finer(cube, Request(), 3)


def test_on_an_object_the_mount_holds_and_the_read_out_bears_what_the_object_pushes():
    soft = scene("block", ("[object]", "sensor = { kind = 'bubble', nodes = 200 }\n[object]"), probe=None,
                 shape="{ box = [0.10, 0.10, 0.04] }", tier='"fem-coarse"', resolution=0.02, young_modulus=5e4,
                 press="{ path = [[0.004, 0.003, 0.0700], [0.004, 0.003, 0.0665]], frames = 1 }")
    made = solve(soft.sample(0), Request())
    result = result_of(made, Request())
    saved = {name: values for name, (values, _) in result.saved().items()}
    assert result.converged.all() and result.force[-1, 2] > 0.5
    assert result.touch.reaction == pytest.approx(result.force, rel=1e-2, abs=1e-3), "it is held"
    assert result.more["body_force"][:, 0] == pytest.approx(-result.force, rel=1e-9, abs=1e-9)
    assert saved["node_force"].sum(axis=1) == pytest.approx(result.force, rel=1e-5, abs=1e-6)
    arm = saved["node_position"] - saved["mount_pose"][:, None, :3, 3]
    moment = np.einsum("tji,tj->ti", saved["mount_pose"][:, :3, :3], np.cross(arm, saved["node_force"]).sum(axis=1))
    assert moment == pytest.approx(result.more["wrench"][:, 3:], abs=1e-6)
