"""The comparison of force estimators: rows and table on a bubble of the tests' own, and (slow) one real press."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "sensing"))
from toy_bubble import bubble, patch

from measurements import dense_force as bench
from measurements.dense_force import calibration as search
from measurements.dense_force.calibration import PressRecord
from vsfsim.sensing.dense_force import BubbleCalibration


def press(toy, name, centre, newtons):
    states, x = [], None
    for share, depth in ((0.3, 0.002), (1.0, 0.005)):
        force = patch(toy, centre, 0.02, share * newtons)
        x, p = toy.push(force, start=x)
        states.append((depth, x, p, force))
    depth, position, pressure, force = (np.array(part) for part in zip(*states))
    return PressRecord(name, depth, position, pressure, force)


def test_rows_and_report(monkeypatch):
    monkeypatch.setattr(search, "STIFFNESSES", (1.0, 2.0))
    monkeypatch.setattr(search, "FORCE_SCALES", (0.02, 0.1))
    toy = bubble(5)
    rim = np.zeros(len(toy.rest), bool)
    rim[toy.rim] = True
    calibration = BubbleCalibration(toy.rest, toy.triangles, rim, 680.0, toy.pressure, reference=toy.flat)
    presses = [press(toy, "middle", (0.0, 0.0), 3.0), press(toy, "aside", (0.01, 0.01), 2.0)]
    field = bench.contenders(calibration, [press(toy, "other", (-0.01, 0.0), 3.0)])
    assert [c.label for c in field] == ["residual", "released", "paper", "taut", "membrane", "membrane, E h +10 %"]
    rows = bench.compare(field, presses, noise=(0.0, 5e-5))
    # contenders, noises, the two bins that hold a frame
    assert len(rows) == 6 * 2 * 2 and all(r.frames == 2 for r in rows)
    by = {(r.label, r.noise, r.low): r for r in rows}
    shallow = by["membrane", 0.0, 0.0]
    assert shallow.net_size == pytest.approx(0.3 * np.sqrt((9 + 4) / 2))
    assert shallow.node_rms < 0.2 * shallow.node_size and shallow.converged == 1.0
    for low in (0.0, 3e-3):
        assert by["membrane", 5e-5, low].node_rms < by["paper", 5e-5, low].node_rms < by["residual", 5e-5, low].node_rms
        assert by["membrane", 0.0, low].node_rms < by["membrane, E h +10 %", 0.0, low].node_rms
    found = bench.report({}, rows, field, presses)
    text = found.text()
    assert "2 presses (middle, aside), 4 frames" in text and "calibrated by" in text and "noise 0.05 mm" in text
    assert f"{shallow.node_rms:.4f}" in text
    assert len(found.record()["rows"]) == len(rows) and set(found.record()["calibrated"]) == {"paper", "taut"}


@pytest.mark.slow
def test_a_real_press(tmp_path):
    from vsfsim.core.bubble import Bubble
    from vsfsim.physics.bubble.sensor import build_bubble

    model = build_bubble(Bubble(nodes=800), cache=tmp_path)
    (one,) = bench.simulate(model, ((bench.BALL, (bench.Spot("ball", 0.01, 0.0),)),))
    assert len(one.depth) >= 5 and one.depth[-1] == 0.01
    net = one.force.sum(axis=1)
    assert (np.diff(np.linalg.norm(net, axis=1)) >= 0).all() and net[-1, 2] < -3.0  # N, into the dome
    assert (np.diff(one.pressure) > 0).all()
    calibration = bench.calibration_of(model)
    assert calibration.rest[:, 2].max() == pytest.approx(0.0305, abs=0.0005)
    found = {m: bench.DenseForceEstimator(calibration, method=m).estimate(one.position, one.pressure).force
             for m in ("paper", "membrane")}
    error = {m: np.linalg.norm(f - one.force) for m, f in found.items()}
    assert error["membrane"] < 0.5 * error["paper"]
