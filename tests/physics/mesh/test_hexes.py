"""Cells cut into tetrahedra: every ranking fills the cell."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from vsfsim.core.hexes import split_hexes, split_prisms
from vsfsim.core.solid import boundary_faces, tet_volumes

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
