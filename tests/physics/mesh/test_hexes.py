"""Cells cut into tetrahedra: every ranking fills the cell, and neighbours fit."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from vsfsim.core.hexes import split_hexes, split_prisms
from vsfsim.core.solid import boundary_faces, tet_volumes
from vsfsim.physics.mesh.structured import grid_hexes

CUBE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], float)


def test_every_cube_is_filled() -> None:
    rng = np.random.default_rng(0)
    counts = set()
    for _ in range(300):
        tets, _ = split_hexes(np.arange(8)[None], rng.permutation(8))
        volume = tet_volumes(CUBE, tets)
        # Corners of a unit cube span 1/6 or 1/3.
        assert volume.min() > 0.16 and volume.sum() == pytest.approx(1.0, rel=1e-12)
        assert len(boundary_faces(tets)[0]) == 12
        counts.add(len(tets))
    assert counts == {5, 6}


def test_every_prism_is_filled() -> None:
    prism = CUBE[[0, 1, 2, 4, 5, 6]]
    for rank in itertools.permutations(range(6)):
        tets, _ = split_prisms(np.arange(6)[None], np.array(rank))
        assert tet_volumes(prism, tets) == pytest.approx(np.full(3, 1.0 / 6.0))
        assert len(boundary_faces(tets)[0]) == 8


def test_neighbours_fit_and_owners_are_right() -> None:
    shape = (4, 3, 3)
    index = np.arange(np.prod(shape)).reshape(shape)
    points = np.argwhere(index >= 0).astype(float)
    hexes = grid_hexes(index)
    tets, owner = split_hexes(hexes, np.random.default_rng(1).permutation(index.size))
    # A face that does not fit its neighbour would show up as boundary inside the block: 2 (6 + 6 + 4) squares outside.
    faces, _ = boundary_faces(tets)
    assert len(faces) == 2 * 2 * (6 + 6 + 4)
    assert np.bincount(owner, weights=tet_volumes(points, tets)) == pytest.approx(np.ones(len(hexes)))
    assert all(set(tet) <= set(hexes[o]) for tet, o in zip(tets.tolist(), owner.tolist()))
