"""Error and cost of the reference presses S1 and S2 at the tiers that show bulging: `vsfsim measure solver`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

import references
from measurements.gate.cells import GateCell, press
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.physics import tiers

CASES = {"S1": "indent-homogeneous", "S2": "indent"}
"""Scene of each reference (`references/s1.json`, `s2.json`)."""
TIERS = tuple(name for name, tier in tiers.TIERS.items() if tier.nonlinear)
"""Names that `--tier` takes."""


def measure(tier: Sequence[str] = TIERS, *, progress: Progress = lambda _: None) -> Measurement:
    """A press to 5 mm in ten frames of each case at each ``tier``, on a mesh and with a factor that exist."""
    press(GateCell("kernels", scene=CASES["S1"], tier="fem-coarse"))
    rows = []
    for case, scene in CASES.items():
        for name in tier:
            progress(f"{case} at {name}")
            run = press(GateCell(case, scene=scene, tier=name))
            force = float(np.linalg.norm(run.force[-1]))
            rows.append({"case": case, "tier": name, "force": force,
                         "error": force / references.load(case.lower())["force_N"][-1] - 1.0, "converged": run.frames,
                         "newton": run.newton / run.asked, "cg": run.cg / run.asked, "cpu": run.cpu / run.asked})
    return Measurement.of("solver", {"tier": list(tier)}, [Table(
        "The presses S1 and S2 to 5 mm, by frame, CPU time of the solver in one process", (
            Column("case", "case"), Column("tier", "tier"), Column("force", "force", "N", form=".3f"),
            Column("error", "error", "1", "%", "+.1f"), Column("converged", "converged", "1"),
            Column("newton", "Newton", "1", form=".1f"), Column("cg", "CG", "1", form=".1f"),
            Column("cpu", "CPU", "s", form=".3f")), rows, name="presses")])
