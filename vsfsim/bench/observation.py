"""What a touch is reduced to before a method sees it. A score names its observation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from vsfsim.core.errors import TaskError, did_you_mean


@dataclass(frozen=True)
class Observation:
    """How a force becomes a reading.

    name: e.g. "normal-force". unit: of a reading. size: numbers in a reading, d.
    of: (force on the probe (T, 3) [N], the pressure change (T,) [Pa], or the joint torques (T, 7) [N m]; press
    direction (3,)) -> readings (T, d). doc: one sentence.
    source: which of them, "force", "pressure" or "torque".
    """

    name: str
    unit: str
    size: int
    of: Callable[[np.ndarray, np.ndarray], np.ndarray]
    doc: str
    source: str = "force"


OBSERVATIONS: Mapping[str, Observation] = {
    o.name: o for o in (
        Observation("normal-force", "N", 1, lambda force, axis: (0.0 - force @ axis)[:, None],
                    "Component of the contact force on the probe against the press direction; positive when the object "
                    "pushes back."),
        Observation("force-magnitude", "N", 1, lambda force, axis: np.linalg.norm(force, axis=1)[:, None],
                    "Norm of the contact force on the probe; noise makes it positive without contact."),
        Observation("pressure", "Pa", 1, lambda pressure, axis: pressure[:, None],
                    "Change of the bubble's gauge pressure against the free dome; positive when pressed.", "pressure"),
        Observation("joint-torque", "N m", 7, lambda torque, axis: torque,
                    "Torques of the contact on the seven joints of the arm, weight taken off (SBML eq. 7).", "torque"),
    )
}


def observation(name: str, where: str) -> Observation:
    """The observation called ``name``.

    Raises:
        TaskError: there is none; ``where`` begins the message.
    """
    if name not in OBSERVATIONS:
        raise TaskError(f"{where}: observation '{name}' is unknown. {did_you_mean(name, OBSERVATIONS)}")
    return OBSERVATIONS[name]
