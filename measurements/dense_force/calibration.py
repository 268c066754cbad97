"""Errors of estimated contact forces against the simulator's true ones, and calibration of an estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vsfsim.sensing.dense_force import BubbleCalibration, DenseForceEstimator, EstimatorOptions
from vsfsim.sensing.membrane_fe import SensorError

REGION = 0.1
"""A node belongs to the contact region if its force exceeds this share of the frame's largest force [-]."""


@dataclass(frozen=True)
class PressRecord:
    """One simulated press on the read-out mesh, in the mount frame."""

    name: str
    depth: np.ndarray
    """Past first contact (T,) [m]."""
    position: np.ndarray
    """Of the nodes (T, n, 3) [m]."""
    pressure: np.ndarray
    """Gauge (T,) [Pa]."""
    force: np.ndarray
    """True contact force on each node (T, n, 3) [N]."""


@dataclass(frozen=True)
class ForceScore:
    """Errors in each of T frames."""

    node_rms: np.ndarray
    """Root mean square over the nodes of the error's length (T,) [N]."""
    node_size: np.ndarray
    """Root mean square over the nodes of the true force's length (T,) [N]."""
    net: np.ndarray
    """Length of the error of the net force (T,) [N]."""
    net_size: np.ndarray
    """Length of the true net force (T,) [N]."""
    iou: np.ndarray
    """Intersection over union of the contact regions (T,) [-]; NaN without contact."""


def score(estimate: np.ndarray, true: np.ndarray) -> ForceScore:
    """Compare estimated with true forces, both (T, n, 3) [N].

    Raises:
        SensorError: shapes that do not match.
    """
    if estimate.shape != true.shape or true.ndim != 3:
        raise SensorError(f"dense force score: estimate {estimate.shape} and truth {true.shape}; "
                          f"both must be (T, n, 3).")
    error = estimate - true
    regions = []
    for force in (estimate, true):
        size = np.linalg.norm(force, axis=2)
        regions.append((size > REGION * size.max(axis=1, keepdims=True)) & (size > 0.0))
    both, either = (regions[0] & regions[1]).sum(axis=1), (regions[0] | regions[1]).sum(axis=1)
    iou = np.where(regions[1].any(axis=1), both / np.maximum(either, 1), np.nan)
    return ForceScore(np.sqrt((error**2).sum(axis=2).mean(axis=1)), np.sqrt((true**2).sum(axis=2).mean(axis=1)),
                      np.linalg.norm(error.sum(axis=1), axis=1), np.linalg.norm(true.sum(axis=1), axis=1), iou)


def noisy(press: PressRecord, rng: np.random.Generator, *, displacement_std: float, pressure_std: float) -> PressRecord:
    """The press with white noise on every node [m], each component alike, and on the pressure [Pa]."""
    return replace(press, position=press.position + displacement_std * rng.standard_normal(press.position.shape),
                   pressure=press.pressure + pressure_std * rng.standard_normal(press.pressure.shape))


STIFFNESSES = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 5.0)
FORCE_SCALES = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5)
STARTS = (0.002, 0.02, 0.2)
"""Grids of `calibrate`: E h over its nominal value [-], the force scale [N], and starting values of the latter [N]."""


def calibrate(calibration: BubbleCalibration, presses: list[PressRecord], *, method: str,
              options: EstimatorOptions) -> tuple[BubbleCalibration, EstimatorOptions, float]:
    """Choose E h and the force scale that minimise the error of the *net* force.

    A real force-torque sensor measures the net force alone; Peng, Yao and Hauser (ICRA 2024) calibrate the same way.
    The two are searched in turn until neither changes, from several starting values.

    Args:
        calibration: with the nominal E h.
        presses: noisy, for calibration only.
        method: of the estimator.
        options: of the estimator; the force scale is replaced.

    Returns:
        The calibration and options with the smallest RMS error of the net force, and that error [N].
    """
    position, pressure = np.concatenate([p.position for p in presses]), np.concatenate([p.pressure for p in presses])
    true = np.concatenate([p.force for p in presses]).sum(axis=1)
    known: dict[tuple[float, float], float] = {}

    def error(share: float, scale: float) -> float:
        if (share, scale) not in known:
            estimator = DenseForceEstimator(replace(calibration, stiffness=share * calibration.stiffness),
                                            method=method, options=replace(options, force_scale=scale))
            net = estimator.estimate(position, pressure).force.sum(axis=1)
            known[share, scale] = float(np.sqrt(np.mean(np.sum((net - true) ** 2, axis=1))))
        return known[share, scale]

    for scale in STARTS:
        share, before = 1.0, (0.0, 0.0)
        while (share, scale) != before:
            before = share, scale
            share = min(STIFFNESSES, key=lambda value: error(value, before[1]))
            scale = min(FORCE_SCALES, key=lambda value: error(share, value))
    share, scale = min(known, key=known.__getitem__)
    return (replace(calibration, stiffness=share * calibration.stiffness), replace(options, force_scale=scale),
            known[share, scale])
