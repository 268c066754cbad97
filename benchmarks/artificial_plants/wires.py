"""How often the wires of artificial plants would yield, where the simulator bends them elastically:
`vsfsim measure plant-yield`.

Touches of a scene are made with the states of all nodes kept. A stem or branch with a wire of diameter d yields where
its bending moment passes the plastic moment 1.7 s_y pi d^3 / 32. The moment is the elastic one, so the excess is how
far the elastic beam goes past what the wire could carry. Petioles and leaves are left out: where one of them stands for
several, its section is not that of a wire.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plant import Plant
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.prepare import prepare_job
from vsfsim.generate.plants.touches import solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.physics.rods.model import RodModel

YIELD_STRESS = 3.0e8
"""Of soft steel wire [Pa]."""
PLATEAU = 1.7
"""Plastic moment of a round section over the moment at first yield [-]."""


def measure(*, scene: str = "plants-v3-mini", objects: int | None = None, touches: int = 6, seed: int = 0,
            progress: Progress = lambda _: None) -> Measurement:
    """Share of the touches whose wires pass the plastic moment, and by how much.

    Args:
        scene: name or path of a scene of the family `artificial_plant`.
        objects: plants, None for the scene's own number.
        touches: of each plant.
        seed: of the dataset.
        progress: called with the name of each plant.

    Raises:
        VsfsimError: no stem or branch of any plant has a wire.
    """
    loaded = load_scene(find_scene(scene))
    recipe = make_recipe(loaded, seed=seed, objects=objects, views=1, touches=touches)
    rows = []
    for job in jobs_of(recipe, loaded.path, Path("."), None):
        subject = prepare_job(job, device="cpu")
        progress(subject.plant.name or job.name)
        limit = plastic_moment(subject.plant)
        if not np.isfinite(limit).any():
            continue  # a trunk of wood that bears leaves alone
        (frames,) = solve([subject], device="cpu", keep_nodes=True)
        assert frames.turns is not None
        most, first = np.zeros(len(subject.aims)), np.full(len(subject.aims), np.nan)
        for b in range(len(subject.aims)):
            good = np.flatnonzero(frames.converged[:int(frames.frames[b]), b])
            over = np.array([(bending_moment(subject.model, frames.turns[t, b]) / limit).max() for t in good])
            most[b] = over.max(initial=0.0)
            passed = np.flatnonzero(over > 1.0)
            if len(passed):
                first[b] = np.linalg.norm(frames.force[good[passed[0]], b].sum(axis=0))
        rows.append({"name": subject.plant.name, "touches": len(most), "past": float((most > 1.0).mean()),
                     "median": float(np.median(most)), "most": float(most.max()),
                     "force": float(np.nanmedian(first)) if np.isfinite(first).any() else float("nan")})
    if not rows:
        raise VsfsimError(f"measure plant-yield: no stem or branch of {loaded.name} has a wire; give a scene of the "
                          f"family artificial_plant.")
    past = float(np.mean([row["past"] for row in rows]))
    return Measurement.of("plant-yield", {"scene": loaded.name, "seed": seed, "touches": touches}, [Table(
        "stems and branches: elastic moment over the plastic moment of the wire, largest of a touch", (
            Column("name", "plant"), Column("touches", "touches", "1", "", "d"),
            Column("past", "touches past it", "1", "%", ".0f"), Column("median", "median", "1", "", ".2f"),
            Column("most", "largest", "1", "", ".1f"), Column("force", "force where passed", "N", "", ".1f")),
        rows, name="plants")], notes=[f"{100 * past:.0f} % of the touches bend a wire past its plastic moment."],
        numbers={"share_past": past})


def plastic_moment(plant: Plant) -> np.ndarray:
    """Of each segment (n,) [N m]; infinite where a segment is no stem or branch with a wire."""
    if plant.wire is None:
        return np.full(len(plant.nodes), np.inf)
    return np.where(plant.wire > 0.0, PLATEAU * YIELD_STRESS * np.pi * plant.wire**3 / 32.0, np.inf)


def bending_moment(model: RodModel, turns: np.ndarray) -> np.ndarray:
    """Of each segment (n,) [N m], from the rotations of the nodes since rest, quaternions x y z w (n, 4)."""
    turned = Rotation.from_quat(turns)
    parent = np.maximum(model.plant.parent, 0)
    local = np.einsum("nij,ni->nj", model.frame, (turned[parent].inv() * turned).as_rotvec())
    out = np.linalg.norm(model.kphi[:, 1:] * local[:, 1:], axis=1)
    out[0] = 0.0
    return out
