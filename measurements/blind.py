"""Blind localisation by every estimator, with contact forces on a sensor's skin as the papers had them:
`vsfsim measure methods --blind`.

A stiff object of known shape lies 3 mm under the surface of a soft half-space; a dome presses it from above at random
places (`palpate`). Every estimator of Neural VSF section IV-C is asked for the object's pose as in section III-E:
points stiffer than a threshold, RANSAC and closest points, the loss of eq. 7, the best of 40 (`localise`). The contact
points are registered without a stiffness, and the pressure-only baseline gets the size of the whole force instead of
the vertices' forces. One rule for all: the threshold is four times the cover's density, which is known, as in the
paper. The random search that `localise` adds is shown beside the papers' procedure.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse

from measurements.fields import neural_fitting
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.palpation import palpate
from vsfsim.core.errors import VsfError
from vsfsim.core.rotation import pose_errors
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.fields.neural import Fitting, density, fit
from vsfsim.vsf.fields.surface_touch import DenseTouch
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.pose.localise import KnownObject, contact_pose, stiffness_pose
from vsfsim.vsf.sticking import Contacts, stick

SOFT, STIFF, COVER = 1e8, 3e9, 0.003
"""Densities of the block and the object [N/m^4], and the depth of the object's highest point [m]."""

_TOUCHES, _FRAMES, _RINGS, _EXTENT, _DEPTH = 60, 15, 6, 0.16, 0.012
_NOISE, _TOTAL_NOISE = 0.003, 0.036  # of a force component on a vertex, and of the size of the whole force [N]
_SPACING = 0.004
_BOUNDS = np.array([[-0.1, -0.1, -0.014], [0.1, 0.1, 0.001]])
_THRESHOLD = 4.0 * SOFT
_SHARE = 0.1  # share of the points that count as stiff where fewer pass the threshold than a pose needs
_CONTACT = 0.3  # share of the largest force that makes a vertex a contact


@dataclass(frozen=True)
class BlindRow:
    """One method, over k objects."""

    name: str
    """Of the method."""
    shift: np.ndarray
    """Position error of the papers' procedure (k,) [m]."""
    turn: np.ndarray
    """Its orientation error (k,) [rad]."""
    refined: np.ndarray
    """Both with the random search (k, 2) [m, rad]; NaN where there is none."""
    seconds: float
    """Time of the estimates, all objects together [s]."""


@dataclass(frozen=True)
class Buried:
    """One object and the touches of it."""

    known: KnownObject
    """Its shape."""
    pose: np.ndarray
    """Object to world (4, 4) [m]."""
    touches: list[DenseTouch]
    """Of the dome."""

    @classmethod
    def of(cls, index: int, *, scale: float = 1.0) -> Buried:
        """Object ``index`` of `OUTLINES`, turned and shifted at random; ``scale`` < 1 takes that share of the
        touches."""
        rng = np.random.default_rng(np.random.SeedSequence(index, spawn_key=(7,)))
        vertices, triangles = prism(*OUTLINES[index % len(OUTLINES)])
        angle, shift = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.01, 0.01, 2)
        c, s = np.cos(angle), np.sin(angle)
        truth = np.eye(4)
        truth[:2, :2], truth[:2, 3], truth[2, 3] = [[c, -s], [s, c]], shift, -COVER - vertices[:, 2].max()
        known = KnownObject.of(vertices, triangles)

        def field(points: np.ndarray) -> np.ndarray:
            inside = known.contains((points - truth[:3, 3]) @ truth[:3, :3])
            return np.where(points[:, 2] > 0.0, 0.0, np.where(inside, STIFF, SOFT))

        touches = palpate(field, touches=max(2, round(scale * _TOUCHES)), frames=_FRAMES, extent=(_EXTENT, _EXTENT),
                          depth=_DEPTH, noise=_NOISE, rings=_RINGS, seed=100 + index)
        return cls(known, truth, touches)


OUTLINES: tuple[tuple[tuple[tuple[float, float], ...], tuple[tuple[int, int, int], ...], tuple[float, float]], ...] = (
    (((0.0, 0.0), (0.10, 0.0), (0.10, 0.025), (0.035, 0.025), (0.035, 0.06), (0.0, 0.06)),
     ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)), (0.03, 0.02)),
    (((0.0, 0.0), (0.03, 0.0), (0.03, 0.03), (0.09, 0.03), (0.09, 0.055), (0.0, 0.055)),
     ((0, 1, 2), (2, 3, 4), (2, 4, 5), (0, 2, 5)), (0.022, 0.03)),
    (((0.0, 0.0), (0.11, 0.01), (0.075, 0.05), (0.02, 0.045)), ((0, 1, 2), (0, 2, 3)), (0.03, 0.024)))
"""Outlines (k, 2) [m], their triangles, and heights at their left and right ends [m]; none of them is symmetric."""
_FIRST = len(OUTLINES)  # the number of tries was chosen on the objects before this one


def prism(outline: Sequence[tuple[float, float]], caps: Sequence[tuple[int, int, int]],
          height: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A prism on ``outline`` (n, 2) [m], anticlockwise and triangulated by ``caps``, its height going from one end in x
    to the other: vertices (2 n, 3) [m], centred, and triangles (m, 3) wound outwards."""
    flat = np.asarray(outline, float)
    n, part = len(flat), flat[:, 0] / flat[:, 0].max()
    top = height[0] + part * (height[1] - height[0])
    vertices = np.concatenate([np.c_[flat, np.zeros(n)], np.c_[flat, top]])
    sides = [t for i in range(n) for j in [(i + 1) % n] for t in ((i, j, n + j), (i, n + j, n + i))]
    return vertices - vertices.mean(axis=0), np.array([(a, c, b) for a, b,
                                                       c in caps] + [(n + a, n + b, n + c) for a, b, c in caps] + sides)


def compare(*, device: str = "cpu", objects: int = 2 * len(OUTLINES), scale: float = 1.0, iterations: int | None = None,
            rate: float = Fitting.rate, progress: Progress = lambda _: None) -> list[BlindRow]:
    """Find every object by every method.

    Args:
        device: of torch, for the fields.
        objects: number of them.
        scale: of the touches, 1 for 60.
        iterations, rate: of the neural VSF, see `neural_fitting`.
        progress: called with what is going on.
    """
    neural = neural_fitting(device, iterations, rate)
    found: dict[str, list[tuple[float, ...]]] = {}
    for index in range(objects):
        buried = Buried.of(_FIRST + index, scale=scale)
        points, estimates = _estimates(buried, neural, device)
        for name, work in estimates.items():
            progress(f"object {index + 1} of {objects}, {name}")
            start = time.perf_counter()
            stiffness = work()
            seconds = time.perf_counter() - start
            if stiffness is None:
                pose = contact_pose(buried.known, _contacts(buried.touches))
                found.setdefault(name, []).append((*pose_errors(pose.transform, buried.pose), np.nan, np.nan, seconds))
                continue
            threshold = (_THRESHOLD if np.count_nonzero(stiffness > _THRESHOLD) >= 10
                         else float(np.quantile(stiffness, 1.0 - _SHARE)))
            errors = []
            for refine in (0, 400):
                try:
                    errors += pose_errors(stiffness_pose(buried.known, points, stiffness, threshold=threshold,
                                                         refine=refine).transform, buried.pose)
                except VsfError:  # fewer than ten points are stiff: the guess is the middle of what was touched
                    guess = np.eye(4)
                    guess[:3, 3] = points.mean(axis=0)
                    errors += pose_errors(guess, buried.pose)
            found.setdefault(name, []).append((*errors, seconds))
    return [BlindRow(name, *(np.array(rows)[:, k] for k in (0, 1)), np.array(rows)[:, 2:4],
                     float(np.array(rows)[:, 4].sum())) for name, rows in found.items()]


def _estimates(buried: Buried, neural: Fitting, device: str) -> tuple[np.ndarray,
                                                                      dict[str, Callable[[], np.ndarray | None]]]:
    """Touched points (n, 3) [m], and by method what gives the stiffness density there (n,) [N/m^4], or None for the
    contact points."""
    axes = [np.arange(low, high, step) for (low, high), step in zip(_BOUNDS.T, (_SPACING, _SPACING, 0.5 * _SPACING))]
    place = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    place = place[place[:, 2] < 0.0]
    contacts = [stick(place, t.vertices, t.triangles) for t in buried.touches]
    touched = np.unique(np.concatenate([c.particle for c in contacts]))
    points, volume = place[touched], 0.5 * _SPACING**3

    def particles(rows: Callable[[Contacts, DenseTouch], sparse.csr_matrix], z: np.ndarray, noise: float) -> np.ndarray:
        w = sparse.vstack([rows(c, t) for c, t in zip(contacts, buried.touches)]).tocsr()
        return map_estimate(w, z, noise_std=noise, prior_mean=SOFT * volume,
                            prior_var=(STIFF * volume) ** 2).mean[touched] / volume

    total = np.concatenate([np.linalg.norm(t.force.sum(axis=1), axis=1) for t in buried.touches])
    every = np.concatenate([t.force.ravel() for t in buried.touches])
    grid = Fitting(iterations=250, samples=24, rate=0.1)
    return points, {
        "contact points": lambda: None,
        "point VSF, pressure only": lambda: particles(lambda c, t: force_sum_rows(c.displacements(), len(place)), total,
                                                      _TOTAL_NOISE),
        "point VSF": lambda: particles(lambda c, t: dense_force_rows(c, len(place), t.triangles, t.vertices.shape[1]),
                                       every, _NOISE),
        "neural VSF": lambda: density(fit("nerf", buried.touches, _BOUNDS, neural, device=device), points),
        "grid VSF (ours)": lambda: density(fit("grid", buried.touches, _BOUNDS, grid, device=device, cell=_SPACING),
                                           points)}


def _contacts(touches: Sequence[DenseTouch]) -> np.ndarray:
    """Vertices (k, 3) [m] that ended with a force above one limit for all touches."""
    force = [np.linalg.norm(t.force[-1], axis=1) for t in touches]
    limit = _CONTACT * max(float(f.max()) for f in force)
    return np.concatenate([t.vertices[-1][f > limit] for t, f in zip(touches, force)])


def report(settings: dict[str, Any], rows: Sequence[BlindRow]) -> Measurement:
    """Means over the objects."""
    means = [{"name": row.name, "shift": float(row.shift.mean()), "turn": float(row.turn.mean()),
              "refined_shift": float(row.refined[:, 0].mean()), "refined_turn": float(row.refined[:, 1].mean()),
              "seconds": row.seconds} for row in rows]
    return Measurement.of("methods --blind", settings, [
        Table(f"pose errors of a known buried object, mean over {len(rows[0].shift)} objects", (
            Column("name", "method"), Column("shift", "papers' procedure", "m", "mm", ".1f"),
            Column("turn", "", "rad", "deg", ".0f"), Column("refined_shift", "with random search", "m", "mm", ".1f"),
            Column("refined_turn", "", "rad", "deg", ".0f"), Column("seconds", "time", "s", form=".1f")), means,
            name="methods")])


def measure(*, device: str = "cpu", iterations: int | None = None, rate: float = Fitting.rate,
            progress: Progress = lambda _: None) -> Measurement:
    """`compare` as a measurement."""
    return report({"device": device, "iterations": iterations, "rate": rate},
                  compare(device=device, iterations=iterations, rate=rate, progress=progress))
