"""Each of a scene's needs changes what is read, and what is not needed does not."""

import pytest

from vsfsim.core.scene import parse_scene
from vsfsim.physics.tiers import choose
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
    scene = parse_scene(f"needs = {list(needs)!r}\n{SCENE}{stuff}", "small.toml")
    made = press(scene, tier=choose(scene.sample(0)))  # a tier that is asked for is kept, however far elements turn
    return made.normal_force[made.result.deepest]


@pytest.mark.parametrize("stuff", [EVEN, pytest.param(LAYERED, marks=pytest.mark.slow)])
def test_a_need_that_is_dropped_is_missed_and_one_that_is_added_is_not(stuff):
    whole, flat, bare, large = (force(stuff, *needs) for needs in (
        NEEDS, NEEDS[:1], ("contact",), (*NEEDS, "large-deformation")))
    assert abs(flat - whole) > NOISE and abs(bare - whole) > NOISE and abs(large - whole) < NOISE
    assert force(stuff, *NEEDS, "appearance", "contact", "coupling") == whole, "what is unused changes nothing"
