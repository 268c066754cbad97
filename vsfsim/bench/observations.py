"""The table of observations: what a task may read of a touch. One row holds everything that is special to one of them.

The protocol reads a touch by its row, the baselines predict readings by its row, and neither asks for a name. A new
observation is one row here and the function that its ``rows`` names. A row whose channel is not in the dataset yet also
brings its `Channel`. Every observation is scored by the metrics of `vsfsim.bench.metrics`, in its own unit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import EntryPoint

import numpy as np

from vsfsim.bench.noise import noisy_force, noisy_pressure, noisy_torque
from vsfsim.core.errors import TaskError, did_you_mean
from vsfsim.core.shelf import Registry
from vsfsim.data.records import Touch


@dataclass(frozen=True)
class Channel:
    """A quantity of a touch that a sensor reads, and the sensor's noise."""
    name: str
    """For messages: "a touch has no <name>"."""
    made_with: str
    """What a scene needs so that a touch has it, for messages."""
    clean: Callable[[Touch], np.ndarray | None]
    """The noise-free values (T, ...) of a touch; None where the dataset does not hold them."""
    noisy: Callable[..., np.ndarray]
    """(clean values with NaN in unconverged frames, time (T,) [s], clean force (T, 3) [N], `Noise`, object_index,
    view_index, touch_index) -> values as a real sensor shows them, of the same shape. It may take more keywords, those
    of `motion`."""
    motion: Callable[[Touch], Mapping[str, np.ndarray | None]] = lambda touch: {}
    """Keywords of ``noisy`` that say how the sensor moved."""


@dataclass(frozen=True)
class Observation:
    """One row of the table."""
    name: str
    """As a task file writes it, e.g. "normal-force"."""
    unit: str
    """Of a reading."""
    size: int
    """Numbers in a reading, d."""
    channel: Channel
    """Where in the dataset it is read, and with which noise."""
    reading: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(values of the channel (T, ...), press direction (3,)) -> readings (T, d)."""
    rows: str
    """``module:function`` that predicts it from particles, see `vsfsim.vsf.observations`. It is named, not imported,
    because scoring needs no particle model."""
    doc: str
    """One sentence."""
    force_per_unit: float = 1.0
    """Force that a reading of 1 stands for [N]; 1 for a reading that is a force, or no multiple of one. The function in
    ``rows`` predicts the reading times this."""
    along_press: bool = False
    """The reading is the component of the total force along the press, up to `force_per_unit`."""

    def predictor(self) -> Callable[..., object]:
        """The function that ``rows`` names.

        Raises:
            TaskError: it cannot be imported.
        """
        try:
            return EntryPoint("", self.rows, "").load()
        except (ImportError, AttributeError) as error:
            raise TaskError(f"observation '{self.name}': its rows '{self.rows}' cannot be loaded: {error}.") from error


def _pressure_change(touch: Touch) -> np.ndarray | None:
    if touch.pressure is None or touch.rest_pressure is None:
        return None
    return touch.pressure - touch.rest_pressure


def _read_force(touch: Touch) -> np.ndarray | None:
    """The contact force; None where no sensor read it, as in recordings of real objects."""
    unread = touch.converged.any() and np.isnan(touch.force[touch.converged]).all()
    return None if unread else touch.force


FORCE = Channel("contact force", "a force sensor", _read_force, noisy_force)
PRESSURE = Channel("pressure", "a bubble, a [sensor] in the scene", _pressure_change, noisy_pressure)
TORQUE = Channel("joint torques", "an arm, an [arm] in the scene", lambda touch: touch.torque, noisy_torque,
                 lambda touch: {"q": touch.q})

PUNYO_RIM_AREA = 7.18e-3
"""Area inside the rim of a Punyo [m^2]: pi times its semi-axes. It converts a pressure to a force. The stiffness
absorbs what the gas adds to this law (SBML eq. 8)."""

OBSERVATIONS: Registry[Observation] = Registry("vsfsim.observations", {
    o.name: o for o in (
        Observation("normal-force", "N", 1, FORCE, lambda force, axis: (0.0 - force @ axis)[:, None],
                    "vsfsim.vsf.observations:normal_force",
                    "Component of the contact force on the probe against the press direction; positive when the object "
                    "pushes back.", along_press=True),
        Observation("force-magnitude", "N", 1, FORCE, lambda force, axis: np.linalg.norm(force, axis=1)[:, None],
                    "vsfsim.vsf.observations:force_sum",
                    "Norm of the contact force on the probe; noise makes it positive without contact."),
        Observation("pressure", "Pa", 1, PRESSURE, lambda pressure, axis: pressure[:, None],
                    "vsfsim.vsf.observations:force_sum",
                    "Change of the bubble's gauge pressure against the free dome; positive when pressed.",
                    force_per_unit=PUNYO_RIM_AREA, along_press=True),
        Observation("joint-torque", "N m", 7, TORQUE, lambda torque, axis: torque,
                    "vsfsim.vsf.observations:joint_torque",
                    "Torques of the contact on the seven joints of the arm, without those of the arm's weight "
                    "(SBML eq. 7)."),
    )
})
"""The table, by name; a package adds rows by entry points of the group ``vsfsim.observations``."""


def observation(name: str, where: str) -> Observation:
    """The observation called ``name``.

    Raises:
        TaskError: there is none; ``where`` begins the message.
    """
    if name not in OBSERVATIONS:
        raise TaskError(f"{where}: observation '{name}' is unknown. {did_you_mean(name, OBSERVATIONS)} One of another "
                        f"package is known once that is installed.")
    return OBSERVATIONS[name]
