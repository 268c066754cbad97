"""A stiff skin and a stiff plate that are thinner than an element, under a ball: the force on the default mesh."""

from __future__ import annotations

import numpy as np
import pytest

from vsfsim.core.scene import parse_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.generate.effectors.probe import press

SCENE = """
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ box = {box} }}
poisson_ratio = 0.45
{more}
young_modulus = {{ base = 1e4, inclusions = [{part}] }}
[probe]
shape = {{ sphere = 0.01 }}
[press]
from = [0.0, 0.0, {begin}]
to = [0.0, 0.0, {end}]
frames = 3
"""
SKIN = "{ box = [-1.0, -1.0, 0.022, 1.0, 1.0, 1.0], value = 1e7 }"
PLATE = "{ box = [-0.015, -0.015, 0.016, 0.015, 0.015, 0.0175], value = 1e8 }"


def pressed(box, part, *, more=""):
    text = SCENE.format(box=list(box), part=part, more=more, begin=box[2] + 0.01, end=box[2] + 0.007)
    return press(parse_scene(text, "s.toml").sample(0), Request(tier="fem-coarse"))


@pytest.mark.slow
@pytest.mark.parametrize(("box", "part", "least"), [
    ((0.024, 0.024, 0.024), SKIN, 1.5), ((0.06, 0.06, 0.024), SKIN, 3.0), ((0.06, 0.06, 0.024), PLATE, 1.3)])
def test_a_part_thinner_than_an_element_is_felt_on_the_default_mesh(box, part, least):
    """In an element of two materials the soft one decides, so that skin and plate were hardly there. The reference has
    elements of 0.7 of the default's."""
    result = pressed(box, part)
    assert result.resolved.all() and not [note for note in result.notes if "Inclusion" in note]
    bare = pressed(box, "")
    assert result.normal_force[-1] > least * bare.normal_force[-1]
    finer = pressed(box, part, more=f"resolution = {0.7 * result.more['element_size']}")
    assert result.normal_force == pytest.approx(finer.normal_force, rel=0.1)
    assert np.diff(result.normal_force).min() > 0.0
