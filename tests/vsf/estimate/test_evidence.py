"""Eq. 15 of SBML: against the joint Gaussian written out in full."""

import numpy as np
import pytest
import torch
from scipy import sparse, stats

from vsfsim.vsf.estimate.evidence import ByParticles, Evidence

torch.set_num_threads(1)


def case(m, n, s, seed=0):
    rng = np.random.default_rng(seed)
    w = rng.uniform(-0.002, 0.02, (m, n)) * (rng.uniform(size=(m, n)) < 0.3)
    z, noise = rng.normal(0, 2, m), rng.uniform(0.1, 0.5, m)
    g = sparse.csr_matrix((np.ones(n), (np.arange(n), np.arange(n) % max(s, 1))),
                          shape=(n, s)) if s else sparse.csr_matrix((n, 0))
    prior = [rng.uniform(0, 100, n), rng.uniform(1, 1e4, n), rng.uniform(0, 50, s), rng.uniform(1, 1e3, s)]
    return w, z, noise, g, np.arange(m) // 4, [torch.tensor(x, requires_grad=True) for x in prior]


@pytest.mark.parametrize("m, n, s", [(12, 20, 3), (30, 8, 2), (30, 8, 0), (1, 1, 0)])
def test_value_and_gradient_are_those_of_the_joint_gaussian(m, n, s):
    w, z, noise, g, touch, prior = case(m, n, s)
    evidence = Evidence.of(sparse.csr_matrix(w), z, noise_std=noise, membership=g, touch=touch)
    part = torch.as_tensor(evidence.touched)
    value = evidence.nll(prior[0][part], prior[1][part], prior[2], prior[3])
    # Brute force: (phi, z) is jointly Gaussian; take the marginal of z out of its full covariance.
    a = torch.tensor(np.concatenate([w, w @ g.toarray()], axis=1))
    mean, var = torch.cat([prior[0], prior[2]]), torch.cat([prior[1], prior[3]])
    joint = torch.cat([torch.cat([torch.diag(var), (var * a).T], dim=1),
                       torch.cat([var * a, (var * a) @ a.T + torch.diag(torch.tensor(noise**2))], dim=1)])
    marginal = torch.distributions.MultivariateNormal(a @ mean, joint[len(var):, len(var):])
    expected = -marginal.log_prob(torch.tensor(z))
    assert value.item() == pytest.approx(expected.item(), rel=1e-11)
    for ours, theirs in zip(torch.autograd.grad(value, prior, allow_unused=True),
                            torch.autograd.grad(expected, prior, allow_unused=True)):
        if theirs is not None and theirs.numel():
            torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-10 * float(theirs.abs().max()))


def touches(particles=300, count=60, frames=12, wide=25, seed=0):
    """Rows (m, n) of touches that each move some particles near each other, and the touch of each row."""
    rng = np.random.default_rng(seed)
    w = np.zeros((count * frames, particles))
    for touch in range(count):
        first = int(rng.integers(0, particles - wide))
        w[touch * frames:(touch + 1) * frames, first:first + wide] = rng.uniform(0, 0.02, (frames, wide))
    return sparse.csr_matrix(w), np.arange(count * frames) // frames


@pytest.mark.parametrize("shared", [0, 2])
@pytest.mark.parametrize("noise, digits", [(0.1, 1e-9), (1e-3, 1e-6)])  # U^T C^-1 U is what the noise leaves of U^T U
def test_touches_with_more_readings_than_particles(device, shared, noise, digits):
    w, touch = touches()
    rng = np.random.default_rng(6)
    n = w.shape[1]
    group = sparse.csr_matrix((np.ones(n), (np.arange(n), np.arange(n) % max(shared, 1))), shape=(n, max(shared, 1)))
    z = w @ rng.uniform(0, 100, n) + noise * rng.normal(size=w.shape[0])
    given = [rng.uniform(0, 100, n), rng.uniform(1, 1e4, n), rng.uniform(0, 50, shared), rng.uniform(1, 1e3, shared)]
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
    for on in {"cpu", device}:
        one = Evidence.of(w, z, noise_std=noise, membership=group if shared else None, touch=touch, device=on)
        prior = [torch.tensor(x, requires_grad=True, device=on) for x in given]
        value = one.nll(prior[0][one.touched], prior[1][one.touched], *(prior[2:] if shared else ()))
        value.backward()
        assert {type(block) for block in one.blocks} == {ByParticles}
        assert value.item() == pytest.approx(0.5 * (error @ weight + np.linalg.slogdet(2.0 * np.pi * spread)[1]),
                                             rel=digits)
        for ours, theirs in zip(prior, wanted):
            np.testing.assert_allclose(ours.grad.cpu(), theirs, rtol=100 * digits, atol=digits * np.abs(theirs).max())


def test_no_contact_is_a_constant():
    evidence = Evidence.of(sparse.csr_matrix((5, 3)), np.ones(5), noise_std=2.0)
    value = evidence.nll(torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    assert value.item() == pytest.approx(-stats.norm.logpdf(np.ones(5), 0, 2.0).sum())
