"""What the touches of a plants dataset are like, beside a real plant's: `vsfsim measure touches`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, Touch

FREE = 0.05
"""A contact force below this is none [N]."""
SHARES = (5, 10, 50, 90, 95)
"""Percentiles that are printed."""
REAL = {"norm": "11.0, 7.1, 5.1, 4.5 and 1.2 in five touches: 10 to 1", "rms_force": "6 to 20", "peak": "15 to 40",
        "stiffness": "100 to 200 in the median, 1.5 decades of spread"}
"""What docs/plants.md gives for a real artificial plant under a Gen3."""


def measure(folder: Path, *, progress: Progress = lambda _: None) -> Measurement:
    """Torques, forces and stiffness of the touches of a dataset, each plant and all together.

    Args:
        folder: of a dataset made with an arm.
        progress: called with the name of each view.

    Raises:
        VsfsimError: the dataset has no joint torques, or none of its touches met anything.
        DatasetError: it is damaged or unfinished.
    """
    dataset = Dataset.open(folder)
    rows, every = [], []
    for name in dataset.names():
        progress(name)
        view = dataset[name]
        found = [touch_figures(touch) for touch in view.touches]
        if any(row is None for row in found):
            raise VsfsimError(f"{folder}: object view '{name}' has no joint torques; give a dataset whose scene has an "
                              f"[arm].")
        met = [row for row in found if row is not None and row["peak"] > FREE]
        every += met
        if met:
            rows.append(_view_row(view, met))
    if not every:
        raise VsfsimError(f"{folder}: none of the touches met a plant.")
    whole = [{"quantity": text, **{f"p{share}": float(np.nanpercentile([row[key] for row in every], share))
                                   for share in SHARES}, "unit_": unit, "real": REAL[key]}
             for key, text, unit in (("norm", "norm of the seven torques, RMS of a touch", "N m"),
                                     ("rms_force", "contact force, RMS of a touch", "N"),
                                     ("peak", "contact force, largest of a touch", "N"),
                                     ("stiffness", "stiffness of a touch", "N/m"))]
    norms, stiff = (np.array([row[key] for row in every]) for key in ("norm", "stiffness"))
    spread = float(np.percentile(norms, 90) / np.percentile(norms, 10))
    decades = float(np.log10(np.nanpercentile(stiff, 95) / np.nanpercentile(stiff, 5)))
    return Measurement.of("touches", {"dataset": str(folder), "sha256": dataset.sha256}, [
        Table("all touches that met a plant", (Column("quantity", ""), Column("unit_", "in"),
                                               *(Column(f"p{share}", f"{share} %", "1", "", ".3g") for share in SHARES),
                                               Column("real", "a real plant")), whole, name="all"),
        Table("each plant, medians over its touches", (
            Column("name", "plant"), Column("touches", "touches", "1", "", "d"),
            Column("cut", "at the limit", "1", "", "d"),
            Column("norm", "torque norm", "N m", "", ".2f"), Column("rms_force", "RMS force", "N", "", ".2f"),
            Column("peak", "peak force", "N", "", ".1f"), Column("stiffness", "stiffness", "N/m", "", ".0f"),
            Column("unconverged", "marked", "1", "%", ".1f")), rows, name="plants")],
        notes=[f"Torque norms spread {spread:.1f} to 1 from the 10th to the 90th percentile, stiffness over "
               f"{decades:.2f} decades from the 5th to the 95th.",
               f"{sum(row['cut'] for row in rows)} of {len(every)} touches ended before the force limit."],
        numbers={"spread_10_90": spread, "decades_5_95": decades})


def touch_figures(touch: Touch) -> dict[str, float] | None:
    """Torque norm [N m], RMS and peak force [N] and stiffness [N/m] of a touch, over its frames in equilibrium; None
    without torques. The stiffness is the slope of the force's norm over the tool's travel from the first contact to the
    deepest frame, NaN with fewer than four frames between."""
    if touch.torque is None:
        return None
    good = np.asarray(touch.converged, bool)
    force = np.where(good, np.linalg.norm(touch.force, axis=1), 0.0)
    travel = (touch.mount_pose[:, :3, 3] - touch.mount_pose[0, :3, 3]) @ touch.axis
    pressed = np.flatnonzero(good & (force > FREE) & (np.arange(len(force)) <= int(np.argmax(travel))))
    slope = float(np.polyfit(travel[pressed], force[pressed], 1)[0]) if len(pressed) > 3 else float("nan")
    planned = len(touch.time) if touch.planned_time is None else len(touch.planned_time)
    return {"norm": float(np.sqrt((touch.torque[good] ** 2).sum(axis=1).mean())) if good.any() else 0.0,
            "rms_force": float(np.sqrt((force[good] ** 2).mean())) if good.any() else 0.0,
            "peak": float(force.max(initial=0.0)), "stiffness": max(slope, 1e-3) if slope == slope else slope,
            "cut": float(len(touch.time) < planned), "unconverged": float((~good).mean())}


def _view_row(view: ObjectView, met: list[dict[str, float]]) -> dict[str, Any]:
    notes = (view.truth.notes if view.truth is not None else None) or (view.name,)
    medians = {key: float(np.nanmedian([row[key] for row in met]))
               for key in ("norm", "rms_force", "peak", "stiffness")}
    return {"name": notes[0].split(":")[0], "touches": len(met), "cut": int(sum(row["cut"] for row in met)), **medians,
            "unconverged": float(np.mean([row["unconverged"] for row in met]))}
