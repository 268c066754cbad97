"""Each of a scene's needs changes what is read, and what is not needed does not."""

import pytest
import texts

from vsfsim.physics.tiers import choose
from vsfsim.press.command import press

LAYERED = "{ base = 4e4, inclusions = [{ box = [-1.0, -1.0, 0.02, 1.0, 1.0, 0.04], value = 3e5 }] }"
NOISE = 0.15
"""Of a force sensor [N], as the tasks have it."""
NEEDS = ("normal-force", "bulging")


def force(stuff, *needs):
    scene = texts.scene("block", needs=list(needs), resolution=0.0125, young_modulus=stuff,
                        probe="{ shape = { sphere = 0.02 } }",
                        press="{ path = [[0, 0, 0.05], [0, 0, 0.042]], frames = 2 }")
    made = press(scene, tier=choose(scene.sample(0)))  # a tier that is asked for is kept, however far elements turn
    return made.normal_force[made.result.deepest]


@pytest.mark.parametrize("stuff", [8e4, pytest.param(LAYERED, marks=pytest.mark.slow)])
def test_a_need_that_is_dropped_is_missed_and_one_that_is_added_is_not(stuff):
    whole, flat, bare, large = (force(stuff, *needs) for needs in (
        NEEDS, NEEDS[:1], ("contact",), (*NEEDS, "large-deformation")))
    assert abs(flat - whole) > NOISE and abs(bare - whole) > NOISE and abs(large - whole) < NOISE
    assert force(stuff, *NEEDS, "appearance", "contact", "coupling") == whole, "what is unused changes nothing"
