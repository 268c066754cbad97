"""The sparse factor: exact at any contrast, and refused where it must be."""


import numpy as np
import pytest
import scipy.sparse as sp

from vsfsim.core.errors import MeshError
from vsfsim.physics.linear.cholesky import Cholesky, Order, blocks_of


@pytest.fixture(scope="module", params=[1e4, 1e12])
def model(block, request):
    """A block whose one half has a hundred-millionth of the modulus of the other at most."""
    return block((0.08, 0.06, 0.04), 0.01, young_modulus=lambda x: np.where(x[..., 0] > 0.0, 1e4, request.param),
                 poisson_ratio=0.45)


@pytest.mark.parametrize("columns", [1, 37])
def test_it_is_an_inverse_of_one_column_and_of_many(model, columns):
    matrix = model.factor._held.tocsr()
    loads = np.random.default_rng(0).normal(size=(model.factor.size, columns)) * model.free[:, None]
    loads[:, -1] *= 1e-9  # each column has its own measure
    out = model.factor.solve(loads)
    # the error of a backward stable solve, in every row's own units
    scale = abs(matrix) @ abs(out)
    assert (np.abs(matrix @ out - loads) <= 1e-12 * scale + 1e-300).all()
    assert not out[model.free == 0.0].any()
    assert np.array_equal(out, model.factor.solve(loads))
    alone = model.factor.solve(loads[:, :1])[:, 0]
    assert np.abs(alone - out[:, 0]).max() < 1e-9 * np.abs(alone).max()


def _chain(count):
    """Nodes in a row along x, tied by unit springs and held at one end."""
    line = sp.diags([np.full(count - 1, -1.0), np.concatenate([np.full(count - 1, 2.0), [1.0]]),
                     np.full(count - 1, -1.0)], [-1, 0, 1]).tocsr()
    return sp.kron(line, np.eye(3)).tocsr(), np.column_stack([np.arange(count), np.zeros((count, 2))])


def test_a_loose_part_is_refused():
    matrix, points = _chain(60)
    loose = matrix.tolil()
    loose[0, 0] = 1.0  # x is no longer held
    blocks = blocks_of(loose.tocsr())
    with pytest.raises(MeshError, match="not positive definite: a part of it can move freely"):
        Cholesky(Order(blocks, points), np.asarray(blocks.data, float))
