"""What seven torque sensors add to the torques: offset, drift, noise, a weight not quite known, and the tare that takes
some of it off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.robot import gen3
from vsfsim.robot.arm import ArmError
from vsfsim.robot.mjcf import Seven


@dataclass(frozen=True)
class TorqueSensor:
    """Standard deviations of the errors; normal, independent between joints and touches.

    noise: white, every reading (7,) [N m]. offset: constant through a touch (7,) [N m]. drift: random walk, after one
    second (7,) [N m].
    weight: error of the weight that is taken off, relative to it [-]. tare: readings at the beginning of a touch whose
    mean is taken off; they must be free of contact; 0: no tare.

    The maker publishes none of them. ``offset``: users of a Gen3 zero their torques by hand after every start and find
    offsets of newton metres (Kinova-kortex2_Gen3_G3L, issues 38 and 189; ros_kortex, issue 237). ``weight``: the
    released recordings of openvsf have a tare of 18.2 N m on joint 2 where the model says 19.1. ``noise`` and ``drift``
    are assumptions: 0.1 % of the peak torque, a tenth of that after a second.
    """

    noise: Seven = (0.1,) * 4 + (0.05,) * 3
    offset: Seven = (0.5,) * 4 + (0.25,) * 3
    drift: Seven = (0.01,) * 4 + (0.005,) * 3
    weight: float = 0.05
    tare: int = 10


IDEAL = TorqueSensor((0.0,) * 7, (0.0,) * 7, (0.0,) * 7, 0.0, 0)
"""Adds nothing."""


def read(torque: np.ndarray, weight: np.ndarray, times: np.ndarray, seed: np.random.SeedSequence | int, *,
         sensor: TorqueSensor | None = None) -> np.ndarray:
    """Readings (T, 7) [N m] of the joint torques of one touch.

    Args:
        torque: of the contact, from the kinematic or the dynamic arm (T, 7) [N m].
        weight: torques that hold the arm's weight at the same postures, `Arm.gravity_torque` (T, 7) [N m].
        times: of the readings (T,) [s]. seed: of this touch; the same seed gives the same bits.
        sensor: `TorqueSensor()` by default.

    Raises:
        ArmError: shapes that do not fit, or fewer readings than the tare takes.
    """
    sensor = sensor or TorqueSensor()
    torque, weight, times = np.asarray(torque, float), np.asarray(weight, float), np.asarray(times, float)
    if (torque.ndim != 2 or torque.shape[1] != gen3.JOINTS or weight.shape != torque.shape
        or times.shape != torque.shape[:1]):
        raise ArmError(f"torque, weight and times have the shapes {torque.shape}, {weight.shape} and {times.shape}; "
                       f"give (T, 7), (T, 7) and (T,).")
    if not 0 <= sensor.tare <= len(times):
        raise ArmError(f"tare is {sensor.tare} readings, but the touch has {len(times)}; give 0 to {len(times)}.")
    # a stream for each error: one switched off leaves the others as they were
    root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
    # not spawn(): that would give other streams the second time
    white, constant, walk, share = (np.random.default_rng(np.random.SeedSequence(root.entropy,
                                                                                 spawn_key=(*root.spawn_key, k)))
                                    for k in range(4))
    shape = torque.shape
    steps = np.sqrt(np.diff(times, prepend=times[:1]))[:, None] * walk.normal(size=shape)
    out = torque + np.array(sensor.noise) * white.normal(size=shape)
    out += np.array(sensor.offset) * constant.normal(size=shape[1])
    out += np.array(sensor.drift) * np.cumsum(steps, axis=0)
    out += sensor.weight * share.normal(size=shape[1]) * weight
    return out - out[:sensor.tare].mean(axis=0) if sensor.tare else out
