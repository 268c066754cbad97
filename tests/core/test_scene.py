"""The scene grammar: every table, every refusal, distributions and their seeds."""

import re
from pathlib import Path

import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene, parse_scene
from vsfsim.core.shape import Capsule, Family, MeshFile, Plane, Sphere

FULL = """
name = "full"
description = "All of it."
needs = ["normal-force", "appearance"]
gravity = [0.0, 0.0, -9.81]
[object]
shape = { family = "shoe", length = { uniform = [0.24, 0.28] } }
pose = [0.1, 0.2, 0.3]
yaw = 0.5
fixed = [-0.1, -0.1, 0.0, 0.1, 0.1, 0.01]
tier = "fem"
resolution = 0.02
poisson_ratio = 0.3
density = 400
friction = 0.2
young_modulus = { base = 1e5, inclusions = [{ sphere = [0, 0, 0.01, 0.005], value = 1e7 }] }
appearance = { tint = 0.5 }
[probe]
shape = { capsule = [0.01, 0.02] }
[press]
from = [0, 0, 0.1]
to = [0, 0, 0.09]
frames = 5
hold = 2
retract = 3
[touches]
count = 7
depth = 0.004
approach = 0.02
force_limit = 10.0
frames = { free = 1, in = 4, hold = 2, out = 3 }
[camera]
width = 64
height = 48
fov = 0.7
distance = 0.5
azimuth = { uniform = [-1.0, 1.0] }
elevation = 0.6
[dataset]
objects = 6
views = 2
splits = { train = 4, test = 2 }
"""
SMALL = '[object]\nshape = { box = [0.1, 0.1, 0.05] }\nyoung_modulus = 1e5\n'


def small(more="", *, old="", new=""):
    assert old in SMALL
    return parse_scene(SMALL.replace(old, new) + more if old else SMALL + more, Path("s.toml"))


def test_every_table_is_read():
    s = parse_scene(FULL, Path("there/full.toml")).sample(0)
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
    s = small().sample()
    assert (s.name, s.needs, s.gravity, s.probe) == ("s", ("normal-force",), (0.0, 0.0, 0.0), Sphere(0.02))
    assert s.press is s.touches is s.dataset is None
    assert (s.object.fixed, s.object.tier, s.object.resolution, s.object.poisson_ratio,
            s.object.friction) == ("bottom", "auto", None, 0.45, 0.0)


@pytest.mark.parametrize(("old", "new", "message"), [
    ("name =", "nmae =", "full.toml: unknown key 'nmae'. Did you mean 'name'?"),
    ("base =", "bse =", "full.toml [object] young_modulus: unknown key 'bse'. Did you mean 'base'?"),
    ("free =", "fre =", "full.toml [touches] frames: unknown key 'fre'. Did you mean 'free'?"),
    ("capsule =", "capsul =", "full.toml [probe]: unknown shape 'capsul'. Did you mean 'capsule'?"),
    ('"appearance"]', '"apearance"]', "needs[1] is 'apearance'. Did you mean 'appearance'?"),
    ('["normal-force", "appearance"]', '"bulging"', "needs is 'bulging'; it must be a list of words from normal-force"),
    ("gravity = [0.0, 0.0, -9.81]", "gravity = 9.81", "gravity is 9.81; it must be 3 numbers."),
    ("yaw = 0.5", "yaw = 90", "[object]: yaw is 90; it must be a number from -6.28319 to 6.28319 rad."),
    ('tier = "fem"', 'tier = "fine"', "[object]: tier is 'fine'. Did you mean 'fem-fine'?"),
    ("poisson_ratio = 0.3", "poisson_ratio = 0.5", "poisson_ratio is 0.5; it must be a number from 0 to 0.4999."),
    ("resolution = 0.02", "resolution = 0", "resolution is 0; it must be a number from 1e-05 to 1 m."),
    ("to = [0, 0, 0.09]", "to = [0, 0, 0.1]", "[press]: from and to are both [0.0, 0.0, 0.1]; the probe must move."),
    ("frames = 5", "frames = 2.5", "[press]: frames is 2.5; it must be a whole number from 1 to 10000."),
    ("fov = 0.7", "fov = 45", "[camera]: fov is 45; it must be a number from 0.05 to 2.8 rad."),
    ("train = 4", "train = 3", "[dataset]: splits add up to 5, but there are 6 objects; make them equal."),
    ("train = 4", "train = -4", "[dataset]: splits.train is -4; it must be a whole number >= 0."),
    ("[probe]", "[[probe]]", "[probe] is [{"), ("[probe]", "[sensor]", "[sensor]: unknown key 'shape'"),
])
def test_a_scene_that_says_something_wrong(old, new, message):
    assert old in FULL
    with pytest.raises(SceneError, match=re.escape(message)) as caught:
        parse_scene(FULL.replace(old, new, 1), Path("full.toml"))
    assert str(caught.value).startswith("full.toml") and "\n" not in str(caught.value)


def test_what_is_missing_is_named():
    with pytest.raises(SceneError, match=re.escape("x.toml: there is no [object]; a scene needs one")):
        parse_scene("", Path("x.toml"))


def test_a_distribution_stands_wherever_a_value_may():
    text = FULL
    for value, distribution in (
            ("count = 7", "count = { choice = [7, 9] }"), ("base = 1e5", "base = { loguniform = [1e4, 1e6] }"),
            ("pose = [0.1,", "pose = [{ uniform = [-0.1, 0.1] },"),
            ("{ capsule = [0.01, 0.02] }",
             "{ choice = [{ sphere = { uniform = [0.01, 0.02] } }, { capsule = [0.01, 0.02] }] }")):
        text = text.replace(value, distribution)
    drawn = [parse_scene(text, Path("d.toml")).sample(seed) for seed in range(200)]
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
    scene = parse_scene(FULL, Path("full.toml"))
    assert scene.sample(0) == scene.sample(0) == scene.sample() and scene.sample(5) == scene.sample(5)
    assert len({scene.sample(seed).camera.azimuth for seed in range(20)}) == 20
    stream = [np.random.SeedSequence(0, spawn_key=(k,)) for k in (0, 0, 1)]
    first, same, other = (scene.sample(s) for s in stream)
    assert first == same and first.camera.azimuth != other.camera.azimuth


@pytest.mark.parametrize(("value", "message"), [
    ("{ uniform = [-1e5, 1e5] }", "young_modulus is -100000.0"),
    ("{ choice = [1e5, { uniform = [-2e5, 1e5] }] }", "young_modulus is -200000.0"),
    ("{ uniform = [1e5] }", "give two finite numbers [low, high]"),
    ("{ uniform = 1e5 }", "give a list, e.g. { uniform = [0.1, 0.2] }"),
    ("{ uniform = [2e5, 1e5] }", "it must satisfy low <= high"),
    ("{ loguniform = [0.0, 1e5] }", "it must satisfy 0 < low <= high"),
    ("{ uniform = [1e5, inf] }", "two finite numbers"), ("{ uniform = [1e5, \"a\"] }", "two finite numbers"),
    ("{ choice = [] }", "give a list"),
])
def test_distributions_are_checked_at_load_to_their_ends(value, message):
    with pytest.raises(SceneError, match=re.escape(message)) as caught:
        small(old="young_modulus = 1e5", new=f"young_modulus = {value}")
    assert "s.toml" in str(caught.value)


def test_a_mesh_lies_beside_its_scene():
    assert small(old="{ box = [0.1, 0.1, 0.05] }",
                 new='{ mesh = "m/scan.obj" }').sample().object.shape == MeshFile("m/scan.obj")
    text = SMALL.replace("{ box = [0.1, 0.1, 0.05] }", '{ mesh = "m/scan.obj", scale = 0.01 }')
    assert parse_scene(text, Path("/a/b/s.toml")).sample().object.shape == MeshFile("/a/b/m/scan.obj", 0.01)
    assert parse_scene(text.replace("m/scan", "/m/scan"),
                       Path("/a/b/s.toml")).sample().object.shape == MeshFile("/m/scan.obj", 0.01)


PRESS = "[press]\nfrom = [0, 0, 0.07]\nto = [0, 0, 0.065]\n"
BODIES = """
[probe]
shape = { mesh = "tip.stl", scale = 0.001 }
[[probe.parts]]
shape = { sphere = 0.01 }
offset = [0.03, 0.0, 0.0]
[[probe.parts]]
shape = { mesh = "/m/finger.ply" }
offset = [-0.03, 0, 0]
rotation = [0.0, 0.0, 1.5]
friction = 0.9
[[obstacles]]
shape = { plane = true }
pose = [0.06, 0, 0]
rotation = [0.0, -1.5708, 0.0]
friction = 0.0
"""


def test_several_rigid_bodies():
    s = parse_scene(SMALL + "friction = 0.4\n" + BODIES, Path("/a/s.toml")).sample()
    assert s.bodies == (MeshFile("/a/tip.stl", 0.001), Sphere(0.01), MeshFile("/m/finger.ply"), Plane())
    assert s.frictions == (0.4, 0.4, 0.9, 0.0)
    assert [b.position for b in (*s.parts, *s.obstacles)] == [(0.03, 0.0, 0.0), (-0.03, 0.0, 0.0), (0.06, 0.0, 0.0)]
    assert [b.rotation for b in (*s.parts, *s.obstacles)] == [(0.0, 0.0, 0.0), (0.0, 0.0, 1.5), (0.0, -1.5708, 0.0)]
    assert small().sample().bodies == (Sphere(0.02),) and small().sample().frictions == (0.0,)


def test_paths():
    s = small("[press]\npath = [[0, 0, 0.07], [0, 0, 0.065], [0.01, 0, 0.065]]\nframes = [5, 8]\nrotation = [[0, 0, "
              "0], [0, 0, 0], [0, 0, 0.5]]\nhold = 1\n").sample()
    assert s.press.frames == (5, 8) and s.press.inward == 13
    assert s.press.stop == (0.01, 0.0, 0.065) and s.press.rotation[2] == (0.0, 0.0, 0.5)
    assert small("[press]\npath = [[0, 0, 0.07], [0, 0, 0.065], [0.01, 0, "
                 "0.065]]\nframes = 4\n").sample().press.frames == (4, 4)
    assert small(PRESS + "rotation = [0.1, 0, 0]\n").sample().press.rotation == ((0.1, 0.0, 0.0),) * 2
    # a turn on the spot is a path too
    assert small("[press]\npath = [[0, 0, 0.07], [0, 0, 0.07]]\nrotation = [[0, 0, 0], "
                 "[0, 0, 1]]\n").sample().press.inward == 10


@pytest.mark.parametrize(("text", "message"), [
    ("path = [[0, 0, 0.07]]", "[press]: path is [[0, 0, 0.07]]; it must be 2 to 10000 points"),
    ("path = [[0, 0, 0.07], [0, 0, 0.07]]", "path[0] and path[1] are both [0.0, 0.0, 0.07]; the probe must move."),
    ("path = [[0, 0, 0.07], [0, 0, 0.06]]\nto = [0, 0, 0]", "there is a path, and from or to; give either path"),
    ("path = [[0, 0, 0.07], [0, 0, 0.06]]\nframes = [1, 2]", "frames has 2 numbers, but the path has 1 parts"),
    ("path = [[0, 0, 0.07], [0, 0, 0.06]]\nrotation = [[0, 0, 1]]",
     "rotation has 1 rotation vectors, but the path has 2 points"),
    ("path = [[0, 0, 0.07], [0, 0, 0.06]]\nrotation = [0, 0, 90]",
     "rotation[2] is 90; it must be a number from -6.28319 to 6.28319 rad."),
    ("from = [0, 0, 0.07]", "to is missing; it must be 3 numbers."),
])
def test_paths_that_cannot_be(text, message):
    with pytest.raises(SceneError, match=re.escape(message)) as caught:
        small("[press]\n" + text + "\n")
    assert str(caught.value).startswith("s.toml [press]: ")


@pytest.mark.parametrize(("old", "new", "message"), [
    ("offset = [0.03, 0.0, 0.0]\n", "",
     "s.toml [[probe.parts]] 1: offset is missing; it must be 3 numbers."),
    ("pose = [0.06, 0, 0]\n", "",
     "s.toml [[obstacles]] 1: pose is missing; it must be 3 numbers."),
    ("friction = 0.9", "friction = -0.1", "[[probe.parts]] 2: friction is -0.1; it must be a number from 0 to 10."),
    ("{ plane = true }", "{ rod = [0.1, 0.01] }", "[[obstacles]] 1: unknown shape 'rod'."),
    ("[[obstacles]]", "[obstacles]", "obstacles is {"),
    ('mesh = "tip.stl"', "mesh = 3",
     "[probe]: mesh is 3; give the path of an OBJ"),
    ("[[obstacles]]", "[touches]\ncount = 2\n[[obstacles]]",
     "[touches]: the touches of a dataset are made with one simple probe, which a method can read from it; this scene "
     "has a mesh as its probe."),
    ("[[obstacles]]", "[[obstacles]]\nshape = { sphere = 0.01 }\npose = [0, 0, 1]\n" * 64 + "[[obstacles]]",
     "rigid bodies; 64 are allowed."),
])
def test_bodies_that_cannot_be(old, new, message):
    assert old in BODIES
    with pytest.raises(SceneError, match=re.escape(message)):
        small(BODIES.replace(old, new, 1))


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
