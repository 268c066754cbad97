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
    return w, z, noise, g, [torch.tensor(x, requires_grad=True) for x in prior]


@pytest.mark.parametrize("m, n, s, frames", [(12, 20, 3, 4), (30, 8, 2, 4), (30, 8, 0, 4), (1, 1, 0, 1),
                                             (90, 8, 2, 30), (90, 8, 0, 30)])
def test_value_and_gradient_are_those_of_the_joint_gaussian(m, n, s, frames, device):
    """Also of touches with more readings than particles, which are summed by particles."""
    w, z, noise, g, prior = case(m, n, s)
    # Brute force: (phi, z) is jointly Gaussian; take the marginal of z out of its full covariance.
    a = torch.tensor(np.concatenate([w, w @ g.toarray()], axis=1))
    mean, var = torch.cat([prior[0], prior[2]]), torch.cat([prior[1], prior[3]])
    joint = torch.cat([torch.cat([torch.diag(var), (var * a).T], dim=1),
                       torch.cat([var * a, (var * a) @ a.T + torch.diag(torch.tensor(noise**2))], dim=1)])
    marginal = torch.distributions.MultivariateNormal(a @ mean, joint[len(var):, len(var):])
    expected = -marginal.log_prob(torch.tensor(z))
    slopes = torch.autograd.grad(expected, prior, allow_unused=True)
    for on in {"cpu", device}:
        evidence = Evidence.of(sparse.csr_matrix(w), z, noise_std=noise, membership=g, touch=np.arange(m) // frames,
                               device=on)
        assert frames <= n or {type(block) for block in evidence.blocks} == {ByParticles}
        there = [part.to(on) for part in prior]
        value = evidence.nll(there[0][evidence.touched], there[1][evidence.touched], *there[2:])
        assert value.item() == pytest.approx(expected.item(), rel=1e-10)
        for ours, theirs in zip(torch.autograd.grad(value, prior, allow_unused=True), slopes):
            if theirs is not None and theirs.numel():
                torch.testing.assert_close(ours, theirs, rtol=1e-8, atol=1e-9 * float(theirs.abs().max()))


def test_no_contact_is_a_constant():
    evidence = Evidence.of(sparse.csr_matrix((5, 3)), np.ones(5), noise_std=2.0)
    value = evidence.nll(torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    assert value.item() == pytest.approx(-stats.norm.logpdf(np.ones(5), 0, 2.0).sum())
