"""The sixteen-bit factor: its order is a true elimination, its answers those of the matrix, and it knows where it is no
good."""

import itertools

import numpy as np
import pytest
import scipy.sparse as sp

from vsfsim.core.errors import MeshError
from vsfsim.physics.linear import dissection
from vsfsim.physics.linear.multifrontal import Multifrontal, trusted
from vsfsim.physics.linear.rest_factor import QuickFactor, RestFactor


@pytest.fixture(scope="module")
def model(block):
    return block((0.08, 0.06, 0.04), 0.01, young_modulus=lambda x: np.where(x[..., 0] > 0.0, 1e4, 1e8),
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


@pytest.mark.parametrize("columns", [1, 3, 4, 37])
def test_answers_are_those_of_the_matrix(model, columns):
    """A contrast of 1e4 in stiffness: the soft half's answers are as good as the stiff half's."""
    quick = model.factor.quick(model.mesh.points)
    assert quick is not model.factor
    right = np.random.default_rng(0).standard_normal((len(model.free), columns)) * model.free[:, None]
    right[:, -1] *= 1e-9  # each column has its own measure
    exact, answer = model.factor.solve(right), quick.solve(right)
    soft = np.repeat(model.mesh.points[:, 0] > 0.005, 3)
    for part in (soft, ~soft):
        size = np.abs(exact[part]).max(axis=0)
        assert (np.abs(answer - exact)[part].max(axis=0) < 5e-3 * size).all()
    assert not answer[model.free == 0.0].any()


def test_a_column_is_answered_alike_alone_and_among_others(model):
    quick = model.factor.quick(model.mesh.points)
    right = np.random.default_rng(0).standard_normal((len(model.free), 20)) * model.free[:, None]
    together = quick.solve(right)
    quick.solve(right[:, :5])  # leaves other values where the padding is
    again = quick.solve(right)
    assert np.array_equal(together, again)
    assert np.abs(quick.solve(right[:, 3:4])[:, 0] - together[:, 3]).max() < 1e-5 * np.abs(together[:, 3]).max()


def _chain(count, *, stiff_in_bending=False):
    """Nodes in a row along x, held at one end: tied by unit springs, or like the sections of a clamped beam by what
    their deflections' second differences cost."""
    last = [1.0] if not stiff_in_bending else [2.0]
    line = sp.diags([np.full(count - 1, -1.0), np.concatenate([np.full(count - 1, 2.0), last]),
                     np.full(count - 1, -1.0)], [-1, 0, 1]).tocsr()
    if stiff_in_bending:
        line = line[:-1].T @ line[:-1] + sp.csr_matrix(([1.0], ([0], [0])), shape=line.shape)
    return sp.kron(line, np.eye(3)).tocsr(), np.column_stack([np.arange(count), np.zeros((count, 2))])


@pytest.mark.parametrize(("count", "good"), [(12, True), (3000, False)])
def test_a_long_way_from_the_support_is_not_trusted_to_sixteen_bits(count, good):
    """The softest mode of a beam of n sections is n^4 softer than the stiffest: sixteen bits are four digits and a
    half."""
    matrix, points = _chain(count, stiff_in_bending=True)
    load = np.ones((3 * count, 1))
    assert trusted(matrix, Multifrontal.of(matrix, points).solve, load) is good


def test_a_body_that_few_digits_lose_has_no_quick_factor(model):
    assert QuickFactor.of_trusted(model.factor, model.mesh.points, within=1e-12) is None
    assert QuickFactor.of_trusted(model.factor, model.mesh.points) is not None


def test_where_there_is_no_quick_factor_the_exact_one_is_made_when_it_is_asked_for(model, monkeypatch):
    """Not at the first solve, which may be in the time of a frame."""
    factor = RestFactor(model.factor.stiffness, model.free, model.mesh.surface_nodes(), later=True)
    monkeypatch.setattr(QuickFactor, "of_trusted", lambda *_: None)
    assert "_solver" not in vars(factor)
    assert factor.quick(model.mesh.points) is factor and "_solver" in vars(factor)


def test_a_loose_part_is_refused():
    matrix, points = _chain(60)
    loose = matrix.tolil()
    loose[0, 0] = 1.0  # x is no longer held
    with pytest.raises(MeshError, match="not positive definite: a part of it can move freely"):
        Multifrontal.of(loose.tocsr(), points)
