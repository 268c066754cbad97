"""`vsfsim measure plant-likeness`: touches beside each other."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from measurements.artificial_plants.likeness import SHIFTS, beside, difference, measure
from tests.measurements.test_plant_wires import scene
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.plants.admit import grow
from vsfsim.generate.plants.aim import aim_arm, load


def test_the_difference_is_of_the_planned_frames_that_both_made_in_equilibrium():
    one = SimpleNamespace(planned_frame=np.array([0, 1, 2, -1]), converged=np.array([True, True, True, True]),
                          torque=np.array([[0.0], [3.0], [4.0], [9.0]]))
    other = SimpleNamespace(planned_frame=np.array([1, 2, 3]), converged=np.array([True, False, True]),
                            torque=np.array([[1.0], [70.0], [80.0]]))
    assert difference(one, other) == (2.0, 3.0) and difference(other, one) == (2.0, 1.0)
    nothing = SimpleNamespace(planned_frame=np.array([-1]), converged=np.array([True]), torque=np.ones((1, 1)))
    assert difference(one, nothing) == (0.0, 0.0)


def test_a_line_beside_another_is_as_long_and_as_far_away_as_asked(tmp_path):
    chosen = load_scene(find_scene(scene(tmp_path, plant="boxwood", yields="false"))).sample(0)
    arm, plant = load(chosen.arm), grow(chosen, 0)
    (aim,) = aim_arm(arm, chosen.arm, chosen.touches, plant, plant.nodes[-40:], np.random.default_rng,
                     numbers=range(1), where="test")
    moved = beside(arm, aim, 0.01, 0.3)
    tool, other = arm.postures(aim.line).tool[:, :3], arm.postures(moved.line).tool[:, :3]
    way = other[:, :, 3] - tool[:, :, 3]
    assert np.linalg.norm(way, axis=1) == pytest.approx(0.01, abs=3e-5)  # each pose is met to 1e-5 m
    assert np.abs(way @ aim.axis).max() < 3e-5 and np.abs(other[:, :, :3] - tool[:, :, :3]).max() < 3e-4


@pytest.mark.slow
def test_nearer_touches_are_more_alike(tmp_path):
    found = measure(scene=scene(tmp_path, plant="orange-tree", yields="true"), objects=1, touches=4)
    rows = found.tables[0].rows
    assert [row["shift"] for row in rows] == list(SHIFTS)
    assert rows[0]["median"] < 0.5 * rows[-1]["median"]
