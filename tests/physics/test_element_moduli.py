"""The moduli and Poisson's ratios that a user observes on a block of each kind of element."""

import numpy as np
import pytest
from element_body import SIZE, Body, E, tet
from scipy.sparse.linalg import spsolve

from vsfsim.physics.foundation import foundation
from vsfsim.physics.laws.law import confined_modulus, lame
from vsfsim.physics.mesh.quadratic import assemble
from vsfsim.physics.model import tetrahedra


def pulled(body, size, axis, *, strain=1e-6):
    """A block on rollers, its far end along ``axis`` pulled, its sides free: observed modulus [Pa], and the two
    Poisson's ratios."""
    points = body.points
    # the tangent at rest, see test_tangent_at_rest_is_the_rest_stiffness
    stiffness = assemble(len(points), body.model.blocks).tocsr()
    held = np.abs(points - points.min(axis=0)) < 1e-9
    end = np.abs(points[:, axis] - points[:, axis].max()) < 1e-9
    held[end, axis] = True
    u = np.zeros_like(points)
    u[end, axis] = strain * size[axis]
    u = u.ravel()
    free = ~held.ravel()
    u[free] = spsolve(stiffness[free][:, free].tocsc(), -(stiffness @ u)[free])
    force = body(u[:, None])[0].reshape(-1, 3)[end, axis].sum()
    moved = u.reshape(-1, 3)
    across = [-moved[np.abs(points[:, c] - points[:, c].max()) < 1e-9, c].mean() / (size[c] * strain) for c in range(3)
              if c != axis]
    return force * size[axis] / (np.prod(size) * strain), across


@pytest.mark.parametrize("pointwise", [0.0, 9.0, np.inf])
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49, 0.4999])
def test_observed_modulus_and_poisson_ratio_of_tetrahedra(block, device, nu, pointwise):
    body = Body(block(SIZE, 0.03, young_modulus=E, poisson_ratio=nu, elements=tet(pointwise)), device)
    modulus, across = pulled(body, SIZE, 2)
    # a homogeneous field, which the element holds exactly. The law is nonlinear: relative differences of the order of
    # the strain itself, times (lambda + mu) / E ~ 17 at nu 0.49 and 1667 at 0.4999
    assert modulus == pytest.approx(E, rel=3e-6 * max(1.0, 0.17 / (0.5 - nu)))
    assert across == pytest.approx([nu, nu], abs=1e-6)


def test_observed_stiffness_of_a_foundation(block, device):
    """Pressed down as a whole, the top of a layered block answers with the layers' confined moduli in series."""
    nu, size = 0.3, (0.03, 0.03, 0.02)
    body = Body(block(size, 0.005, young_modulus=lambda x: np.where(x[..., 2] < 0.01, E, 4.0 * E), poisson_ratio=nu,
                      elements=foundation), device)
    # away from the edges, where normals turn outwards
    inner = (np.abs(body.points[:, 2] - 0.02) < 1e-9) & (np.abs(body.points[:, :2]) < 0.0095).all(axis=1)
    u = np.zeros_like(body.points)
    u[:, 2] = -1e-4
    force = body(u.reshape(-1, 1))[0].reshape(-1, 3)[inner, 2].sum()
    # their part of the surface: 36 of the 6 x 6 squares of 5 mm lie within, shared with the nodes around; count by the
    # shares of a uniform field
    m = confined_modulus(1.0, nu)
    pressure = 1e-4 / (0.01 / (m * E) + 0.01 / (4.0 * m * E))
    stiffness = body.model.blocks[0].parameters["stiffness"]
    share = np.zeros(len(body.points))
    for face, area in zip(body.model.mesh.faces, body.model.mesh.face_area()):
        share[face] += area * np.array([3, 3, 3, 16, 16, 16]) / 57.0
    assert -force == pytest.approx(pressure * share[inner].sum(), rel=1e-3)
    assert share.sum() == pytest.approx(body.model.mesh.face_area().sum(), rel=1e-12)
    assert (stiffness > 0.0).all()
    assert body.model.grounding() == pytest.approx(np.repeat(stiffness, 3))


def test_bulk_stiffness_is_divided_between_the_points_and_the_mean(block):
    """All of it acts somewhere, and above nu = 0.47 most of it on the mean volume."""
    for nu, least, most in ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.4, 0.0, 0.0), (0.45, 0.5, 0.6), (0.48, 0.8, 0.9),
                            (0.4999, 0.999, 1.0)):
        made, = block(SIZE, 0.03, young_modulus=E, poisson_ratio=nu, elements=tetrahedra).blocks
        lam = float(lame(E, nu)[1])
        whole = made.parameters["lam"] + made.parameters["mean_lam"][:, None]
        assert whole == pytest.approx(np.full((len(made), 4), lam), rel=1e-8)
        assert least * lam <= made.parameters["mean_lam"].max() <= most * lam


def test_an_element_of_two_moduli_has_one_pressure(block):
    """The mean part of a mixed element: pressures equal, volume changes add up, so moduli combine harmonically."""
    made, = block(SIZE, 0.03, young_modulus=lambda x: E * np.array([1.0, 2.0, 4.0, 8.0])[None] * np.ones(x.shape[:2]),
                  poisson_ratio=0.49,
                  elements=tet(0.0)).blocks
    lam = float(lame(E, 0.49)[1])
    assert made.parameters["mean_lam"] == pytest.approx(lam * 4.0 / (1.0 + 0.5 + 0.25 + 0.125), rel=1e-12)
