"""What is read of one touch on its way in, and how far it is from the limit of finer meshes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vsfsim.data.records import Touch
from vsfsim.data.verify import unresolved_frames
from vsfsim.generate.aim import Aim
from vsfsim.physics.convergence import Limit

SHALLOW = 0.05
"""Share of a reading's largest value from which a frame counts as in contact [-]."""


@dataclass(frozen=True)
class Curve:
    """Readings of one touch on its way in."""

    share: np.ndarray
    """Of the depth in each frame (T,), rising to 1 [-]."""
    readings: Mapping[str, np.ndarray]
    """By name, each (T, ...), zero without contact: force = its normal component [N], direction = the force as a vector
    (T, 3) [N], torque = moment about the mount (T, 3) [N m], pressure = its change [Pa], dense = force on every node of
    a bubble (T, N, 3) [N]; stiffness = of a small tip where the touch aims (1,) [N/m]."""
    converged: np.ndarray
    """(T,) bool."""
    marked: np.ndarray
    """Frames in contact that did not converge, or are not resolved by the mesh (T,) bool."""


def of_touch(touch: Touch, aim: Aim) -> Curve:
    """The way in of a touch that was aimed so; the first of several frames at full depth is its last."""
    share = (touch.mount_pose[:, :3, 3] - aim.contact) @ aim.axis / aim.depth
    stop = int(np.argmax(share > 1.0 - 1e-6)) + 1
    on = np.arange(stop)[share[:stop] > 1e-6]
    readings = {"force": touch.normal_force()[on], "direction": touch.force[on]}
    if touch.moment is not None and touch.pressure is not None and touch.node_force is not None:
        readings |= {"torque": touch.moment[on], "pressure": touch.pressure[on] - touch.rest_pressure,
                     "dense": touch.node_force[on].astype(float)}
    return Curve(share[on], readings, touch.converged[on], (~touch.converged | unresolved_frames(touch))[on])


@dataclass(frozen=True)
class Distance:
    """How far a reading of one touch is from its limit."""

    rms: float
    """Root mean square over the way in, over the largest value of the limit [-]; of a direction [rad]."""
    worst: float
    """The largest over the way in, likewise."""
    shallow: float
    """In the first frame in contact, over the limit there [-]; of a direction [rad]."""
    full: float
    """At full depth, over the limit there [-]; of a direction [rad]."""
    bar: float
    """What the limit may be off: root mean square of its error over the way in, likewise."""


def distance(name: str, curve: Curve, share: np.ndarray, limit: Limit) -> Distance | None:
    """How far the reading called ``name`` is from its limit, at the depths ``share`` (T,) of the limit.

    Between the frames of the curve readings are interpolated, since that is all that a coarse curve tells. Frames that
    did not converge tell nothing; None if that of full depth did not, or the reading is not there.
    """
    values = curve.readings.get(name)
    if values is None or not curve.converged[-1]:
        return None
    if name == "stiffness":
        found, wanted, error = values[None], limit.value[None], limit.error[None]
    else:
        good = np.flatnonzero(curve.converged)
        at = np.append(0.0, curve.share[good])
        flat = np.concatenate([np.zeros((1, values[0].size)), values[good].reshape(len(good), -1)])
        found = np.stack([np.interp(share, at, column) for column in flat.T], axis=1)
        wanted, error = (v.reshape(len(share), -1) for v in (limit.value, limit.error))
    size = np.linalg.norm(wanted, axis=1)
    if not np.isfinite(found).all() or size.max(initial=0.0) == 0.0:
        return None
    on = np.flatnonzero(size > SHALLOW * size.max())
    off, bar = np.linalg.norm(found - wanted, axis=1), np.linalg.norm(error, axis=1)
    if name == "direction":
        length = np.maximum(np.linalg.norm(found[on], axis=1), 1e-300)
        cosine = np.einsum("ti,ti->t", found[on], wanted[on]) / length / size[on]
        off, bar, size = np.arccos(np.clip(cosine, -1.0, 1.0)), bar[on] / size[on], np.ones(len(on))
        on = np.arange(len(on))
    top = size.max()
    return Distance(float(np.sqrt(np.mean(off**2)) / top), float(off.max() / top), float(off[on[0]] / size[on[0]]),
                    float(off[-1] / size[-1]), float(np.sqrt(np.mean(bar**2)) / top))
