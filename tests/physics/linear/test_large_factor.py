"""The factor of large bodies: exact at any contrast, the same on any number of threads, refused where it must be."""

from collections import OrderedDict

import numpy as np
import pytest
import torch

from vsfsim.core.errors import MeshError
from vsfsim.physics.linear import rest_factor
from vsfsim.physics.linear.elimination import blocks_of
from vsfsim.physics.linear.large_factor import LargeFactor
from vsfsim.physics.linear.rest_factor import RestFactor


@pytest.fixture(scope="module", params=[1e4, 1e12])
def model(block, request):
    """A block whose one half has a hundred-millionth of the modulus of the other at most."""
    return block((0.08, 0.06, 0.04), 0.01, young_modulus=lambda x: np.where(x[..., 0] > 0.0, 1e4, request.param),
                 poisson_ratio=0.45)


def _factor(model, **more):
    return RestFactor(model.factor.stiffness, model.free, model.mesh.surface_nodes(), points=model.mesh.points, **more)


def test_it_is_an_inverse(model):
    factor = _factor(model, later=True)
    matrix = factor._held.tocsr()
    large = LargeFactor(factor.order(model.mesh.points), blocks_of(matrix).data.astype(float))
    loads = np.random.default_rng(0).normal(size=(factor.size, 5)) * model.free[:, None]
    out = np.empty_like(loads)
    large.solve(loads, out)
    # the error of a backward stable solve, in every row's own units
    scale = abs(matrix) @ abs(out)
    assert np.abs(matrix @ out - loads).max(axis=1) == pytest.approx(0.0, abs=1e-12 * scale.max())
    assert (np.abs(matrix @ out - loads) <= 1e-12 * scale + 1e-300).all()


def test_large_bodies_have_it_and_small_ones_keep_their_bits(model, monkeypatch):
    loads = np.random.default_rng(1).normal(size=(len(model.free), 70)) * model.free[:, None]
    small = _factor(model)
    assert not isinstance(small._solver, LargeFactor)
    monkeypatch.setattr(rest_factor, "_LARGE", len(model.free))
    factor = _factor(model)
    assert isinstance(factor._solver, LargeFactor) and factor.seconds > 0.0
    exact = small.solve(loads)
    assert np.abs(factor.solve(loads) - exact).max() < 1e-8 * np.abs(exact).max()
    nodes = model.mesh.surface_nodes()[:4]
    difference = factor.compliance(nodes, nodes[3:]) - small.compliance(nodes, nodes[3:])
    assert np.abs(difference).max() < 1e-8 * np.abs(factor.compliance(nodes, nodes[3:])).max()


def test_its_bits_do_not_depend_on_threads(model):
    order, values = (lambda f: (f.order(model.mesh.points), blocks_of(f._held).data.astype(float)))(
        _factor(model, later=True))
    load = np.random.default_rng(2).normal(size=(len(model.free), 8)) * model.free[:, None]
    answers, before = [np.empty_like(load) for _ in range(2)], torch.get_num_threads()
    try:
        for threads, out in zip((1, 2), answers, strict=True):
            torch.set_num_threads(threads)
            LargeFactor(order, values).solve(load, out)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(*answers)


def test_a_loose_part_is_refused(model):
    factor = _factor(model, later=True)
    values = blocks_of(factor._held).data.astype(float)
    with pytest.raises(MeshError, match="not positive definite: a part of it can move freely"):
        LargeFactor(factor.order(model.mesh.points), -values)


def test_the_dense_inverse_is_that_of_the_factor_and_given_back_with_the_next_body(model, monkeypatch):
    # on a GPU it serves all touches; torch makes it on a CPU in the same way
    monkeypatch.setattr(rest_factor, "_factors", OrderedDict())
    nodes = model.mesh.surface_nodes()
    factor = RestFactor.of(model.factor.stiffness, model.free, nodes)
    loads = np.random.default_rng(4).normal(size=(factor.size, 3)) * model.free[:, None]
    exact = factor.solve_on("cpu", loads)
    inverse = factor.dense("cpu")
    assert inverse is factor.dense("cpu")
    assert factor.solve_on("cpu", loads) == pytest.approx(exact, rel=0, abs=1e-9 * abs(exact).max())
    RestFactor.of(2.0 * model.factor.stiffness, model.free, nodes)
    assert not factor._dense
