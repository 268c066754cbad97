"""`vsfsim measure built`: only what a scene requires is built, and each of its needs changes what is read."""

import numpy as np
import pytest

from benchmarks.built import arrays_of, measure
from vsfsim.core.scene import parse_scene
from vsfsim.press.command import press

SCENE = """
gravity = [0.0, 0.0, 0.0]
[object]
shape = { box = [0.06, 0.06, 0.03] }
resolution = 0.015
young_modulus = 3e5
poisson_ratio = 0.3
[probe]
shape = { sphere = 0.02 }
[press]
from = [0, 0, 0.05]
to = [0, 0, 0.045]
frames = 2
"""
NOISE = 0.15
"""Of a force sensor [N], as the tasks have it."""


def force(*needs):
    made = press(parse_scene(f"needs = {list(needs)!r}\n{SCENE}", "small.toml"), keep=False)
    return made.normal_force[made.result.deepest]


def test_a_need_that_is_dropped_is_missed_and_one_that_is_added_is_not():
    whole = force("normal-force", "bulging")
    assert abs(force("contact") - whole) > NOISE and abs(force("normal-force") - whole) > NOISE
    assert force("normal-force", "bulging", "appearance", "contact") == whole, "what is unused changes nothing"


def test_arrays_are_counted_once():
    one = np.zeros(3)
    assert len(list(arrays_of({"a": one, "b": [one, np.ones(2)], "c": {"d": (one,)}}))) == 2


@pytest.mark.slow
def test_scenes_build_only_what_they_need():
    rows = {row["scene"]: row for row in measure(["foam-block", "plants-v4-mini", "punyo"]).record()["built"]}
    assert all("mujoco" not in row["modules"] and "matplotlib" not in row["modules"] for row in rows.values())
    assert "triangle" in rows["punyo"]["elements"] and rows["foam-block"]["elements"].split()[1:] == ["tet10"]
    assert rows["punyo"]["pictures"] == "-" and rows["foam-block"]["pictures"] == "RGB-D"
