"""The noise of forces, against closed forms, and of an arm's joint torques: its size against a real arm's."""

from __future__ import annotations

import dataclasses
from functools import partial

import numpy as np
import pytest

from vsfsim.bench.noise import NOISE_KINDS, Noise, hysteresis, noisy_force, noisy_torque, posture_error

WHICH = {"object_index": 3, "view_index": 1, "touch_index": 7}
POSED = Noise(**{"offset_std": 0.0, "drift_std": 0.0, "tare_frames": 5, "seed": 0, **NOISE_KINDS["gen3-posed"]})


def path(rng, frames=63):
    """Joint angles of a touch that moves in, stands, and moves out, its first frames at rest (T, 7) [rad]."""
    way = np.concatenate([np.zeros(5), np.linspace(0.0, 1.0, frames - 17), np.ones(2), np.linspace(1.0, 0.0, 10)])
    return rng.uniform(-1.5, 1.5, 7) + way[:, None] * rng.uniform(-0.4, 0.4, 7)


def test_a_touch_that_meets_nothing_reads_what_a_real_gen3_does():
    """A real one leaves 0.45 N m a joint and a norm of 1.2 (openvsf's notebook, one touch); over touches ours must have
    the same size within a third."""
    rng, values = np.random.default_rng(0), []
    for k in range(60):
        q = path(rng)
        zero = np.zeros((len(q), 7))
        values.append(noisy_torque(zero, np.arange(len(q)) / 30.0, zero[:, :3], POSED,
                                   object_index=0, view_index=0, touch_index=k, q=q))
    per_joint = np.sqrt(np.mean(np.square(values)))
    norm = np.mean([np.sqrt((v**2).sum(axis=1).mean()) for v in values])
    assert 0.3 < per_joint < 0.6 and 0.8 < norm < 1.6, (per_joint, norm)


def test_the_gravity_models_error_is_one_smooth_function_of_posture_without_joint_1():
    rng = np.random.default_rng(1)
    q = rng.uniform(-2.0, 2.0, (4000, 7))
    error = posture_error(q, POSED)
    size = error.std(axis=0)
    # 0.3 rad is what a task gets that names the spread alone
    assert np.array_equal(error, posture_error(q, Noise(0.0, 0.0, 0.0, 0, 0, torque_pose_std=0.4)))
    assert (size[[1, 3, 5]] > 0.28).all() and (size[[1, 3, 5]] < 0.52).all() and (size[[0, 2]] < 0.2).all()
    turned = q + np.eye(7)[0] * 0.7
    assert np.allclose(posture_error(turned, POSED), error)
    near, far = (np.corrcoef(error[:, 1], posture_error(q + by * np.eye(7)[1], POSED)[:, 1])[0, 1] for by in (0.1, 0.9))
    # exp(-(0.1 / 0.3)^2 / 2) = 0.95 and exp(-(0.9 / 0.3)^2 / 2) = 0.01
    assert near == pytest.approx(0.95, abs=0.04) and abs(far) < 0.15


def test_hysteresis_changes_with_the_direction_of_motion_and_stays_at_rest():
    q = np.zeros((6, 7))
    q[:, 0] = [0.0, 0.0, 0.1, 0.2, 0.2, 0.1]
    found = hysteresis(q, np.full(7, -1.0), POSED)
    height = abs(found[0, 0])
    assert 0.2 <= height <= 0.4
    assert np.allclose(found[:, 0], height * np.array([-1, -1, 1, 1, 1, -1]))
    assert (found[:, 1] == found[0, 1]).all()
    only = dataclasses.replace(POSED, torque_pose_std=0.0, tare_frames=0)
    with_it, without = (noisy_torque(0.0 * q, np.arange(6.0), q[:, :3], only, q=at, **WHICH) for at in (q, None))
    size = height * np.array([-1, -1, 1, 1, 1, -1])
    assert np.allclose(np.abs((with_it - without)[:, 0]), height) and np.allclose((with_it - without)[2:, 0], size[2:])


# ------------------------------------------------------------------ the force of any sensor


noise = partial(Noise, seed=0)


def read(force, noise, **which):
    return noisy_force(force, np.arange(len(force)) / 30.0, force, noise, **which)


def touch():
    """Five frames in free air, then a push along z to 5 N."""
    force = np.zeros((25, 3))
    force[5:, 2] = np.linspace(0.25, 5.0, 20)
    return force


def test_the_tare_takes_the_offset_away_and_no_more():
    """Without white noise and drift a tared force is the true one, whatever the offset; without a tare it is off by the
    offset, the same in all frames."""
    quiet = {"force_std": 0.0, "drift_std": 0.0, "offset_std": 2.0}
    assert read(touch(), noise(**quiet, tare_frames=3), **WHICH) == pytest.approx(touch(), abs=1e-12)
    off = read(touch(), noise(**quiet, tare_frames=0), **WHICH) - touch()
    assert np.abs(off).max() > 0.1 and off == pytest.approx(np.tile(off[0], (25, 1)), abs=1e-12)


def test_the_tare_is_the_mean_of_the_frames_before_contact():
    """As many as there are: of five free frames a tare of nine takes five, of a touch that begins in contact none."""
    white = {"force_std": 0.3, "drift_std": 0.0, "offset_std": 2.0}
    raw = read(touch(), noise(**white, tare_frames=0), **WHICH)
    for wanted, taken in ((1, 1), (3, 3), (5, 5), (9, 5)):
        found = read(touch(), noise(**white, tare_frames=wanted), **WHICH)
        assert found == pytest.approx(raw - raw[:taken].mean(axis=0), abs=1e-12), wanted
    pressed = touch()[5:]
    assert read(pressed, noise(**white, tare_frames=3), **WHICH) == pytest.approx(
        read(pressed, noise(**white, tare_frames=0), **WHICH))


def test_the_white_noise_has_the_stated_spread_and_the_drift_ends_at_its_own():
    force = np.zeros((4000, 3))
    found = read(force, noise(force_std=0.3, drift_std=0.0, offset_std=0.0, tare_frames=0), **WHICH)
    assert found.std() == pytest.approx(0.3, rel=0.03) and abs(found.mean()) < 0.02
    ends = np.array([read(force[:20], noise(force_std=0.0, drift_std=0.5, offset_std=0.0, tare_frames=1),
                                 object_index=k, view_index=0, touch_index=0)[[0, 10, -1]] for k in range(400)])
    assert np.abs(ends[:, 0]).max() == 0.0 and ends[:, 2].std() == pytest.approx(0.5, rel=0.08)
    assert ends[:, 1] == pytest.approx(ends[:, 2] * 10.0 / 19.0)
