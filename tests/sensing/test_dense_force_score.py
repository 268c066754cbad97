"""The score by hand, and the calibration by net force."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_bubble import bubble, patch

from measurements.dense_force.calibration import FORCE_SCALES, STIFFNESSES, PressRecord, calibrate, noisy, score
from vsfsim.sensing.dense_force import BubbleCalibration, EstimatorOptions
from vsfsim.sensing.membrane_fe import SensorError


def test_scores_by_hand():
    true, found = np.zeros((3, 4, 3)), np.zeros((3, 4, 3))
    # the third is under a tenth of the first
    true[0, 0], true[0, 1], true[0, 2] = [0, 0, -2.0], [0, 0, -1.0], [0, 0, -0.1]
    found[0, 1], found[0, 3] = [0, 0, -1.0], [0, 3.0, 0]
    true[1] = found[1] = [[0, 0, -1.0]] * 4
    out = score(found, true)
    assert out.node_rms == pytest.approx([np.sqrt((4 + 0 + 0.01 + 9) / 4), 0, 0])
    assert out.node_size == pytest.approx([np.sqrt(5.01 / 4), 1, 0])
    assert out.net == pytest.approx([np.hypot(2.1, 3.0), 0, 0]) and out.net_size == pytest.approx([3.1, 4, 0])
    assert out.iou == pytest.approx([1 / 3, 1.0, np.nan], nan_ok=True)  # {0, 1} and {1, 3}; no contact, no figure
    with pytest.raises(SensorError, match=r"\(T, n, 3\)"):
        score(found[0], true[0])


def test_calibration_finds_the_better_weights():
    toy = bubble(5)
    rim = np.zeros(len(toy.rest), bool)
    rim[toy.rim] = True
    x, states = None, []
    for newtons in (0.5, 1.0, 2.0):
        force = patch(toy, (0.0, 0.0), 0.02, newtons)
        x, p = toy.push(force, start=x)
        states.append((x, p, force))
    position, pressure, true = (np.array(part) for part in zip(*states))
    press = noisy(PressRecord("toy", np.zeros(3), position, pressure, true), np.random.default_rng(0),
                  displacement_std=5e-5, pressure_std=5.4)
    assert np.std(press.position - position) == pytest.approx(5e-5, rel=0.1) and (press.force == true).all()
    nominal = BubbleCalibration(toy.rest, toy.triangles, rim, 680.0, toy.pressure)
    chosen, options, error = calibrate(nominal, [press], method="paper", options=EstimatorOptions())

    def net(given, how):
        from vsfsim.sensing.dense_force import DenseForceEstimator
        found = DenseForceEstimator(given, method="paper", options=how).estimate(press.position, press.pressure).force
        return np.sqrt(np.mean(score(found, true).net ** 2))

    assert net(chosen, options) == pytest.approx(error)
    assert error <= net(nominal, EstimatorOptions())
    # no neighbour on either grid is better
    for share in STIFFNESSES:
        assert error <= net(replace(nominal, stiffness=share * 680.0), options) + 1e-12
    for scale in FORCE_SCALES:
        assert error <= net(chosen, replace(options, force_scale=scale)) + 1e-12
