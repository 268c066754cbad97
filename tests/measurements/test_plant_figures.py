"""The figures of a plants dataset's touches, on touches whose answer is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from measurements.artificial_plants.figures import touch_figures
from vsfsim.data.records import Touch


def pushed(stiffness, *, frames=21, free=6):
    """A tool that moves 5 mm a frame along +x and meets a spring after ``free`` frames; joint 2 has a lever of half a
    metre."""
    travel = 0.005 * np.arange(frames)
    force = stiffness * np.maximum(travel - travel[free], 0.0)
    pose = np.tile(np.eye(4), (frames, 1, 1))
    pose[:, 0, 3] = travel
    torque = np.zeros((frames, 7))
    torque[:, 1] = 0.5 * force
    vector = np.zeros((frames, 3))
    vector[:, 0] = -force
    good = np.ones(frames, bool)
    return Touch(np.arange(frames) / 30.0, pose, np.array([1.0, 0, 0]), np.zeros(3), np.array([-1.0, 0, 0]), vector,
                 vector, good, np.zeros(frames), np.zeros(frames, int), True, np.zeros(frames, int), torque=torque,
                 planned_time=np.arange(frames + 3) / 30.0)


def test_a_spring_has_its_stiffness_and_its_torque():
    touch = pushed(150.0)
    found = touch_figures(touch)
    assert found["stiffness"] == pytest.approx(150.0) and found["peak"] == pytest.approx(150.0 * 0.07)
    assert found["norm"] == pytest.approx(0.5 * found["rms_force"]) and found["cut"] == 1.0
    wrong = dataclasses.replace(touch, converged=np.arange(21) != 20)
    assert touch_figures(wrong)["peak"] == pytest.approx(150.0 * 0.065) and touch_figures(wrong)["unconverged"] > 0.0


def test_without_torques_there_are_no_figures_and_without_contact_no_stiffness():
    assert touch_figures(dataclasses.replace(pushed(10.0), torque=None)) is None
    assert np.isnan(touch_figures(pushed(0.0))["stiffness"])
