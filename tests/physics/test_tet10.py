"""The quadratic element: energy, force, tangent and its projection, and the moduli that a user observes."""

import dataclasses

import numpy as np
import pytest
import warp as wp

from vsfsim.physics.coefficients import lame
from vsfsim.physics.elasticity import Elasticity
from vsfsim.physics.mesh import assemble, rest_stiffness_blocks

SIZE = (0.02, 0.03, 0.025)
E = 2e4


class Body:
    """A block without supports, and its element kernels for a batch of displacement fields."""

    def __init__(self, model, device, real=wp.float64):
        self.model = dataclasses.replace(model, free=np.ones_like(model.free))
        self.elements, self.device, self.real = Elasticity(self.model, device=device, real=real), device, real
        self.points = model.mesh.points

    def __call__(self, u):
        """Forces (3 n, B) [N], energy (B,) [J], least det F (B,) at u (3 n, B) [m]."""
        self.index = wp.array(np.arange(u.shape[1]), dtype=wp.int32, device=self.device)
        self.elements.begin(u.shape[1])
        self.u = wp.array(u, dtype=self.real, device=self.device)
        self.elements.forces(self.index, self.u)
        return tuple(a.numpy().astype(float) for a in (self.elements.internal, self.elements.energy, self.elements.least_det))

    def tangent_times(self, u, x, *, projected):
        """Tangent at u (3 n,) times x (3 n, k)."""
        many = np.repeat(u[:, None], x.shape[1], axis=1)
        self(many)
        self.elements.tangent(self.index, self.u, projected=projected)
        return self.elements.multiply(self.index, wp.array(x, dtype=self.real, device=self.device)).numpy().astype(float)


@pytest.fixture(scope="module")
def small(block):
    """20 tetrahedra, moduli that vary within each."""
    rng = np.random.default_rng(0)
    return block(SIZE, 0.03, young_modulus=lambda x: E * rng.uniform(0.5, 2.0, x.shape[:2]), poisson_ratio=0.4)


@pytest.fixture(scope="module")
def body(small, device):
    return Body(small, device)


def crumpled(body, size):
    """Random nodal displacements (3 n,) of standard deviation ``size`` [m]."""
    return size * np.random.default_rng(1).standard_normal(body.points.size)


# 8e-3 m is about the distance of neighbouring nodes: most elements are turned inside out
@pytest.mark.parametrize(("size", "inverted"), [(2e-4, False), (8e-3, True)])
def test_force_is_the_gradient_of_the_energy(body, size, inverted):
    u = crumpled(body, size)
    n = len(u)
    h = 1e-6  # m
    shifted = np.concatenate([u[:, None] + h * np.eye(n), u[:, None] - h * np.eye(n)], axis=1)
    energy = body(shifted)[1]
    slope = (energy[:n] - energy[n:]) / (2 * h)
    force, _, det = body(u[:, None])
    assert (det[0] < 0.0) == inverted
    # central differences: truncation (h / node distance)^2 ~ 2e-8, rounding 1e-16 energy / (h force) ~ 1e-8
    assert np.abs(force[:, 0] - slope).max() < 2e-7 * np.abs(slope).max()


def test_a_rigid_motion_costs_nothing(body):
    q, r = np.linalg.qr(np.random.default_rng(2).standard_normal((3, 3)))
    turn = q * np.sign(np.diag(r))
    turn *= np.linalg.det(turn)
    moved = body.points @ turn.T + [0.3, -0.2, 0.1]
    force, energy, det = body((moved - body.points).reshape(-1, 1))
    # zero but for rounding of positions of size 0.3 m: strain 1e-16 * 0.3 / 0.01 ~ 3e-15, in units of E area and E volume
    assert np.abs(force).max() < 1e-13 * E * 0.03**2 * 10
    assert abs(energy[0]) < 1e-13 * E * np.prod(SIZE)
    assert det[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("size", [2e-4, 8e-3])
def test_tangent_is_the_derivative_of_the_force(body, size):
    u = crumpled(body, size)
    x = np.random.default_rng(3).standard_normal((len(u), 12))
    h = 1e-6
    force = body(np.concatenate([u[:, None] + h * x, u[:, None] - h * x], axis=1))[0]
    slope = (force[:, :12] - force[:, 12:]) / (2 * h)
    product = body.tangent_times(u, x, projected=False)
    # as for the force; the singular value decomposition inside is good to ~1e-10
    assert np.abs(product - slope).max() < 5e-7 * np.abs(slope).max()


@pytest.mark.parametrize("projected", [False, True])
def test_tangent_is_symmetric(body, projected):
    u = crumpled(body, 4e-3)
    whole = body.tangent_times(u, np.eye(len(u)), projected=projected)
    # rounding only; the sums are of 1e2 terms
    assert np.abs(whole - whole.T).max() < 1e-12 * np.abs(whole).max()
    lowest = np.linalg.eigvalsh(0.5 * (whole + whole.T))[0]
    if projected:
        assert lowest > -1e-9 * np.abs(whole).max()
    else:
        assert lowest < -1e-3 * np.abs(whole).max(), "this state was meant to be unstable"


@pytest.mark.parametrize("projected", [False, True])
def test_tangent_at_rest_is_linear_elasticity(body, projected):
    n = body.points.size
    tangent = body.tangent_times(np.zeros(n), np.eye(n), projected=projected)
    m = body.model
    rest = assemble(len(m.mesh.points), m.mesh.tets, rest_stiffness_blocks(m.mesh, m.mu, m.lam)).toarray()
    # the projection clamps eigenvalues that are zero (rotations) and positive: nothing, but for rounding in the decomposition
    assert np.abs(tangent - rest).max() < 1e-9 * np.abs(rest).max()


# ------------------------------------------------------------------------------------------ one deformation gradient


def energy_density(f, mu, lam):
    """The law as the head of tet10.py states it; works for complex f."""
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


@pytest.mark.parametrize("nu", [0.0, 0.49])
@pytest.mark.parametrize("f", GRADIENTS.values(), ids=GRADIENTS.keys())
@pytest.mark.parametrize("projected", [False, True])
def test_hessian_of_one_gradient_is_the_numeric_one_with_its_eigenvalues_clamped(block, device, f, projected, nu):
    body = Body(block(SIZE, 0.03, young_modulus=1.0, poisson_ratio=nu), device)
    body((body.points @ f.T - body.points).reshape(-1, 1))
    body.elements.tangent(body.index, body.u, projected=projected)
    mu, lam = (float(v) for v in lame(1.0, nu))
    expected = numeric_hessian(f, mu, lam)
    if projected:
        values, vectors = np.linalg.eigh(expected)
        expected = (vectors * np.maximum(values, 0.0)) @ vectors.T
    weight = body.model.mesh.volume[0] / 4.0
    found = body.elements._hessian.numpy()[0, :, 0] / weight
    # the numeric one is good to h^2 = 1e-10 (the law is a polynomial), and near a zero eigenvalue clamping passes that on
    assert np.abs(found - expected).max() < 1e-8 * np.abs(expected).max()


# ------------------------------------------------------------------------------------------ what a user observes


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49])
def test_observed_modulus_and_poisson_ratio(block, device, nu):
    body = Body(block(SIZE, 0.03, young_modulus=E, poisson_ratio=nu), device)
    points = body.points
    n = points.size
    stiffness = body.tangent_times(np.zeros(n), np.eye(n), projected=False)
    strain = 1e-6
    # rollers on three faces, the top pulled up, the sides free: a homogeneous field, which the element holds exactly
    low = points.min(axis=0)
    held = np.abs(points - low) < 1e-9
    top = np.abs(points[:, 2] - SIZE[2]) < 1e-9
    held[top, 2] = True
    given = np.zeros_like(points)
    given[top, 2] = strain * SIZE[2]
    free = ~held.ravel()
    u = given.ravel().copy()
    u[free] = np.linalg.solve(stiffness[np.ix_(free, free)], -(stiffness @ u)[free])
    force = body(u[:, None])[0].reshape(-1, 3)
    area = SIZE[0] * SIZE[1]
    side = np.abs(points[:, 0] - points[:, 0].max()) < 1e-9
    # the law is nonlinear: relative differences of the order of the strain itself, times (lambda + mu) / E ~ 17 at nu 0.49
    assert force[top, 2].sum() / (area * strain) == pytest.approx(E, rel=5e-5)
    assert -u.reshape(-1, 3)[side, 0].mean() / (SIZE[0] * strain) == pytest.approx(nu, abs=1e-9)


def test_single_precision_is_as_good_as_its_digits(small, body, device):
    single = Body(small, device, wp.float32)
    u = crumpled(body, 2e-3)[:, None]
    force, energy, det = body(u)
    force32, energy32, det32 = single(u)
    # 6e-8 a rounding, some 30 of them in a row; forces against the largest, as they are sums that cancel
    assert np.abs(force32 - force).max() < 30 * 6e-8 * np.abs(force).max()
    assert energy32[0] == pytest.approx(energy[0], rel=30 * 6e-8)
    assert det32[0] == pytest.approx(det[0], abs=1e-5)
