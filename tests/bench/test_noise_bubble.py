"""The noise of a Punyo by its statistics. Bounds are multiples of the standard error of the sample, so a right sensor
fails about once in 10^5 seeds."""

import dataclasses

import numpy as np
import pytest

from vsfsim.bench.noise import (
    NOISE_KINDS,
    Noise,
    delayed,
    noisy_node_force,
    noisy_nodes,
    noisy_pressure,
    relaxed,
    window,
)
from vsfsim.bench.task import parse_task

QUIET = Noise(0.0, 0.0, 0.0, 0, 0)
WHICH = {"object_index": 0, "view_index": 0, "touch_index": 0}
SIGMAS = 4.5  # of a normal: 7e-6 on both sides


def punyo(**changes) -> Noise:
    """The real sensor's noise, as a task file with ``kind = "punyo"`` has it."""
    return dataclasses.replace(Noise(**{"offset_std": 0.0, "drift_std": 0.0, "tare_frames": 0, "seed": 0,
                                        **NOISE_KINDS["punyo"]}), **changes)


def seconds(frames):
    return np.arange(frames) / 30.0


def free(frames):
    return np.zeros((frames, 3))


def test_a_task_file_names_the_sensor_and_may_change_a_part(task_text):
    given = 'noise = { force_std = 0.15, offset_std = 0.5, drift_std = 0.0, tare_frames = 2, seed = 0 }'
    assert given in task_text
    noise = parse_task(task_text.replace(given,
                                         'noise = { kind = "punyo", pressure_std = 2.0, tare_frames = 3, seed = 0 }'),
                       "toy-v1.toml").noise
    assert noise == punyo(pressure_std=2.0, tare_frames=3)
    assert parse_task(task_text, "toy-v1.toml").noise == Noise(0.15, 0.5, 0.0, 2, 0)
    # the measured figures (bubble.md)
    assert (punyo().pressure_std, punyo().pressure_drift * 5.0, punyo().depth_std,
            punyo().depth_quantum) == (5.4, -8.0, 5e-5, 1e-4)
    assert 0.14 <= punyo().force_std <= 0.15
    assert punyo().image_lag == 0.077 and punyo().image_lag - punyo().force_lag == pytest.approx(0.058)


def test_pressure_noise_is_white_with_the_measured_size():
    frames = 20_000
    noise = punyo(pressure_drift=0.0)
    out = noisy_pressure(np.zeros(frames), seconds(frames), free(frames), noise, **WHICH)
    # the standard error of a standard deviation is s / sqrt(2 n), of a mean s / sqrt(n)
    assert out.std() == pytest.approx(5.4, abs=SIGMAS * 5.4 / np.sqrt(2 * frames))
    assert out.mean() == pytest.approx(0.0, abs=SIGMAS * 5.4 / np.sqrt(frames))
    # white: no correlation at any lag (standard error 1 / sqrt(n)), and equal power in eight bands (each a mean of n/16
    # exponentials)
    unit = (out - out.mean()) / out.std()
    for lag in (1, 2, 3, 5, 30):
        assert abs(np.mean(unit[:-lag] * unit[lag:])) < SIGMAS / np.sqrt(frames)
    power = np.abs(np.fft.rfft(unit)[1:frames // 2 + 1]) ** 2 / frames
    bands = power.reshape(8, -1).mean(axis=1)
    assert bands == pytest.approx(np.ones(8), abs=SIGMAS / np.sqrt(frames / 16))


def test_drift_has_its_mean_and_spread():
    touches, frames = 800, 151  # five seconds
    noise = punyo(pressure_drift_std=0.5)
    runs = np.stack([noisy_pressure(np.zeros(frames), seconds(frames), free(frames), noise, object_index=0,
                                    view_index=0, touch_index=k) for k in range(touches)])
    rates = np.polyfit(seconds(frames), runs.T, 1)[0]
    # variance of a fitted slope: sigma^2 / sum (t - mean)^2, besides the spread itself
    fit = 5.4**2 / np.sum((seconds(frames) - seconds(frames).mean()) ** 2)
    spread = np.sqrt(0.5**2 + fit)
    assert 5.0 * rates.mean() == pytest.approx(-8.0, abs=5.0 * SIGMAS * spread / np.sqrt(touches))
    assert rates.std() == pytest.approx(spread, abs=SIGMAS * spread / np.sqrt(2 * touches))


def test_a_step_relaxes_by_two_per_cent():
    time = seconds(60)
    clean = np.where(np.arange(60) < 10, 0.0, 1000.0)
    out = noisy_pressure(clean, time, free(60), dataclasses.replace(QUIET, relaxation=0.02, relaxation_time=0.15),
                         **WHICH)
    over = (out - clean)[10:]
    assert (out[:10] == 0.0).all()
    # the step takes one frame, in which a part already relaxes: r x tau/dt (1 - e^(-dt/tau)), then e^(-t/tau)
    assert over[0] == pytest.approx(20.0 * 0.15 * 30 * (1 - np.exp(-1 / 4.5)), rel=1e-12)
    assert over[1:] / over[:-1] == pytest.approx(np.full(49, np.exp(-1 / 4.5)), rel=1e-6)
    # any grid of times gives the same, so it is the sensor's and not the frames'
    fine = np.linspace(0.0, 2.0, 2001)
    slow = relaxed(np.minimum(fine, 1.0), fine, 0.02, 0.15)
    assert slow[::100] == pytest.approx(relaxed(np.minimum(fine, 1.0)[::100], fine[::100], 0.02, 0.15), abs=1e-12)


def test_delay_bridges_what_is_not_known():
    time = np.arange(6.0)
    signal = np.array([0.0, 1.0, np.nan, 3.0, 4.0, 5.0])
    assert delayed(signal, time, 0.5) == pytest.approx([0.0, 0.5, np.nan, 2.5, 3.5, 4.5], nan_ok=True)
    assert delayed(signal, time, 0.0) == pytest.approx(signal, nan_ok=True)
    assert delayed(np.array([np.nan, 2.0]), time[:2], 0.3) == pytest.approx([np.nan, 2.0], nan_ok=True)
    # an unconverged frame leaves its neighbours finite
    out = noisy_pressure(signal, time, free(6), punyo(), **WHICH)
    assert np.isfinite(out).tolist() == [True, True, False, True, True, True]


def test_nodes_move_along_their_rays():
    rng = np.random.default_rng(4)
    position = rng.uniform([-0.03, -0.03, 0.0], [0.03, 0.03, 0.03], (50, 200, 3))
    pose = np.tile(np.eye(4), (50, 1, 1))
    turn, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    pose[:, :3, :3], pose[:, :3, 3] = turn * np.sign(np.linalg.det(turn)), [1.0, 2.0, 3.0]
    world = position @ pose[0, :3, :3].T + pose[0, :3, 3]
    out = noisy_nodes(world, pose, seconds(50), punyo(image_lag=0.0), **WHICH)
    local = (out - pose[0, :3, 3]) @ pose[0, :3, :3]
    before, after = position - [-0.040, 0.0, -0.054], local - [-0.040, 0.0, -0.054]
    assert np.abs(np.cross(before, after)).max() < 1e-15  # m^2: the same ray
    depth = after @ [np.sin(np.radians(25)), 0.0, np.cos(np.radians(25))]
    assert depth / 1e-4 == pytest.approx(np.rint(depth / 1e-4), abs=1e-8)
    error = depth - before @ [np.sin(np.radians(25)), 0.0, np.cos(np.radians(25))]
    assert error.std() == pytest.approx(np.hypot(5e-5, 1e-4 / np.sqrt(12)), rel=SIGMAS / np.sqrt(2 * error.size) + 0.02)


def test_tracking_drifts_across_the_ray_smoothly_over_the_skin():
    axis = np.arange(-0.03, 0.031, 0.002)
    still = np.stack([*np.meshgrid(axis, axis), np.full((len(axis),) * 2, 0.03)], axis=-1).reshape(-1, 3)
    position, pose = np.tile(still, (5, 1, 1)), np.tile(np.eye(4), (5, 1, 1))
    noise = punyo(image_lag=0.0, depth_std=0.0, depth_quantum=0.0, tracking_std=1.5e-4)
    drift = np.stack([noisy_nodes(position, pose, seconds(5), noise, object_index=0, view_index=0, touch_index=k)
                      for k in range(40)]) - still
    assert np.abs(drift[:, 0]).max() < 1e-15 and drift[:, 2] == pytest.approx(0.5 * drift[:, 4], abs=1e-15)
    ray = still - [-0.040, 0.0, -0.054]
    assert np.abs((drift[:, 4] * ray).sum(axis=2)).max() < 1e-15  # m^2
    assert np.sqrt((drift[:, 4] ** 2).sum(axis=2).mean() / 2.0) == pytest.approx(1.5e-4, rel=0.1)
    rows = drift[:, 4].reshape(40, len(axis), len(axis), 3)
    for apart in (2, 5, 10):  # steps of 2 mm, of a correlation length of 10 mm
        alike = (rows[:, :, apart:] * rows[:, :, :-apart]).sum() / (rows[:, :, :-apart] ** 2).sum()
        assert alike == pytest.approx(np.exp(-0.5 * (0.2 * apart) ** 2), abs=0.12)


def test_the_camera_sees_the_nodes_of_its_window():
    turn = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    ring = np.stack([0.06 * np.cos(turn), 0.04 * np.sin(turn), np.zeros(40)], axis=1)
    rest = np.concatenate([ring, 0.83 * ring, 0.85 * ring, [[0.0, 0.0, 0.03]]])
    assert window(rest, punyo()).all()
    seen = window(rest, punyo(window=0.836))
    assert seen.tolist() == [False] * 40 + [True] * 40 + [False] * 40 + [True]


def test_node_forces_are_off_by_their_share_where_there_is_contact():
    rng = np.random.default_rng(6)
    force = np.zeros((300, 390, 3))
    force[:, :100] = 0.05 * rng.standard_normal((300, 100, 3))
    force[7] = np.nan
    out = noisy_node_force(force, seconds(300), punyo(image_lag=0.0), **WHICH)
    assert np.isnan(out[7]).all() and (np.delete(out, 7, axis=0)[:, 100:] == 0.0).all()
    error = np.delete(out - force, 7, axis=0)[:, :100]
    size = np.delete(force, 7, axis=0)[:, :100]
    rms = np.sqrt((error**2).sum(axis=2).mean(axis=1)) / np.sqrt((size**2).sum(axis=2).mean(axis=1))
    # each frame's RMS is that of 300 normals: relative standard error 1 / sqrt(600)
    assert rms == pytest.approx(np.full(299, 0.2), abs=0.2 * SIGMAS / np.sqrt(600))
    assert rms.mean() == pytest.approx(0.2, abs=0.2 * SIGMAS / np.sqrt(600 * 299))
    late = noisy_node_force(np.arange(4.0)[:, None, None] * np.ones((4, 2, 3)), seconds(4),
                            dataclasses.replace(QUIET, image_lag=1 / 60), **WHICH)
    assert late[:, 0, 0] == pytest.approx([0.0, 0.5, 1.5, 2.5])
