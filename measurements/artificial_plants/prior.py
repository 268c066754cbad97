"""How much of an object's stiffness a picture tells: priors learned from readings, with and without each feature
(`vsfsim measure plant-prior`, for plants and, as well, for shoes).

The spring constant of a particle is taken as constant within cells of the feature's quantiles. Its values are the
non-negative least squares solution of the readings of all objects but one (ridge towards one value for all), and
predict the readings of that one before its first touch. This is SBML's prior mean (eq. 15) without a network, so that
nothing but the feature decides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.optimize import nnls

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.baselines.particle_model import ParticleModel, VsfSettings
from vsfsim.bench.protocol import record
from vsfsim.bench.task import load_task, open_dataset
from vsfsim.vsf.features.registry import particle_features

COLUMN = {"luminance": 0, "hue": 1, "texture": 3, "thickness": 6, "path": 7, "axis": 8, "height": 9}
"""Columns of `local-thick` that are tried."""
SETS: tuple[tuple[str, ...], ...] = (
    (), ("luminance", "hue"), ("thickness",), ("path",), ("axis",), ("height",), ("thickness", "path"),
    ("axis", "height"), ("thickness", "axis", "height"), ("hue", "thickness", "axis"), ("texture",), ("hue", "texture"),
    ("luminance", "hue", "texture"), ("texture", "thickness"), ("hue", "texture", "height"))
"""Sets of features; the empty one is one value for all particles."""
CELLS = {0: 1, 1: 5, 2: 4, 3: 3}
"""Cells of each feature, by the number of features."""
PLANTS = VsfSettings(0.01, 0.4, 1.0, 0.01, 0.0, "cpu", noise_share=0.5, band=0.015)
"""Particles of a plant that an arm touches, as in the preset `tuned` for joint torques."""
SHOES = VsfSettings(0.005, 0.0, 1.0, 0.01, 0.0, "cpu", noise_share=0.5)
"""Particles of a shoe that a probe touches."""
RIDGE = 0.3
"""Weight of one value for all, relative to the mean curvature of the readings [-]."""


@dataclass
class _Plant:
    """What is kept of a plant."""

    features: dict[str, np.ndarray]
    """Of its particles (n,)."""
    rows: list[sparse.csr_matrix]
    """W of each touch (r, n), frames with a reading."""
    noisy: list[np.ndarray]
    """Readings (r,) [N m]."""
    clean: list[np.ndarray]
    """Without noise (r,) [N m]."""


def measure(task: str, *, folder: Path | None = None, settings: VsfSettings | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """Error before the first touch of priors from every set of `SETS`, each object predicted from all others.

    Args:
        task: name or path of a task whose readings particles predict.
        folder: its dataset, None for where the task looks. For the choice of settings give one of another seed: a copy
            of the task with that seed.
        settings: of the particles; None for noise in proportion 0.5 and, with joint torques, 10 mm within 15 mm of the
            seen surface, else 5 mm.
        progress: called with what is going on.
    """
    loaded = load_task(task)
    chosen = settings or (PLANTS if loaded.observation.name == "joint-torque" else SHOES)
    dataset = open_dataset(loaded, folder)
    plants = []
    for name in dataset.names():
        progress(name)
        view = dataset[name]
        model = ParticleModel.behind(view.view, chosen)
        values = particle_features("local-thick", view.view, model.particles, spacing=chosen.spacing)
        kept = _Plant({key: values[:, column].astype(float) for key, column in COLUMN.items()}, [], [], [])
        recording = record(view, loaded)
        for reading, clean in zip(recording.readings, recording.clean, strict=True):
            if reading.valid.any():
                at = np.flatnonzero(np.repeat(reading.valid, reading.action.size))
                kept.rows.append(model.observe(reading.action)[at])
                kept.noisy.append(reading.value[reading.valid].ravel())
                kept.clean.append(clean[reading.valid].ravel())
        plants.append(kept)
    return compared(plants, chosen, {"task": task, "sha256": dataset.sha256})


def compared(plants: Sequence[_Plant], settings: VsfSettings, run: dict[str, str]) -> Measurement:
    """The table of all sets of features."""
    rows, one = [], np.zeros(0)
    for keys in SETS:
        ratio = np.array([_left_out(plants, k, keys, settings) for k in range(len(plants))])
        one = ratio if not keys else one
        error = ratio.std(ddof=1) / np.sqrt(len(ratio))
        gain = ratio - one
        rows.append({"set": ", ".join(keys) or "one value for all", "ratio": float(ratio.mean()), "error": float(error),
                     "gain": float(gain.mean()), "gain_error": float(gain.std(ddof=1) / np.sqrt(len(gain))),
                     "better": int((gain < 0.0).sum())})
    return Measurement.of("plant-prior", run, [Table(
        "error before the first touch over that of predicting zero, each object from the others", (
            Column("set", "features"), Column("ratio", "ratio", "1", "", ".3f"), Column("error", "+-", "1", "", ".3f"),
            Column("gain", "against one value", "1", "", "+.3f"), Column("gain_error", "+-", "1", "", ".3f"),
            Column("better", f"better on, of {len(plants)}", "1", "", "d")), rows, name="features")],
        notes=["Errors are standard errors over objects; those of the difference are of paired differences."])


def _left_out(plants: Sequence[_Plant], k: int, keys: tuple[str, ...], settings: VsfSettings) -> float:
    """Ratio to zero on plant ``k`` of the prior learned from the others: mean over touches of the RMS error."""
    others = [plant for j, plant in enumerate(plants) if j != k]
    edges = [np.quantile(np.concatenate([p.features[key] for p in others]),
                         np.linspace(0.0, 1.0, CELLS[len(keys)] + 1)[1:-1]) for key in keys]
    curvature: np.ndarray | float = 0.0
    slope: np.ndarray | float = 0.0
    for plant in others:
        cells = _cells(plant, keys, edges)
        for rows, values in zip(plant.rows, plant.noisy, strict=True):
            share = settings.noise_share * np.abs(values).max() / settings.noise_std
            seen = (rows @ cells).toarray() / np.hypot(1.0, share)
            curvature = curvature + seen.T @ seen / len(plant.rows)
            slope = slope + seen.T @ values / np.hypot(1.0, share) / len(plant.rows)
    assert isinstance(curvature, np.ndarray) and isinstance(slope, np.ndarray)
    ones = np.ones(len(slope))
    common = max(float(ones @ slope) / float(ones @ curvature @ ones), 0.0)
    weight = RIDGE * np.trace(curvature) / len(slope)
    root = np.linalg.cholesky(curvature + weight * np.eye(len(slope)))
    levels = nnls(root.T, np.linalg.solve(root, slope + weight * common * ones))[0]
    stiffness = _cells(plants[k], keys, edges) @ levels
    pairs = list(zip(plants[k].rows, plants[k].clean, strict=True))
    error = np.mean([np.sqrt(np.mean((rows @ stiffness - values) ** 2)) for rows, values in pairs])
    return float(error / np.mean([np.sqrt(np.mean(values**2)) for _, values in pairs]))


def _cells(plant: _Plant, keys: tuple[str, ...], edges: Sequence[np.ndarray]) -> sparse.csr_matrix:
    """Which cell each particle is in (n, cells), one 1 a row."""
    count = len(next(iter(plant.features.values())))
    number = np.zeros(count, int)
    for key, edge in zip(keys, edges, strict=True):
        number = number * (len(edge) + 1) + np.searchsorted(edge, plant.features[key])
    width = int(np.prod([len(edge) + 1 for edge in edges])) if edges else 1
    return sparse.csr_matrix((np.ones(count), (np.arange(count), number)), shape=(count, width))
