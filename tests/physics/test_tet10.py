"""The quadratic tetrahedron's law in homogeneous fields, against its closed form."""

import numpy as np
import pytest
from element_body import SIZE, Body, tet
from scipy.integrate import simpson
from scipy.optimize import brentq

from vsfsim.physics.laws.law import lame
from vsfsim.physics.laws.neo_hooke import CRUSHED


def affine(body, gradient):
    """Displacements (3 n,) [m] of a homogeneous displacement gradient."""
    return (body.points @ gradient.T).ravel()


def hessian(body, f, *, projected):
    """Second derivative of the energy density by F (9, 9), as homogeneous fields meet it [Pa]."""
    fields = np.stack([affine(body, e.reshape(3, 3)) for e in np.eye(9)], axis=1)
    product = body.tangent_times(affine(body, f - np.eye(3)), fields, projected=projected)
    return fields.T @ product / body.model.mesh.volume.sum()


def axial_stress(axial, nu):
    """(dPsi/d(axial), lateral stretch, J) of the law under uniaxial stress, E = 1, by its closed form."""
    mu, lam = (float(v) for v in lame(1.0, nu))

    def slope(j):
        return lam * (j - 1.0) - mu / j

    def across(side):
        return mu * side + slope(axial * side**2) * axial * side

    side = brentq(across, 0.9, 3.0, xtol=1e-15)
    j = axial * side**2
    return mu * axial + slope(j) * side**2, side, j


@pytest.mark.parametrize("nu", [0.0, 0.1, 0.3, 0.45, 0.499, 0.4999])
def test_uniaxial_compression_to_eighty_per_cent(block, device, nu):
    """Lateral stretch free: the force rises all the way, never softer than at the start, and is the closed form's."""
    body = Body(block(SIZE, 0.03, young_modulus=1.0, poisson_ratio=nu, elements=tet(4.0)), device)
    corner = body.points.min(axis=0)
    stretches = 1.0 - np.linspace(0.0, 0.8, 81)
    closed = np.array([axial_stress(s, nu) for s in stretches])
    assert (np.diff(closed[:, 0]) < -0.99 * 0.01).all() and (closed[:, 2] > CRUSHED).all()
    u = np.stack([((body.points - corner) * [side - 1.0, side - 1.0, s - 1.0]).ravel()
                  for s, side in zip(stretches, closed[:, 1], strict=True)], axis=1)
    force, energy, det = body(u)
    force = force.reshape(-1, 3, len(stretches))
    top = body.points[:, 2] > corner[2] + SIZE[2] - 1e-9
    wall = body.points[:, 0] > corner[0] + SIZE[0] - 1e-9
    area = SIZE[0] * SIZE[1]
    # rounding of (lambda + mu) (J - 1): 1e-16 times 1667 at nu = 0.4999, and of the root
    assert force[top, 2].sum(axis=0) / area == pytest.approx(closed[:, 0], abs=1e-10)
    assert np.abs(force[wall, 0].sum(axis=0)).max() < 1e-10 * area
    assert det == pytest.approx(closed[:, 2], abs=1e-12)
    # energy = work of the axial force, by Simpson's rule over 80 intervals
    work = simpson(closed[:, 0], x=stretches)
    assert energy[-1] / np.prod(SIZE) == pytest.approx(work, rel=1e-4)


def test_the_continuation_of_the_logarithm_is_smooth(block, device):
    """Energy, stress and tangent along a line of uniform compression from J = 0.2 through 0.1 to an inverted element:
    no jump, and a force that pushes out at every point."""
    nu = 0.1
    body = Body(block(SIZE, 0.03, young_modulus=1.0, poisson_ratio=nu, elements=tet(4.0)), device)
    mu, lam = (float(v) for v in lame(1.0, nu))
    axial = np.concatenate([np.linspace(0.2, -0.5, 141), CRUSHED + np.array([1e-9, -1e-9])])
    u = np.stack([(body.points * [0.0, 0.0, a - 1.0]).ravel() for a in axial], axis=1)
    force, energy, _ = body(u)
    top = body.points[:, 2] > body.points[:, 2].max() - 1e-9
    stress = force.reshape(-1, 3, len(axial))[top, 2].sum(axis=0) / (SIZE[0] * SIZE[1])
    j = axial
    slope = np.where(j >= CRUSHED, 1.0 / np.maximum(j, CRUSHED), (2.0 * CRUSHED - j) / CRUSHED**2)
    assert stress == pytest.approx(mu * axial - mu * slope + lam * (j - 1.0), rel=1e-9)
    assert (np.diff(stress[:141]) < 0.0).all() and (stress < 0.0).all()
    assert energy[-1] == pytest.approx(energy[-2], rel=1e-6) and stress[-1] == pytest.approx(stress[-2], rel=1e-6)
    tangent = [hessian(body, np.diag([1.0, 1.0, a]), projected=False) for a in axial[-2:]]
    assert np.abs(tangent[0] - tangent[1]).max() < 1e-6 * np.abs(tangent[0]).max()


@pytest.mark.parametrize("change", [1e-9, 1e-6, 1e-3, -1e-3, 0.2499, 0.2501, -0.2499, -0.2501])
def test_the_energy_keeps_its_digits_at_small_strains(block, device, change):
    body = Body(block(SIZE, 0.03, young_modulus=1.0, poisson_ratio=0.3, elements=tet(4.0)), device)
    mu, lam = (float(v) for v in lame(1.0, 0.3))
    _, energy, det = body((body.points * [0.0, 0.0, change]).reshape(-1, 1))
    j1 = change
    # mu/2 (2 e + e^2) - mu ln(1 + e): log1p(e) - e by its own series where it cancels
    tail = sum((-1.0) ** n * j1**n / n for n in range(2, 60)) if abs(j1) < 0.3 else j1 - np.log1p(j1)
    exact = 0.5 * mu * j1**2 + mu * tail + 0.5 * lam * j1**2
    # of the strain of the nodes, 1e-16 times a position of 0.02 m
    assert energy[0] / np.prod(SIZE) == pytest.approx(exact, rel=1e-12 + 1e-14 / abs(change))
    assert det[0] == pytest.approx(1.0 + change, abs=1e-15)
