"""The inverse along a band: against the dense inverse, on readings coupled like those of a mesh, in any order and for
any part of them."""

import numpy as np
import pytest
from scipy import sparse

from vsfsim.vsf.estimate.banded import Band


@pytest.mark.parametrize("side, kept", [(9, 1.0), (9, 0.6), (2, 1.0)])
def test_the_band_holds_the_inverse_and_the_solution(side, kept):
    rng = np.random.default_rng(side)
    size = side * side
    place = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2)[rng.permutation(size)]
    near = np.abs(place[:, None] - place[None]).sum(axis=2) <= 1
    matrix = np.where(near, rng.uniform(-1, 1, (size, size)), 0.0)
    matrix = matrix + matrix.T + 10.0 * np.eye(size)
    band = Band(size)
    read = np.flatnonzero(rng.uniform(size=size) < kept)
    part = sparse.csr_matrix(matrix[np.ix_(read, read)])
    assert not band.holds(read, part)
    band.learn(read, part)
    assert band.holds(read, part) and (side == 2 or band.width < 0.4 * size)
    order = read[np.argsort(band.position[read])]
    dense, right = matrix[np.ix_(order, order)], rng.normal(size=len(order))
    z, solution = band.solve(dense.copy(), right)
    np.testing.assert_allclose(solution, np.linalg.solve(dense, right), rtol=1e-10, atol=1e-12)
    i, j = np.nonzero(np.abs(band.position[order][:, None] - band.position[order][None]) <= band.width)
    np.testing.assert_allclose(z[i, j], np.linalg.inv(dense)[i, j], rtol=1e-9, atol=1e-12)


def test_a_matrix_that_is_not_positive_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError, match="noise_std is too small"):
        Band(2).solve(np.array([[1.0, 0.0], [0.0, -1.0]]), np.ones(2))
