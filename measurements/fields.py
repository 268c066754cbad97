"""The point VSF, the neural VSF and its fast variant on one buried rope: F1 of its mask, time, size on disk
(`vsfsim measure methods --fields`).

The case has the size of Neural VSF section IV-D: 66 touches, 1,010 frames, 217 vertices, 20,000 points. The rope lies
in a soft half-space; forces are those of the continuous VSF itself with 5 mN of noise a component (see `palpation`). F1
is that of its table I: seen from above at pixels of 3 mm, a pixel is stiff where the rope lies under it within the
pressed depth; a method's pixel is the largest stiffness in its column, cut at the threshold that is best for the
method.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
from scipy import sparse
from scipy.spatial import cKDTree

from measurements.cost import most_memory, start_memory, wait
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.palpation import layer_with_inclusion, palpate
from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.kalman import DiagonalFilter
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.fields.neural import Fitting, density, fit, save_field
from vsfsim.vsf.fields.surface_touch import DenseTouch
from vsfsim.vsf.observe import dense_force_rows
from vsfsim.vsf.sticking import stick

FRAMES = ((46, 15), (20, 16))
"""(touches, frames of each): 66 touches, 1,010 frames."""

BOUNDS = np.array([[-0.08, -0.06, -0.016], [0.08, 0.06, 0.001]])
_EXTENT, _DEPTH, _NOISE = (0.11, 0.07), 0.012, 0.005
_PIXEL = 0.003
# Noise of the point model [N], some times the sensor's, because it cannot place forces finer than its particles; and
# the prior's standard deviation over its mean, the soft ground.
_MODEL_NOISE, _WIDTH = 0.02, 20.0


@dataclass(frozen=True)
class FieldRow:
    """One method on the case."""

    name: str
    """Of the method."""
    f1: float
    """F1 of the mask [-]."""
    seconds: float
    """Time of the fit; for points without `stick` [s]."""
    simulated: float
    """Time with `stick` [s]."""
    kilobytes: float
    """Size on disk [kB]."""
    mib: float
    """Memory on the device, or of the process beyond what it held before [MiB]."""
    settings: str
    """In words."""


def check_device(device: str) -> None:
    """Refuse a torch device that is not there.

    Raises:
        VsfError: torch cannot use it.
    """
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        raise VsfError(f"--device is '{device}', which torch cannot use here ({str(error).splitlines()[0]}); choose "
                       f"cpu, or a machine with such a device.") from error


def neural_fitting(device: str, iterations: int | None, rate: float) -> Fitting:
    """Settings of the neural VSF: the paper's and 2,000 iterations, or on a CPU 400 iterations of a tenth of the work
    each."""
    if torch.device(device).type != "cpu":
        return Fitting(iterations=iterations or 2000, rate=rate)
    return Fitting(iterations=iterations or 400, rate=rate, batch=300, samples=32)


def case(*, scale: float = 1.0, fresh: bool = False) -> tuple[list[DenseTouch], Callable[[np.ndarray], np.ndarray]]:
    """Touches of the case and its true stiffness density [N/m^4].

    ``scale`` < 1 takes that share of the touches. The settings of our field were chosen on the first rope; ``fresh`` is
    another one, under other touches.
    """
    field = layer_with_inclusion(radius=0.006, top=-0.003, path=(lambda x: 0.015 * np.cos(60.0 * x) - 0.25 * x)
                                 if fresh else None)
    out: list[DenseTouch] = []
    for seed, (touches, frames) in enumerate(FRAMES, start=100 if fresh else 0):
        out += palpate(field, touches=max(1, round(scale * touches)), frames=frames, extent=_EXTENT, depth=_DEPTH,
                       noise=_NOISE, seed=seed)
    return out, field


def compare(*, device: str = "cpu", iterations: int | None = None, rate: float = Fitting.rate,
            octaves: int = 6, points: Sequence[int] = (1000, 20_000), scale: float = 1.0, fresh: bool = False,
            grid_iterations: int = 250, progress: Progress = lambda _: None) -> list[FieldRow]:
    """Fit every method to the case.

    Args:
        device: of torch, for the fields.
        iterations, rate: of the neural VSF, see `neural_fitting`.
        octaves: of its encoding.
        points: of the point VSFs.
        scale: of the case, 1 for the paper's.
        fresh: a rope that no setting was chosen on.
        grid_iterations: of our field.
        progress: called with what is going on.
    """
    touches, field = case(scale=scale, fresh=fresh)
    neural = neural_fitting(device, iterations, rate)
    pixels = _Pixels.of(touches, field)
    rows: list[FieldRow] = []
    for count in points:
        rows += _points(count, touches, pixels, progress)
    for name, kind, settings, more in (("neural VSF", "nerf", neural, {"octaves": octaves}),
                                       ("grid VSF (ours)", "grid",
                                        Fitting(iterations=grid_iterations, samples=24, rate=0.1), {"cell": 0.004})):
        progress(f"{name}, {settings.iterations} iterations on {device}")
        _warm(kind, touches, device)
        before = start_memory(device)
        start = time.perf_counter()
        model = fit(kind, touches, BOUNDS, settings, device=device, **more)
        wait(device)
        seconds = time.perf_counter() - start
        with tempfile.TemporaryDirectory() as folder:
            save_field(model, Path(folder) / "field.npz")
            size = (Path(folder) / "field.npz").stat().st_size / 1e3
        rows.append(FieldRow(name, pixels.f1(density(model, pixels.points)), seconds, seconds, size,
                             most_memory(device) - before,
                             f"{settings.iterations} iterations, N = {settings.samples}, B = {settings.batch}, rate "
                             f"{settings.rate:g}"))
    return rows


def _points(count: int, touches: Sequence[DenseTouch], pixels: _Pixels, progress: Progress) -> list[FieldRow]:
    """The point VSF with about ``count`` points, batch and online."""
    spacing = float((np.prod(BOUNDS[1] - BOUNDS[0]) / count) ** (1 / 3))
    axes = [np.arange(low + 0.5 * spacing, high, spacing) for low, high in BOUNDS.T]
    place = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    place = place[place[:, 2] < 0.0]
    progress(f"point VSF, {len(place)} points")
    start, before = time.perf_counter(), start_memory("cpu")
    w = sparse.vstack([dense_force_rows(stick(place, t.vertices, t.triangles), len(place), t.triangles,
                                        t.vertices.shape[1]) for t in touches]).tocsr()
    simulated = time.perf_counter() - start
    z, soft, rows = np.concatenate([t.force.ravel() for t in touches]), 2e8 * spacing**3, []
    estimators = {
        "batch": lambda: map_estimate(w, z, noise_std=_MODEL_NOISE, prior_mean=soft,
                                      prior_var=(_WIDTH * soft) ** 2).mean,
        "filter": lambda: _filtered(w, z, _MODEL_NOISE, soft, _WIDTH * soft, touches[0].vertices.shape[1] * 3)}
    for name, work in estimators.items():
        start = time.perf_counter()
        stiffness = work()
        seconds = time.perf_counter() - start
        rows.append(FieldRow(f"point VSF, {name}", pixels.f1_of_points(place, stiffness), seconds, seconds + simulated,
                             _npz_size(place, stiffness),
                             most_memory("cpu") - before, f"{len(place)} points"))
    return rows


def table(rows: Sequence[FieldRow], name: str, title: str) -> Table:
    """The rows, under the key ``name`` of the JSON."""
    return Table(title, (
        Column("name", "method"), Column("f1", "F1", "1", form=".3f"), Column("seconds", "fit", "s", form=".2f"),
        Column("simulated", "with motion", "s", form=".2f"), Column("kilobytes", "on disk", "kB", form=".0f"),
        Column("mib", "memory", "MiB", form=".0f"), Column("settings", "settings")), [asdict(row) for row in rows],
        name=name)


def measure(*, device: str = "cpu", iterations: int | None = None, rate: float = Fitting.rate, octaves: int = 6,
            progress: Progress = lambda _: None) -> Measurement:
    """Every method on two ropes: the one that the settings of our field were chosen on, and a fresh one."""
    given = {"device": device, "iterations": iterations, "rate": rate, "octaves": octaves}
    found = [table(compare(**given, fresh=fresh, progress=progress), name, title)
             for fresh, name, title in ((False, "fields", "a rope under a soft layer"),
                                        (True, "fields_fresh", "another rope, that no setting was chosen on"))]
    return Measurement.of("methods --fields", given, found)


@dataclass(frozen=True)
class _Pixels:
    """Query points of the mask."""

    points: np.ndarray
    """Points that some vertex passed (q, 3) [m]."""
    pixel: np.ndarray
    """Pixel of each (q,)."""
    stiff: np.ndarray
    """Whether the rope lies under a pixel (p,) bool."""

    @classmethod
    def of(cls, touches: Sequence[DenseTouch], field: Callable[[np.ndarray], np.ndarray]) -> _Pixels:
        axes = [np.arange(low + 0.5 * _PIXEL, high, _PIXEL) for low, high in BOUNDS[:, :2].T]
        plane = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        depth = -np.arange(0.0005, _DEPTH, 0.001)
        columns = np.concatenate([np.repeat(plane[:, None], len(depth), axis=1),
                                  np.broadcast_to(depth[:, None], (len(plane), len(depth), 1))], axis=2)
        points = columns.reshape(-1, 3)
        swept = np.concatenate([t.vertices.reshape(-1, 3) for t in touches])
        swept = swept[swept[:, 2] < 0.0]
        near = np.zeros(len(points), bool)
        near[cKDTree(swept).query(points, distance_upper_bound=0.002)[0] < 0.002] = True
        pixel, index = np.unique(np.repeat(np.arange(len(plane)), len(depth))[near], return_inverse=True)
        stiff = (field(points).reshape(columns.shape[:2]) > 1e9).any(axis=1)[pixel]
        return cls(points[near], index, stiff)

    def f1(self, stiffness: np.ndarray) -> float:
        """Of stiffnesses at the query points (q,)."""
        value = np.full(len(self.stiff), -np.inf)
        np.maximum.at(value, self.pixel, stiffness)
        order = np.argsort(-value, kind="stable")
        hit = np.cumsum(self.stiff[order])
        last = np.append(np.diff(value[order]) != 0.0, True)
        return float(np.max((2.0 * hit / (np.arange(1, len(hit) + 1) + self.stiff.sum()))[last]))

    def f1_of_points(self, place: np.ndarray, stiffness: np.ndarray) -> float:
        """Of a point VSF: a query point has the stiffness of the nearest particle."""
        return self.f1(stiffness[cKDTree(place).query(self.points)[1]])


def _filtered(w: sparse.csr_matrix, z: np.ndarray, noise: float, mean: float, std: float, size: int) -> np.ndarray:
    state = DiagonalFilter.start(w.shape[1], mean=mean, var=std**2)
    state.run(w, z, noise_std=noise, size=size)
    return state.mean


def _npz_size(place: np.ndarray, stiffness: np.ndarray) -> float:
    """Of points and stiffnesses as openvsf keeps them, in kB."""
    with tempfile.TemporaryFile() as file:
        np.savez(file, points=place, K=stiffness)
        return file.tell() / 1e3


def _warm(kind: str, touches: Sequence[DenseTouch], device: str) -> None:
    """Load a device's kernels, which is not a method's time."""
    if device != "cpu":
        fit(kind, touches, BOUNDS, Fitting(iterations=3), device=device)
        wait(device)
