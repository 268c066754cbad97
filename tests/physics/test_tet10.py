"""The quadratic tetrahedron's law at one deformation gradient: the tangent, and what its projection leaves of it."""

import numpy as np
import pytest
from element_body import SIZE, Body, tet

from vsfsim.physics.coefficients import lame


def energy_density(f, mu, lam):
    """The law as the head of tet10.py states it (point by point, or a homogeneous field); works for complex f."""
    j = (f[0, 0] * (f[1, 1] * f[2, 2] - f[1, 2] * f[2, 1]) - f[0, 1] * (f[1, 0] * f[2, 2] - f[1, 2] * f[2, 0])
         + f[0, 2] * (f[1, 0] * f[2, 1] - f[1, 1] * f[2, 0]))
    return 0.5 * mu * ((f * f).sum() - 3.0) - mu * (j - 1.0) + 0.5 * (lam + mu) * (j - 1.0) ** 2


def gradient(f, mu, lam):
    """Complex step: exact to rounding."""
    out = np.zeros(9)
    for k in range(9):
        g = f.astype(complex).ravel()
        g[k] += 1e-30j
        out[k] = energy_density(g.reshape(3, 3), mu, lam).imag / 1e-30
    return out


def numeric_hessian(f, mu, lam):
    h = 1e-5
    out = np.zeros((9, 9))
    for k in range(9):
        d = np.zeros(9)
        d[k] = h
        out[:, k] = (gradient(f + d.reshape(3, 3), mu, lam) - gradient(f - d.reshape(3, 3), mu, lam)) / (2 * h)
    return 0.5 * (out + out.T)


def turned(rng, stretches):
    u, v = (np.linalg.qr(rng.standard_normal((3, 3)))[0] for _ in range(2))
    return u @ np.diag(stretches) @ v.T * np.linalg.det(u) * np.linalg.det(v)


RNG = np.random.default_rng(5)
GRADIENTS = {
    "det > 0": turned(RNG, [1.7, 0.9, 0.4]),
    "det < 0": turned(RNG, [1.4, 0.8, -0.5]),
    "near identity": np.eye(3) + 1e-7 * RNG.standard_normal((3, 3)),
    "two equal stretches": turned(RNG, [1.3, 1.3, 0.5]),
    "three equal stretches": turned(RNG, [0.6, 0.6, 0.6]),
    "flat": turned(RNG, [1.2, 0.7, 0.0]),
    "inverted twice as strongly": turned(RNG, [-1.5, 1.5, 1.5]),
}


def affine(body, gradient):
    """Displacements (3 n,) [m] of a homogeneous displacement gradient."""
    return (body.points @ gradient.T).ravel()


def hessian(body, f, *, projected):
    """Second derivative of the energy density by F (9, 9), as homogeneous fields meet it [Pa]."""
    fields = np.stack([affine(body, e.reshape(3, 3)) for e in np.eye(9)], axis=1)
    product = body.tangent_times(affine(body, f - np.eye(3)), fields, projected=projected)
    return fields.T @ product / body.model.mesh.volume.sum()


@pytest.mark.parametrize("pointwise", [0.0, 3.0, np.inf])
@pytest.mark.parametrize("nu", [0.0, 0.45])
@pytest.mark.parametrize("f", GRADIENTS.values(), ids=GRADIENTS.keys())
def test_tangent_of_one_gradient(block, device, f, nu, pointwise):
    body = Body(block(SIZE, 0.03, young_modulus=1.0, poisson_ratio=nu, elements=tet(pointwise)), device)
    mu, lam = (float(v) for v in lame(1.0, nu))
    expected = numeric_hessian(f, mu, lam)
    found = hessian(body, f, projected=False)
    # the numeric one is good to h^2 = 1e-10 (the law is a polynomial)
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()
    cut = hessian(body, f, projected=True)
    values = np.linalg.eigvalsh(cut)
    assert values[0] > -1e-9 * values[-1]
    # mu + kappa cof (x) cof is never touched; of the rest a part theta is kept
    cof = np.array([np.cross(f[1], f[2]), np.cross(f[2], f[0]), np.cross(f[0], f[1])])
    kept = mu * np.eye(9) + (lam + mu) * np.outer(cof.ravel(), cof.ravel())
    rest = expected - kept
    theta = float((rest * (cut - kept)).sum() / (rest * rest).sum())
    assert np.abs(cut - kept - theta * rest).max() < 1e-7 * np.abs(expected).max()
    # and as much as can be, or half of it; all of it where nothing is negative
    assert np.linalg.eigvalsh(expected)[0] < -1e-6 * mu or theta == pytest.approx(1.0, abs=1e-6)
    if pointwise == np.inf:
        assert theta > 0.999 or np.linalg.eigvalsh(kept + min(1.0, 2.002 * theta) * rest)[0] < 1e-6 * values[-1]
    assert 0.0 < theta < 1.0 + 1e-9
    _, _, least = body(affine(body, f - np.eye(3))[:, None])
    assert least[0] == pytest.approx(np.linalg.det(f), abs=1e-12)
