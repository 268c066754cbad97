"""What holds for the numbers of any frames; where paths begin; blocks of any ticks and supports."""

import dataclasses

import numpy as np
import pytest

from vsfsim.core.hexes import split_hexes
from vsfsim.physics.linear.rest_factor import RestFactor
from vsfsim.physics.mesh.structured import grid_hexes
from vsfsim.physics.solve.frames import OF_AN_EQUILIBRIUM, Frames


def numbers_stand_for_equilibria(frames):
    """Every number is finite, but for results of frames that did not converge, which are NaN and kept apart."""
    for f in dataclasses.fields(Frames):
        values = np.asarray(getattr(frames, f.name), float)
        if f.name in OF_AN_EQUILIBRIUM:
            assert np.isnan(values[~frames.converged]).all(), f"{f.name} of a frame that failed"
            values = values[frames.converged]
        if f.name.endswith(("_error", "corner_det_f", "rotation")) and np.isnan(values).all():
            continue  # not known of this kind of body
        assert np.isfinite(values).all(), f.name
    assert (frames.unbalanced_force[frames.converged] == 0.0).all()


def ticked(ticks):
    """Vertices (n, 3) [m] and tetrahedra (m, 4) of a block whose grid lines along x, y and z are ``ticks`` [m]."""
    shape = tuple(len(t) for t in ticks)
    vertices = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices))
    return vertices, split_hexes(grid_hexes(number.reshape(shape)),
                                 np.indices(shape).sum(axis=0).reshape(-1) % 2 * len(number) + number)[0]


def from_above(poses):
    """Where paths begin (B, K, 4, 4) that come straight down to the first of ``poses`` (T, B, K, 4, 4) or, for one
    body, (T, B, 4, 4)."""
    start = poses[0].copy()
    start[..., 2, 3] += 0.06
    return start


def rollers(model, held):
    """The body of a model held in single directions, which no scene can name: mask (n, 3)."""
    free = np.where(held, 0.0, 1.0).ravel()
    factor, soft = (old and RestFactor(old.stiffness, free=free, points=model.mesh.points)
                    for old in (model.factor, model.soft_factor))
    return dataclasses.replace(model, free=free, factor=factor, soft_factor=soft)


def some_slow(values, *slow):
    """``values`` for `pytest.mark.parametrize`, of which ``slow`` are marked so."""
    return [pytest.param(value, marks=[pytest.mark.slow] * (value in slow)) for value in values]
