"""Boxes, layers and skins inside a body are cut out by its elements; what the mesh does not hold is told."""

from __future__ import annotations

import numpy as np
import pytest
from texts import scene

from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.core.solid import tet_volumes
from vsfsim.physics import tiers


def body(parts, *, shape="box = [0.06, 0.06, 0.024]", resolution=None, focus=None):
    made = scene("block", shape=f"{{ {shape} }}", resolution=resolution, press=None, poisson_ratio=None,
                 young_modulus=f"{{ base = 1e4, inclusions = [{parts}] }}").sample(0)
    return tiers.body(made, "fem-coarse", focus=focus)


@pytest.mark.parametrize(("box", "value"), [
    ((-0.1, -0.1, 0.022, 0.1, 0.1, 0.024), 1e7), ((-0.015, -0.015, 0.016, 0.015, 0.015, 0.0175), 1e8),
    ((0.003, -0.02, 0.004, 0.0035, 0.01, 0.02), 1e7),
    pytest.param((-0.03, -0.03, 0.01, 0.03, 0.03, 0.0104), 1e2, marks=pytest.mark.slow)])
@pytest.mark.parametrize("focus", [None, np.array([[0.004, 0.0, 0.024]])])
def test_a_box_inside_a_block_is_cut_out_by_its_elements(box, value, focus):
    solid, modulus = body(f"{{ box = {list(box)}, value = {value} }}", focus=focus)
    volume = tet_volumes(solid.vertices, solid.tets)
    low, high = np.maximum(box[:3], (-0.03, -0.03, 0.0)), np.minimum(box[3:], (0.03, 0.03, 0.024))
    assert (volume > 0.0).all() and volume.sum() == pytest.approx(0.06 * 0.06 * 0.024)
    inside = np.isclose(modulus[:, 0], value)
    assert np.allclose(modulus[~inside], 1e4), "no element of two materials"
    assert volume[inside].sum() == pytest.approx(np.prod(high - low))
    thin = int(np.argmin(high - low))
    ticks = np.unique(solid.vertices[solid.tets[inside]][..., thin].round(9))
    assert len(ticks) >= 3, "two elements across"
    assert solid.parts < 1e-6 and not [n for n in solid.notes if "Inclusion" in n]


def test_layers_of_a_cylinder_are_cut_out_by_its_elements():
    """The second lies over the first, with 3 % of its thickness between them."""
    solid, modulus = body("{ box = [-1, -1, 0.010, 1, 1, 0.0112], value = 1e7 },"
                          "{ box = [-1, -1, 0.011236, 1, 1, 0.014], value = 1e6 }",
                          shape="cylinder = [0.009, 0.024]", resolution=0.008)
    volume = tet_volumes(solid.vertices, solid.tets)
    for value, height in ((1e7, 1.2), (1e6, 2.764), (1e4, 20.036)):
        assert volume[np.isclose(modulus[:, 0], value)].sum() == pytest.approx(volume.sum() * height / 24.0)


@pytest.mark.parametrize(("part", "least", "words"), [
    ("{ sphere = [0.0, 0.0, 0.012, 0.002], value = 1e7 }", 0.4, "too small or soft"),
    ("{ capsule = [-0.01, 0.0, 0.012, 0.01, 0.002, 0.013, 0.001], value = 1e8 }", 0.5, "too small or soft"),
    ("{ sphere = [0.004, 0.003, 0.012, 0.0015], value = 1e1 }", 0.5, "too large")])
def test_what_the_mesh_does_not_hold_is_told_with_its_share(part, least, words):
    solid, _ = body(part)
    assert solid.parts > least
    note = next(n for n in solid.notes if "Inclusion 1" in n)
    assert words in note and f"{100 * solid.parts:.0f} %" in note
    coarse = solid.parts
    finer, _ = body(part, resolution=0.0025)
    assert finer.parts < coarse


def test_a_thin_skin_around_an_inclusion_is_told():
    """2 mm of a stiff ball around a soft core: the core is off by 11 %, the skin by more than half."""
    core = "{ sphere = [0.0, 0.0, 0.03, 0.028], value = 1e1 }"
    solid, _ = body(core, shape="sphere = 0.03")
    assert solid.parts > 0.5 and any("around the inclusions" in n for n in solid.notes)
    finer, _ = body(core, shape="sphere = 0.03", resolution=0.004)
    assert finer.parts < solid.parts
    thick, _ = body("{ sphere = [0.0, 0.0, 0.03, 0.01], value = 1e1 }", shape="sphere = 0.03")
    assert not any("around the inclusions" in n for n in thick.notes)


@pytest.mark.parametrize(("tier", "most"), [("fem-coarse", 0.25), ("fem", 0.15)])
def test_a_ball_that_is_stiff_anyway_is_not_marked_for_its_mixed_elements(tier, most):
    """S2's ball, 100 times as stiff as the block. Forces at 5 mm are +0.6, -5.8 and -2.2 % off on three meshes of
    `fem-coarse`, a tenth of what the ball adds, and it was told as 47 % too soft."""
    solid, _ = tiers.body(load_scene(find_scene("indent")).sample(0), tier)
    assert 0.02 < solid.parts < most
