"""Factors by fronts: against dense matrices, and as part of eq. 15 of SBML."""

import numpy as np
import pytest
import torch
from scipy import sparse

from vsfsim.vsf.estimate import map as estimate_map
from vsfsim.vsf.estimate import touch_blocks
from vsfsim.vsf.estimate.evidence import Evidence
from vsfsim.vsf.estimate.fronts import Fronts
from vsfsim.vsf.estimate.map import map_estimate

torch.set_num_threads(1)


def touches(particles=300, count=60, frames=12, wide=25, seed=0):
    """Rows (m, n) of touches that each move some particles near each other, and the touch of each row."""
    rng = np.random.default_rng(seed)
    w = np.zeros((count * frames, particles))
    for touch in range(count):
        first = int(rng.integers(0, particles - wide))
        w[touch * frames:(touch + 1) * frames, first:first + wide] = rng.uniform(0, 0.02, (frames, wide))
    return sparse.csr_matrix(w), np.arange(count * frames) // frames


def matrices():
    rng = np.random.default_rng(3)
    few = sparse.random(80, 80, density=0.02, random_state=4, format="csr")
    chain = sparse.diags_array([np.full(49, 0.3), np.full(50, 1.0), np.full(49, 0.3)], offsets=(-1, 0, 1))
    dense = rng.normal(size=(30, 30))
    return {"touches": touches()[0].T @ touches()[0], "several pieces": few @ few.T, "a chain": chain,
            "full": sparse.csr_matrix(dense @ dense.T), "nothing": sparse.csr_matrix((5, 5)),
            "one": sparse.csr_matrix([[2.0]])}


@pytest.mark.parametrize("name", matrices())
def test_fronts_are_the_dense_factor(name):
    matrix = sparse.csr_matrix(matrices()[name])
    rng = np.random.default_rng(5)
    scale = rng.uniform(0.0, 30.0, matrix.shape[0])
    dense = np.eye(len(scale)) + scale[:, None] * matrix.toarray() * scale
    order = Fronts.of(matrix)
    values = np.asarray(matrix[order.row, order.column]).ravel() * scale[order.row] * scale[order.column]
    found, right = order.factor(values), rng.normal(size=(len(scale), 2))
    assert sorted(np.concatenate([front.own for front in order.fronts])) == list(range(len(scale)))
    assert found.log_det == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12, abs=1e-12)
    np.testing.assert_allclose(found.solve(right), np.linalg.solve(dense, right), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.inverse_diagonal(), np.diag(np.linalg.inv(dense)), rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("shared", [0, 2])
@pytest.mark.parametrize("noise, digits", [(0.1, 1e-9), (1e-3, 1e-6)])  # U^T C^-1 U is what the noise leaves of U^T U
def test_likelihood_and_gradient_by_particles_are_those_of_dense_matrices(monkeypatch, device, shared, noise, digits):
    w, touch = touches()
    rng = np.random.default_rng(6)
    n = w.shape[1]
    group = sparse.csr_matrix((np.ones(n), (np.arange(n), np.arange(n) % max(shared, 1))), shape=(n, max(shared, 1)))
    z = w @ rng.uniform(0, 100, n) + noise * rng.normal(size=w.shape[0])
    var = rng.uniform(1, 1e4, n)
    var[::40] = 0.0  # where the quotient (1 - P^-1_jj) / d_j says nothing
    given = [rng.uniform(0, 100, n), var, rng.uniform(0, 50, shared), rng.uniform(1, 1e3, shared)]

    def made(on="cpu"):
        one = Evidence.of(w, z, noise_std=noise, membership=group if shared else None, touch=touch, device=on)
        prior = [torch.tensor(x, requires_grad=True, device=on) for x in given]
        value = one.nll(prior[0][one.touched], prior[1][one.touched], *(prior[2:] if shared else ()))
        value.backward()
        return ({b.fronts is not None for b in one.blocks}, value.item(),
                [p.grad.cpu() for p in prior[:4 if shared else 2]])

    kinds = [made()]
    monkeypatch.setattr(touch_blocks, "_FILLED", 0.0)
    kinds.append(made())
    assert [one[0] for one in kinds] == [{True}, {False}], "by fronts, then by a dense matrix"
    if device != "cpu":
        kinds.append(made(device))
    spread = (w.multiply(given[1]) @ w.T).toarray() + noise**2 * np.eye(len(z))
    error = z - w @ given[0]
    if shared:
        wg = (w @ group).toarray()
        spread, error = spread + (wg * given[3]) @ wg.T, error - wg @ given[2]
    inverse = np.linalg.inv(spread)
    weight = inverse @ error
    columns = [w.toarray(), (w @ group).toarray()] if shared else [w.toarray()]
    wanted = [part for a in columns for part in (
        -a.T @ weight, 0.5 * (np.einsum("ij,ij->j", a, inverse @ a) - (a.T @ weight) ** 2))]
    for _, value, gradient in kinds:
        assert value == pytest.approx(0.5 * (error @ weight + np.linalg.slogdet(2.0 * np.pi * spread)[1]), rel=digits)
        assert value == pytest.approx(kinds[0][1], rel=1e-10)
        for ours, theirs in zip(gradient, wanted, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=100 * digits, atol=digits * np.abs(theirs).max())


def test_springs_are_fitted_by_the_sparse_factor_where_a_dense_one_would_be_too_large(monkeypatch):
    w, _ = touches()
    rng = np.random.default_rng(7)
    z = w @ np.maximum(rng.normal(30, 60, w.shape[1]), 0.0) + 0.1 * rng.normal(size=w.shape[0])
    given = {"noise_std": 0.1, "prior_mean": 5.0, "prior_var": 1e4}
    dense = map_estimate(w, z, **given)
    assert 0 < dense.active < len(dense.mean), "some springs are held at 0, others are not"
    monkeypatch.setattr(estimate_map, "_DENSE_LIMIT", 10)
    monkeypatch.setattr(estimate_map, "projected_cg", lambda *_, **__: pytest.fail("not needed"))
    found = map_estimate(w, z, **given)
    np.testing.assert_allclose(found.mean, dense.mean, rtol=1e-8, atol=1e-9 * dense.mean.max())
    assert found.active == dense.active and found.kkt_residual < 1e-10
