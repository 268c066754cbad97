"""Blind localisation by every estimator, with contact forces on a sensor's skin as the papers had them:
`vsfsim measure methods --blind`.

A stiff object of known shape lies 3 mm under the surface of a soft half-space; a dome presses it from above at random
places (`palpate`). Every estimator of Neural VSF section IV-C is asked where it lies, by the way of section III-E:
points stiffer than a threshold, RANSAC and closest points, the loss of eq. 7, the best of 40 (`localise`). The contact
points are registered without a stiffness, and the pressure-only baseline gets the size of the whole force instead of
the vertices' forces.
One rule for all: the threshold is four times the cover's density, which is known, as in the paper. The random search
that `localise` adds is shown beside the papers' way.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from vsfsim.core.errors import VsfError
from vsfsim.core.rotation import pose_errors
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.fields.neural import Fitting, density, fit
from vsfsim.vsf.fields.palpation import DenseTouch, palpate
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.pose.localise import KnownObject, contact_pose, stiffness_pose
from vsfsim.vsf.sticking import Contacts, stick

SOFT, STIFF, COVER = 1e8, 3e9, 0.003
"""Densities of the block and the object [N/m^4], and the depth of the object's highest point [m]."""

_TOUCHES, _FRAMES, _RINGS, _EXTENT, _DEPTH = 60, 15, 6, 0.16, 0.012
# Of a force component on a vertex, and of the size of the whole force [N].
_NOISE, _TOTAL_NOISE = 0.003, 0.036
_SPACING = 0.004
_BOUNDS = np.array([[-0.1, -0.1, -0.014], [0.1, 0.1, 0.001]])
_THRESHOLD = 4.0 * SOFT
# Where fewer points pass the threshold than a pose needs, this share of them counts as stiff.
_SHARE = 0.1
_TRIES = 40
# A contact: a vertex that carries this share of the largest force of all.
_CONTACT = 0.3
_ON_CPU = {"iterations": 400, "batch": 300, "samples": 32}


@dataclass(frozen=True)
class BlindRow:
    """One method, over some objects. shift, turn: errors of the pose by the papers' way, one an object (k,) [m] [rad];
    refined: the same two with the random search (k, 2), NaN where there is none. seconds: of the estimate, over all
    objects [s]."""

    name: str
    shift: np.ndarray
    turn: np.ndarray
    refined: np.ndarray
    seconds: float


@dataclass(frozen=True)
class Buried:
    """One object. known: its shape. pose: object to world (4, 4) [m]. touches: of the dome."""

    known: KnownObject
    pose: np.ndarray
    touches: list[DenseTouch]

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


# Outlines (k, 2) [m], their triangles, and heights at their left and right ends [m]: no symmetry in any of them.
OUTLINES: tuple[tuple[tuple[tuple[float, float], ...], tuple[tuple[int, int, int], ...], tuple[float, float]], ...] = (
    (((0.0, 0.0), (0.10, 0.0), (0.10, 0.025), (0.035, 0.025), (0.035, 0.06), (0.0, 0.06)),
     ((0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)), (0.03, 0.02)),
    (((0.0, 0.0), (0.03, 0.0), (0.03, 0.03), (0.09, 0.03), (0.09, 0.055), (0.0, 0.055)),
     ((0, 1, 2), (2, 3, 4), (2, 4, 5), (0, 2, 5)), (0.022, 0.03)),
    (((0.0, 0.0), (0.11, 0.01), (0.075, 0.05), (0.02, 0.045)), ((0, 1, 2), (0, 2, 3)), (0.03, 0.024)))
# Objects before this one were looked at while the number of tries was chosen.
_FIRST = len(OUTLINES)


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
            rate: float = Fitting.rate,
            progress: Callable[[str], None] | None = None) -> list[BlindRow]:
    """Find every object by every method.

    Args:
        device: torch's, of the fields. objects: how many. scale: of the touches, 1 for 60. iterations: of the neural
        VSF; None: 2,000, or 400 on a CPU, with smaller batches. rate: of its training, the paper's. progress: called
        with what is going on.
    """
    tell = progress or (lambda _: None)
    if torch.device(device).type != "cpu":
        neural = Fitting(iterations=iterations or 2000, rate=rate)
    else:
        neural = Fitting(**{**_ON_CPU, "iterations": iterations or _ON_CPU["iterations"], "rate": rate})
    found: dict[str, list[tuple[float, ...]]] = {}
    for index in range(objects):
        buried = Buried.of(_FIRST + index, scale=scale)
        points, estimates = _estimates(buried, neural, device)
        for name, work in estimates.items():
            tell(f"object {index + 1} of {objects}, {name}")
            start = time.perf_counter()
            stiffness = work()
            seconds = time.perf_counter() - start
            if stiffness is None:
                pose = contact_pose(buried.known, _contacts(buried.touches), tries=_TRIES)
                found.setdefault(name, []).append((*pose_errors(pose.transform, buried.pose), np.nan, np.nan, seconds))
                continue
            threshold = (_THRESHOLD if np.count_nonzero(stiffness > _THRESHOLD) >= 10
                         else float(np.quantile(stiffness, 1.0 - _SHARE)))
            errors = []
            for refine in (0, 400):
                try:
                    errors += pose_errors(stiffness_pose(buried.known, points, stiffness, threshold=threshold,
                                                         tries=_TRIES, refine=refine).transform, buried.pose)
                except VsfError:  # no ten points stand out: nothing is known but the middle of what was touched
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


def table(rows: Sequence[BlindRow]) -> str:
    """For a terminal: means over the objects."""
    objects = len(rows[0].shift)
    title = f"where a known object lies, {objects} objects"
    width = max(len(title), *(len(row.name) for row in rows))
    lines = [f"{title:<{width}}  {'papers: mm':>10} {'degrees':>8}  {'refined: mm':>11} {'degrees':>8}  {'seconds':>8}"]
    for row in rows:
        fine = ("" if np.isnan(row.refined).any()
                else f"{1e3 * row.refined[:, 0].mean():11.1f} {np.degrees(row.refined[:, 1]).mean():8.0f}")
        lines.append(f"{row.name:<{width}}  {1e3 * row.shift.mean():10.1f} {np.degrees(row.turn).mean():8.0f}  "
                     f"{fine:>20}  {row.seconds:8.1f}")
    return "\n".join(lines)
