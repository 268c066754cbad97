"""Eq. 15 of SBML: against the joint Gaussian written out in full, against quadrature, and on the matrices it says it
needs."""

import numpy as np
import pytest
import torch
from scipy import integrate, sparse, stats

from vsfsim.core.errors import VsfError
from vsfsim.vsf.estimate.evidence import Evidence

torch.set_num_threads(1)


def case(m, n, s, seed=0):
    rng = np.random.default_rng(seed)
    w = rng.uniform(-0.002, 0.02, (m, n)) * (rng.uniform(size=(m, n)) < 0.3)
    z, noise = rng.normal(0, 2, m), rng.uniform(0.1, 0.5, m)
    g = sparse.csr_matrix((np.ones(n), (np.arange(n), np.arange(n) % max(s, 1))),
                          shape=(n, s)) if s else sparse.csr_matrix((n, 0))
    prior = [rng.uniform(0, 100, n), rng.uniform(1, 1e4, n), rng.uniform(0, 50, s), rng.uniform(1, 1e3, s)]
    return w, z, noise, g, np.arange(m) // 4, [torch.tensor(x, requires_grad=True) for x in prior]


@pytest.mark.parametrize("m, n, s", [(12, 20, 0), (12, 20, 3), (30, 8, 2), (30, 8, 0), (9, 40, 1), (1, 1, 0)])
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


def test_against_quadrature_over_two_springs():
    w, z, noise = np.array([[0.01, 0.02], [0.0, 0.015], [0.02, 0.0]]), np.array([1.2, 0.4, 0.9]), 0.3
    mean, std = np.array([30.0, 20.0]), np.array([15.0, 8.0])

    def density(k1, k0):
        k = np.array([k0, k1])
        return np.prod(stats.norm.pdf(z, w @ k, noise)) * np.prod(stats.norm.pdf(k, mean, std))

    mass = integrate.dblquad(density, *(mean[0] + 9 * std[0] * np.array([-1, 1])),
                             *(mean[1] + 9 * std[1] * np.array([-1, 1])), epsabs=1e-10)[0]
    evidence = Evidence.of(sparse.csr_matrix(w), z, noise_std=noise)
    assert evidence.nll(torch.tensor(mean), torch.tensor(std**2)).item() == pytest.approx(-np.log(mass), rel=1e-6)


def test_in_and_out_of_a_press_count_once_and_far_touches_apart():
    # Three touches of 40 frames, in and out; the first two share particles, the third is elsewhere.
    rng = np.random.default_rng(1)
    way = np.concatenate([np.arange(1, 21), np.arange(20, 0, -1)]) / 20
    rows = []
    for columns in (slice(0, 50), slice(30, 80), slice(100, 150)):
        row = np.zeros((40, 150))
        row[:, columns] = np.maximum(way[:, None] - rng.uniform(size=50), 0.0) * 0.01
        rows.append(row)
    w = np.concatenate(rows)
    z = w @ rng.uniform(50, 100, 150) + 0.1 * rng.standard_normal(120)
    evidence = Evidence.of(sparse.csr_matrix(w), z, noise_std=0.1, touch=np.repeat(np.arange(3), 40))
    mean, var = np.full(150, 60.0), np.full(150, 400.0)
    expected = -stats.multivariate_normal.logpdf(z, w @ mean, (w * var) @ w.T + 0.01 * np.eye(120))
    part = evidence.touched
    assert evidence.nll(torch.tensor(mean[part]), torch.tensor(var[part])).item() == pytest.approx(expected, rel=1e-9)


def test_no_contact_is_a_constant():
    evidence = Evidence.of(sparse.csr_matrix((5, 3)), np.ones(5), noise_std=2.0)
    value = evidence.nll(torch.zeros(0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
    assert value.item() == pytest.approx(-stats.norm.logpdf(np.ones(5), 0, 2.0).sum())


@pytest.mark.parametrize("change, words", [
    ({"z": np.ones(4)}, "must fit"), ({"z": np.array([1, np.nan, 1])}, "finite"),
                                           ({"noise_std": 0.0}, "noise_std greater than 0"),
])
def test_bad_input_is_refused(change, words):
    given = {"w": sparse.csr_matrix(np.ones((3, 5))), "z": np.ones(3), "noise_std": 1.0, **change}
    with pytest.raises(VsfError, match=words):
        Evidence.of(given.pop("w"), given.pop("z"), **given)
