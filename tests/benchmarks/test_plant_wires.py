"""When the wires of an artificial plant would yield, by a cantilever whose moment is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.artificial_plants.wires import PLATEAU, YIELD_STRESS, bending_moment, plastic_moment
from vsfsim.physics.rods.model import build
from vsfsim.scenes.artificial_plant import grow


@pytest.fixture(scope="module")
def plant():
    return grow({"plant": "umbrella-tree", "variation": 0.0, "wood_segments": 40, "leaf_segments": 12},
                np.random.default_rng(0), where="test")


def test_a_segment_bent_by_an_angle_has_its_stiffness_times_the_angle(plant):
    model, angle = build(plant), 0.02
    segment = int(np.flatnonzero(plant.region == 1)[2])
    turns = np.tile([0.0, 0.0, 0.0, 1.0], (len(plant.nodes), 1))
    carried = np.zeros(len(plant.nodes), bool)  # the node and all that grows on it turn together
    carried[segment] = True
    for i in range(segment + 1, len(plant.nodes)):
        carried[i] = carried[plant.parent[i]]
    turns[carried] = Rotation.from_rotvec(angle * model.frame[segment][:, 1]).as_quat()
    moment = bending_moment(model, turns)
    assert moment[segment] == pytest.approx(model.kphi[segment, 1] * angle)
    assert np.delete(moment, segment).max() < 1e-12


def test_the_plastic_moment_is_that_of_the_wire_and_wood_and_leaves_have_none(plant):
    """Stems of 12 mm with a core of 0.45 of that: 5.4 mm, give or take the spread of 5 % a part."""
    limit = plastic_moment(plant)
    stems = limit[plant.region == 1]
    assert np.median(stems) == pytest.approx(PLATEAU * YIELD_STRESS * np.pi * 0.0054**3 / 32.0, rel=0.25)
    assert np.isinf(limit[plant.region >= 3]).all()
    tree = grow({"plant": "orange-tree"}, np.random.default_rng(0), where="test")
    assert np.isinf(plastic_moment(tree)[tree.region == 1]).all() and np.isfinite(plastic_moment(tree)).any()
