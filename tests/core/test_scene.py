"""The scene grammar: every table, distributions and their seeds; `test_refused.py` has the refusals."""

import re
from pathlib import Path

import numpy as np
import pytest
from texts import scene as scene_of
from texts import text

from vsfsim.core.bubble import Bubble
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene, parse_scene
from vsfsim.core.shape import Capsule, Family, MeshFile, Plane, Sphere

SMALL = '[object]\nshape = { box = [0.1, 0.1, 0.05] }\nyoung_modulus = 1e5\n'


def small(more=""):
    return parse_scene(SMALL + more, Path("s.toml")).sample()


def test_every_table_is_read():
    s = parse_scene(text("full"), Path("there/full.toml")).sample(0)
    assert (s.name, s.needs, s.gravity, s.source) == ("full", ("normal-force", "appearance"), (0.0, 0.0, -9.81),
                                                      Path("there/full.toml"))
    o = s.object
    assert isinstance(o.shape, Family) and o.shape.name == "shoe" and 0.24 <= o.shape.parameters["length"] <= 0.28
    assert (o.pose, o.yaw, o.fixed) == ((0.1, 0.2, 0.3), 0.5, (-0.1, -0.1, 0.0, 0.1, 0.1, 0.01))
    assert (o.tier, o.resolution, o.poisson_ratio, o.density, o.friction) == ("fem", 0.02, 0.3, 400.0, 0.2)
    assert o.young_modulus.base == 1e5 and o.young_modulus.inclusions[0].young_modulus == 1e7
    assert o.appearance == {"tint": 0.5} and s.probe == Capsule(0.01, 0.02)
    p, t, c, d = s.press, s.touches, s.camera, s.dataset
    assert (p.path, p.start, p.stop, p.frames, p.hold, p.retract,
            p.rotation) == (((0, 0, 0.1), (0, 0, 0.09)), (0, 0, 0.1), (0, 0, 0.09), (5,), 2, 3, None)
    assert (t.count, t.depth, t.approach, t.force_limit, t.frames) == (7, 0.004, 0.02, 10.0, (1, 4, 2, 3))
    assert (c.width, c.height, c.fov, c.distance, c.elevation) == (64, 48, 0.7, 0.5, 0.6) and -1.0 <= c.azimuth <= 1.0
    assert (d.objects, d.views, d.splits) == (6, 2, {"train": 4, "test": 2})


def test_three_lines_are_enough():
    s = small()
    assert (s.name, s.needs, s.gravity, s.probe) == ("s", ("normal-force",), (0.0, 0.0, 0.0), Sphere(0.02))
    assert s.press is s.touches is s.dataset is None
    assert (s.object.fixed, s.object.tier, s.object.resolution, s.object.poisson_ratio,
            s.object.friction) == ("bottom", "auto", None, 0.45, 0.0)


def test_a_distribution_stands_wherever_a_value_may():
    scene = parse_scene(text(
        "full", ("base = 1e5", "base = { loguniform = [1e4, 1e6] }"),
        ("pose = [0.1,", "pose = [{ uniform = [-0.1, 0.1] },"),
        ("{ capsule = [0.01, 0.02] }",
         "{ choice = [{ sphere = { uniform = [0.01, 0.02] } }, { capsule = [0.01, 0.02] }] }"),
        count="{ choice = [7, 9] }"), Path("d.toml"))
    drawn = [scene.sample(seed) for seed in range(200)]
    assert {s.touches.count for s in drawn} == {7, 9}
    base = np.array([s.object.young_modulus.base for s in drawn])
    assert base.min() >= 1e4 and base.max() <= 1e6
    # log-uniform over two decades: the median is 1e5 +- a factor of 1.39 (two standard errors of 200 draws, 0.14
    # decades)
    assert abs(np.log10(np.median(base)) - 5.0) < 0.15
    x = np.array([s.object.pose[0] for s in drawn])
    assert np.abs(x).max() <= 0.1 and np.ptp(x) > 0.19
    # a distribution inside a choice
    radii = {s.probe.radius for s in drawn if isinstance(s.probe, Sphere)}
    assert len(radii) > 50 and min(radii) >= 0.01 and max(radii) <= 0.02
    assert any(isinstance(s.probe, Capsule) for s in drawn)


def test_the_same_seed_draws_the_same_scene_and_zero_is_one():
    scene = parse_scene(text("full"), Path("full.toml"))
    assert scene.sample(0) == scene.sample(0) == scene.sample() and scene.sample(5) == scene.sample(5)
    assert len({scene.sample(seed).camera.azimuth for seed in range(20)}) == 20
    stream = [np.random.SeedSequence(0, spawn_key=(k,)) for k in (0, 0, 1)]
    first, same, other = (scene.sample(s) for s in stream)
    assert first == same and first.camera.azimuth != other.camera.azimuth


def test_a_mesh_lies_beside_its_scene():
    for given, scene, found in (("m/scan", "s", "m/scan"), ("m/scan", "/a/b/s", "/a/b/m/scan"),
                                ("/m/scan", "/a/b/s", "/m/scan")):
        shape = f'{{ mesh = "{given}.obj", scale = 0.01 }}'
        made = parse_scene(text("block", shape=shape), Path(f"{scene}.toml")).sample()
        assert made.object.shape == MeshFile(f"{found}.obj", 0.01)


def test_several_rigid_bodies():
    s = parse_scene(text("bodies"), Path("/a/s.toml")).sample()
    assert s.bodies == (MeshFile("/a/tip.stl", 0.001), Sphere(0.01), MeshFile("/m/finger.ply"), Plane())
    assert s.frictions == (0.4, 0.4, 0.9, 0.0)
    assert [b.position for b in (*s.parts, *s.obstacles)] == [(0.03, 0.0, 0.0), (-0.03, 0.0, 0.0), (0.06, 0.0, 0.0)]
    assert [b.rotation for b in (*s.parts, *s.obstacles)] == [(0.0, 0.0, 0.0), (0.0, 0.0, 1.5), (0.0, -1.5708, 0.0)]
    assert small().bodies == (Sphere(0.02),) and small().frictions == (0.0,)
    with pytest.raises(SceneError, match="rigid bodies; 64 are allowed"):
        small(64 * "[[obstacles]]\nshape = { sphere = 0.01 }\npose = [0, 0, 1]\n")


def test_paths():
    def press(path, more):
        return small(f"[press]\npath = {path}\n{more}\n").press

    bent, straight = [[0, 0, 0.07], [0, 0, 0.065], [0.01, 0, 0.065]], [[0, 0, 0.07], [0, 0, 0.065]]
    p = press(bent, "frames = [5, 8]\nrotation = [[0, 0, 0], [0, 0, 0], [0, 0, 0.5]]\nhold = 1")
    assert p.frames == (5, 8) and p.inward == 13
    assert p.stop == (0.01, 0.0, 0.065) and p.rotation[2] == (0.0, 0.0, 0.5)
    assert press(bent, "frames = 4").frames == (4, 4)
    assert press(straight, "rotation = [0.1, 0, 0]").rotation == ((0.1, 0.0, 0.0),) * 2
    turn = press([straight[0]] * 2, "rotation = [[0, 0, 0], [0, 0, 1]]")
    assert turn.inward == 10, "a turn on the spot is a path too"


def test_files_that_are_not_scenes(tmp_path):
    path = tmp_path / "x.toml"
    path.write_bytes(SMALL.encode() + b"# \xff\n")
    with pytest.raises(SceneError, match=re.escape(f"scene file '{path}' cannot be read: 'utf-8' codec")):
        load_scene(path)
    path.write_text(SMALL + "x == 3\n")
    with pytest.raises(SceneError, match=re.escape(f"scene file '{path}' is not valid TOML")):
        load_scene(path)
    for other in (tmp_path, tmp_path / "none.toml"):
        with pytest.raises(SceneError, match=re.escape(f"scene file '{other}' cannot be read")):
            load_scene(other)
    path.write_text(SMALL)
    assert load_scene(str(path)).text == SMALL


# ------------------------------------------------------------------------------------------ the [sensor] table


def sensor(**keys):
    return scene_of("bubble", **keys).sample(0)


def test_defaults_are_the_real_punyo():
    read = sensor(nodes=None)
    assert read.sensor == Bubble() and read.object is None
    assert [b.radius for b in read.bodies] == [0.003] and read.frictions == (Bubble().friction,)
    assert (620.0 <= Bubble().modulus <= 740.0 and 7.1e3 <= Bubble().gauge_pressure <= 8.2e3
            and Bubble().gas_volume == 150e-6)


def test_every_key_is_read():
    given = dict(semi_axes=[0.05, 0.04], young_modulus=1e6, thickness=0.001, pre_stretch=1.2, gauge_pressure=5e3,
                 gas_volume=2e-4, chamber=0.01, gamma=1.0, ambient_pressure=9e4, nodes=500,
                 contact_edge=1e-3, friction=0.5)
    read = sensor(**given, fine="true").sensor
    assert read == Bubble(**{**given, "semi_axes": (0.05, 0.04)}, fine=True)


def test_the_camera_inside_is_on_or_has_two_numbers_of_pixels():
    assert sensor().sensor.camera is None
    assert sensor(camera="true").sensor.camera == (640, 480)
    assert sensor(camera=[8, 4096]).sensor.camera == (8, 4096)
