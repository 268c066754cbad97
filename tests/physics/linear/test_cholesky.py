"""The sparse factor: its order is a true elimination, it is exact at any contrast, and refused where it must be."""

import itertools
from collections import OrderedDict

import numpy as np
import pytest
import scipy.sparse as sp

from vsfsim.core.errors import MeshError
from vsfsim.physics.linear import dissection, rest_factor
from vsfsim.physics.linear.cholesky import Cholesky, Order, blocks_of
from vsfsim.physics.linear.rest_factor import RestFactor


@pytest.fixture(scope="module", params=[1e4, 1e12])
def model(block, request):
    """A block whose one half has a hundred-millionth of the modulus of the other at most."""
    return block((0.08, 0.06, 0.04), 0.01, young_modulus=lambda x: np.where(x[..., 0] > 0.0, 1e4, request.param),
                 poisson_ratio=0.45)


def _graph(points, reach):
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < reach
    return sp.csr_matrix(near.astype(float))


def test_fronts_are_the_elimination_of_the_graph():
    """Against elimination node by node on a dense matrix of marks: what a node is tied to when its turn comes is in its
    front."""
    points = np.random.default_rng(1).random((160, 3))
    points[120:] += [5.0, 0.0, 0.0]  # a part that nothing ties to the rest
    graph = _graph(points, 0.3)
    tree = dissection.fronts(graph, points)
    order = np.concatenate([front.own for front in tree])
    assert np.array_equal(np.sort(order), np.arange(160))
    assert all(c < f for f, front in enumerate(tree) for c in front.children)
    marks = graph.toarray()[np.ix_(order, order)] > 0
    rank = np.argsort(order)
    for i in range(160):
        later = i + 1 + np.flatnonzero(marks[i, i + 1:])
        marks[np.ix_(later, later)] = True
    for front in tree:
        inside = set(rank[front.own]) | set(rank[front.boundary])
        for i in rank[front.own]:
            assert {i + 1 + int(j) for j in np.flatnonzero(marks[i, i + 1:])} <= inside
        if len(front.own):
            assert not len(front.boundary) or rank[front.boundary].min() > rank[front.own].max()
    # dense fronts hold more than what the elimination fills in, but not twice as much
    held = sum(len(f.own) * (0.5 * (len(f.own) + 1) + len(f.boundary)) for f in tree)
    assert held < 2.0 * np.triu(marks).sum()


def test_a_cover_is_the_least_one():
    rng = np.random.default_rng(2)
    for _ in range(30):
        left = np.arange(10) < 5
        ties = np.triu(rng.random((10, 10)) < 0.25, 1)
        part = sp.coo_matrix(ties | ties.T)
        cover = dissection.vertex_cover(part, left)
        edges = [(i, j) for i, j in zip(part.row, part.col, strict=True) if left[i] and not left[j]]
        assert all(cover[i] or cover[j] for i, j in edges)
        least = next(size for size in range(11) for chosen in itertools.combinations(range(10), size)
                     if all(i in chosen or j in chosen for i, j in edges))
        assert cover.sum() == least


@pytest.mark.parametrize("columns", [1, 5, 37])
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


def test_the_dense_inverse_is_that_of_the_factor_and_given_back_with_the_next_body(model, monkeypatch):
    # on a GPU it serves all touches; torch makes it on a CPU in the same way
    monkeypatch.setattr(rest_factor, "_factors", OrderedDict())
    factor = RestFactor.of(model.factor.stiffness, model.free, model.mesh.points)
    loads = np.random.default_rng(4).normal(size=(factor.size, 3)) * model.free[:, None]
    exact = factor.solve_on("cpu", loads)
    inverse = factor.dense("cpu")
    assert inverse is factor.dense("cpu")
    assert factor.solve_on("cpu", loads) == pytest.approx(exact, rel=0, abs=1e-9 * abs(exact).max())
    RestFactor.of(2.0 * model.factor.stiffness, model.free, model.mesh.points)
    assert not factor._dense
