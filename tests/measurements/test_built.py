"""`vsfsim measure built`: only what a scene requires is built, and each of its needs changes what is read."""

import numpy as np
import pytest

from measurements.built import arrays_of, measure
from vsfsim.core.scene import load_scene, parse_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.effector import effector_of
from vsfsim.press.command import press

SCENE = """
gravity = [0.0, 0.0, 0.0]
[object]
shape = { box = [0.06, 0.06, 0.03] }
resolution = 0.0125
poisson_ratio = 0.3
[probe]
shape = { sphere = 0.02 }
[press]
from = [0, 0, 0.05]
to = [0, 0, 0.042]
frames = 2
[object.young_modulus]
"""
EVEN = "base = 8e4"
LAYERED = "base = 4e4\ninclusions = [ { box = [-1.0, -1.0, 0.02, 1.0, 1.0, 0.04], value = 3e5 } ]"
NOISE = 0.15
"""Of a force sensor [N], as the tasks have it."""
NEEDS = ("normal-force", "bulging")


def force(stuff, *needs):
    made = press(parse_scene(f"needs = {list(needs)!r}\n{SCENE}{stuff}", "small.toml"), keep=False)
    return made.normal_force[made.result.deepest]


@pytest.mark.parametrize("stuff", [EVEN, pytest.param(LAYERED, marks=pytest.mark.slow)])
def test_a_need_that_is_dropped_is_missed_and_one_that_is_added_is_not(stuff):
    whole, flat, bare, large = (force(stuff, *needs) for needs in (
        NEEDS, NEEDS[:1], ("contact",), (*NEEDS, "large-deformation")))
    print(f"{whole:.1f} N, {flat:.1f} N without bulging, {bare:.1f} N without both, {large - whole:+.2f} N with large "
          f"deformation")
    assert abs(flat - whole) > NOISE and abs(bare - whole) > NOISE and abs(large - whole) < NOISE
    assert force(stuff, *NEEDS, "appearance", "contact", "coupling") == whole, "what is unused changes nothing"


def test_a_bubble_without_an_object_needs_kernels_too():
    scene = load_scene(find_scene("punyo")).sample(0)
    assert scene.object is None and effector_of(scene).kernels(scene)


def test_arrays_are_counted_once():
    one = np.zeros(3)
    assert len(list(arrays_of({"a": one, "b": [one, np.ones(2)], "c": {"d": (one,)}}))) == 2


@pytest.mark.slow
def test_scenes_build_only_what_they_need():
    rows = {row["scene"]: row for row in measure(["foam-block", "plants-v4-mini", "punyo"]).record()["built"]}
    assert all("mujoco" not in row["modules"] and "matplotlib" not in row["modules"] for row in rows.values())
    assert "triangle" in rows["punyo"]["elements"] and rows["foam-block"]["elements"].split()[1:] == ["tet10"]
    assert rows["punyo"]["pictures"] == "-" and rows["foam-block"]["pictures"] == "RGB-D"
