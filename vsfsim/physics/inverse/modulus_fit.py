"""The moduli that explain touches: maximum a posteriori by Gauss and Newton's method through the solver.

With log E = B theta over the elements, theta of a Gaussian prior, and forces F(theta) of the solver read with errors of
deviation s, the fit minimises

    sum ((F(theta) - y) / s)^2 / 2 + (theta - m) . C^-1 (theta - m) / 2

by steps of the linearised problem (Nocedal and Wright 2006, section 10.3) whose derivatives are those of `sensitivity`.
Every run begins at the equilibria of the one before, and shares a factor, which only preconditions, with moduli nearby.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.shape import ProbeShape
from vsfsim.physics.contact.mount import Mount
from vsfsim.physics.inverse.sensitivity import Sensitivity
from vsfsim.physics.model import Model
from vsfsim.physics.solve.frames import SolverOptions

FRAMES = 5
"""Of each touch that a fit looks at."""
STEPS = 4
"""Steps of the fit, at most."""
_LONGEST = 1.2  # change of a coefficient in a step: of a modulus by 3.3 [-]
_STILL = 0.03  # change of log E under which the fit has ended [-]
_GAIN = 0.005  # share of what is minimised that a step must be expected to take off
_HALVINGS = 1  # of a step that explains the touches worse
_NEAR = 1.0  # change of log E up to which a factor is shared: further off its iterations cost more than another one
_CENTRES = 60  # places of a smooth field whose values decide those of all others
_TOGETHER = 16  # touches that are solved together


@dataclass(frozen=True)
class Press:
    """A touch by a rigid body, and what was read of it."""

    poses: np.ndarray
    """Of the mount (T, 4, 4) [m]."""
    axis: np.ndarray
    """Unit direction of the press (3,) [-]."""
    force: np.ndarray
    """Force against the press (T,) [N]; NaN where it was not read."""
    shape: ProbeShape
    """Of the body."""
    mount_stiffness: float | None
    """Of the spring that carries it [N/m]; None for a rigid mount."""

    def thinned(self, most: int) -> Press:
        """The same with ``most`` frames, evenly from the first to the last: neighbours tell little of one another."""
        if len(self.poses) <= most:
            return self
        kept = np.unique(np.round(np.linspace(0, len(self.poses) - 1, most)).astype(int))
        return dataclasses.replace(self, poses=self.poses[kept], force=self.force[kept])


@dataclass(frozen=True)
class Prior:
    """A Gaussian prior of the coefficients of log E."""

    basis: np.ndarray
    """B (m, c): what each coefficient adds to log E of each element [-]."""
    mean: np.ndarray
    """m (c,)."""
    covariance: np.ndarray
    """C (c, c)."""

    def modulus(self, theta: np.ndarray) -> np.ndarray:
        """Young's modulus at the Gauss points of every element (m, 4) [Pa] under the coefficients (c,)."""
        return np.repeat(np.exp(self.basis @ theta)[:, None], 4, axis=1)


@dataclass(frozen=True)
class Noise:
    """Deviation of a reading F [N]: the root of floor^2 + (share F)^2."""

    floor: float
    """[N]."""
    share: float
    """What the model itself is off by [-]."""


def press(model: Model, presses: Sequence[Press], options: SolverOptions, near: Sequence[Sensitivity] = (), *,
          derive: bool = False) -> tuple[list[np.ndarray], list[np.ndarray], list[Sensitivity]]:
    """Forces (T,) [N] of each press, NaN in frames without an equilibrium; their derivatives by the log modulus of
    every element (T, m) [N], where asked for; and the runs, ``near`` which others begin."""
    runs: list[Sensitivity] = []
    force: list[np.ndarray] = [np.zeros(0)] * len(presses)
    slopes: list[np.ndarray] = [np.zeros((0, 0))] * len(presses)
    for some in _alike(presses):
        one = presses[some[0]]
        axis, poses = np.stack([presses[k].axis for k in some]), np.stack([presses[k].poses for k in some], axis=1)
        run = Sensitivity(model, one.shape, axis, options=options, near=near[len(runs)] if near else None)
        mount = None if one.mount_stiffness is None else Mount(float(one.mount_stiffness), axis)
        frames = run.run(poses, mount=mount, keep=derive)
        for j, k in enumerate(some):
            force[k] = -(frames.force[:, j] @ presses[k].axis)
            if derive:
                slopes[k] = np.stack([each[j] for each in run.derivative])
        runs.append(run)
    return force, slopes, runs


def _alike(presses: Sequence[Press]) -> list[list[int]]:
    """Numbers of presses by one body on one spring in as many frames, `_TOGETHER` at most."""
    kinds: dict[tuple, list[int]] = {}
    for k, one in enumerate(presses):
        spring = None if one.mount_stiffness is None else float(one.mount_stiffness)
        kinds.setdefault((len(one.poses), one.shape, spring), []).append(k)
    return [mine[k:k + _TOGETHER] for mine in kinds.values() for k in range(0, len(mine), _TOGETHER)]


def fit_modulus(model_of: Callable[[np.ndarray], Model], prior: Prior, presses: Sequence[Press],
                options: SolverOptions, noise: Noise, *, steps: int = STEPS) -> tuple[np.ndarray, np.ndarray]:
    """The coefficients (c,) that explain the presses best, and their covariance (c, c) in the linearised problem.

    Args:
        model_of: the object with the Young's moduli (m, 4) [Pa].
        prior: of the coefficients. presses: the touches. options: of the solver. noise: of the readings.
        steps: at most.
    """
    presses = [one.thinned(FRAMES) for one in presses]
    theta, precision = prior.mean.copy(), np.linalg.inv(prior.covariance)
    if not presses:
        return theta, prior.covariance
    read = np.concatenate([one.force for one in presses])
    weight = np.where(np.isfinite(read), 1.0 / (noise.floor**2 + (noise.share * np.nan_to_num(read)) ** 2), 0.0)
    base: tuple[np.ndarray, Model] | None = None  # log E and model of the shared factor

    def look(at: np.ndarray, near: Sequence[Sensitivity]) -> tuple[float, np.ndarray, np.ndarray, list[Sensitivity]]:
        nonlocal base
        log_modulus = prior.basis @ at
        model = model_of(prior.modulus(at))
        if base is None or np.abs(log_modulus - base[0]).max() > _NEAR:
            base = log_modulus, model
        shared = dataclasses.replace(model, factor=base[1].factor, soft_factor=base[1].soft_factor)
        force, slopes, runs = press(shared, presses, options, near, derive=True)
        slope = np.concatenate(slopes) @ prior.basis
        off = read - np.concatenate(force)
        known = (weight > 0.0) & np.isfinite(off) & np.isfinite(slope).all(axis=1)
        # a frame without an equilibrium counts as not explained at all, so that no step gains by losing frames
        lost = weight[~known] @ np.nan_to_num(read[~known]) ** 2
        off, slope = np.where(known, off, 0.0), np.where(known[:, None], slope, 0.0)
        loss = weight @ off**2 + (at - prior.mean) @ precision @ (at - prior.mean) + lost
        hessian = (slope * weight[:, None]).T @ slope + precision
        downhill = slope.T @ (weight * off) - precision @ (at - prior.mean)
        return float(loss), hessian, downhill, runs

    loss, hessian, downhill, runs = look(theta, ())
    for _ in range(steps):
        step = np.linalg.solve(hessian, downhill)
        step *= min(1.0, _LONGEST / max(float(np.abs(prior.basis @ step).max()), 1e-12))
        if np.abs(prior.basis @ step).max() < _STILL or step @ downhill < _GAIN * loss:
            break
        for _ in range(_HALVINGS + 1):
            found = look(theta + step, runs)
            if found[0] < loss:
                break
            step *= 0.4
        else:
            break
        theta, (loss, hessian, downhill, runs) = theta + step, found
    return theta, np.linalg.inv(hessian)


def smooth_basis(places: np.ndarray, *, reach: float, std: float) -> np.ndarray:
    """Functions (n, c) whose sums with standard normal coefficients are a Gaussian process with the covariance
    std^2 exp(-r^2 / 2 reach^2), as the values at a few places far from one another tell it (Nystroem's method,
    Williams and Seeger 2001).

    Args:
        places: where its values are asked (n, 3) [m].
        reach: over which they are alike [m].
        std: deviation of each.
    """
    centres = [int(np.linalg.norm(places - places.mean(axis=0), axis=1).argmin())]
    away = np.linalg.norm(places - places[centres[0]], axis=1)
    while len(centres) < min(_CENTRES, len(places)) and away.max() > 0.5 * reach:
        centres.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(places - places[centres[-1]], axis=1))
    chosen = places[centres]

    def alike(a: np.ndarray) -> np.ndarray:
        square = ((a[:, None] - chosen[None]) ** 2).sum(axis=2)
        return std**2 * np.exp(-0.5 * square / reach**2)

    value, vector = np.linalg.eigh(alike(chosen))
    keep = value > 1e-6 * value[-1]
    return alike(places) @ (vector[:, keep] / np.sqrt(value[keep]))
