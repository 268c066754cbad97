"""The energy, force, tangent and projected tangent of every element agree.

A new element is tested by adding a row to `ELEMENTS`, `FLAT` or `DOMES`.
"""

import numpy as np
import pytest
from element_body import FOAM, SIZE, Body, E, tet

from vsfsim.core.solid import Solid
from vsfsim.physics.elements import gas, hinge, triangle
from vsfsim.physics.laws import hyperfoam
from vsfsim.physics.mesh.membrane import TriangleMesh, closed, ellipse
from vsfsim.physics.mesh.quadratic import assemble
from vsfsim.physics.model import Model, tetrahedra

ELEMENTS = {"tet10": tet(np.inf), "tet10 of mean volume": tet(0.0), "tet10 of both": tet(2.0),
            "hyperfoam": lambda mesh, modulus, _: tetrahedra(mesh, modulus, FOAM.poisson_ratio, law=hyperfoam.LAW,
                                                             settings=hyperfoam.settings_of(FOAM)),
            "two blocks": lambda *given: (*tet(2.0)(*given), *tet(np.inf)(*given))}


def membrane(mesh, flat):
    """Triangles that a clamp has stretched: within rounding of rest they turn slack and taut at every step."""
    return triangle.block(mesh.faces, mesh.points, flat[mesh.faces] / 1.1, 700.0)


def bending(mesh, flat):
    return hinge.block(mesh.faces, mesh.points, flat, 1e-4)


def air(mesh, flat, *, pressure=0.0, gamma=1.4):
    return gas.block(closed(mesh.faces, mesh.rim), mesh.points, pressure=pressure, volume=mesh.volume[0], gamma=gamma,
                     dead_volume=2e-5)


# elements of surfaces: on a sheet of triangles, flat for what is to be at rest there, else a dome
FLAT = {"triangle": lambda *given: (membrane(*given),),
        "hinge": lambda *given: (bending(*given),)}
DOMES = {"gas": lambda *given: (air(*given),), "isothermal gas": lambda *given: (air(*given, gamma=1.0),),
         "pressed gas": lambda *given: (air(*given, pressure=5e3),),
         "bubble": lambda *given: (membrane(*given), bending(*given), air(*given, pressure=5e3))}
SURFACES = (*FLAT, *DOMES)
LOADED = ("triangle", "pressed gas", "bubble")  # u = 0 is not free of stress, or held by a pressure
CONVEX = ("triangle", "hinge")  # never unstable: linear, or relaxed (elements/triangle.py)


def surface(kind):
    """19 nodes and 24 triangles or so, flat or a dome 5 mm high, not held; a `Model` as far as elements need one."""
    flat, faces, rim = ellipse(SIZE[1], SIZE[0], 30)
    height = 0.0 if kind in FLAT else 0.005 * (1.0 - (flat[:, 0] / SIZE[1]) ** 2 - (flat[:, 1] / SIZE[0]) ** 2)
    mesh = TriangleMesh.of(np.column_stack([flat, height * np.ones(len(flat))]), faces.astype(np.int32), rim)
    blocks = {**FLAT, **DOMES}[kind](mesh, flat)
    n = len(flat)
    return Model(mesh, blocks, np.full(1, E), np.ones(3 * n), np.zeros(3 * n), np.full(len(faces), E),
                 Solid(np.zeros((0, 3)), np.zeros((0, 4), int), np.zeros(0, int), ("sheet",)),
                 0.01, None)


def rest_stiffness(model):
    """Of all blocks (3 n, 3 n), the coupling by a gas too."""
    n = len(model.mesh.points)
    out = assemble(n, model.blocks).toarray()
    for block in model.blocks:
        if block.collective:
            gradient, rate = block.element.rest_coupling(block, n)
            out += rate * np.outer(gradient, gradient)
    return out


@pytest.fixture(scope="module")
def small(block):
    """Makes 20 tetrahedra's worth of one kind of element, moduli that vary within each."""
    rng = np.random.default_rng(0)
    values = rng.uniform(0.5, 2.0, (10_000, 4))

    def make(kind):
        if kind in SURFACES:
            return surface(kind)
        return block(SIZE, 0.03, young_modulus=lambda x: E * values[:len(x)], poisson_ratio=0.4,
                     elements=ELEMENTS[kind])

    return make


@pytest.fixture(scope="module", params=(*ELEMENTS, *SURFACES))
def body(small, device, request):
    made = Body(small(request.param), device)
    made.kind = request.param
    return made


def crumpled(body, size):
    """Random nodal displacements (3 n,) of standard deviation ``size`` [m]."""
    return size * np.random.default_rng(1).standard_normal(body.points.size)


def step(body):
    """Of the central differences [m]: shorter for sheets, whose tangent has kinks where they wrinkle, and for a law of
    powers of the stretches."""
    return 1e-7 if body.kind in (*SURFACES, "hyperfoam") else 1e-6


# 8e-3 m is about the distance of neighbouring nodes: most elements are turned inside out
@pytest.mark.parametrize(("size", "inverted"), [(2e-4, False), (8e-3, True)])
def test_force_is_the_gradient_of_the_energy(body, size, inverted):
    u = crumpled(body, size)
    n = len(u)
    h = step(body)
    shifted = np.concatenate([u[:, None] + h * np.eye(n), u[:, None] - h * np.eye(n)], axis=1)
    energy = body(shifted)[1]
    slope = (energy[:n] - energy[n:]) / (2 * h)
    force, _, det = body(u[:, None])
    assert (det[0] < 0.0) == (inverted and body.kind not in SURFACES)
    # central differences: truncation (h / node distance)^2 ~ 2e-8, of sheets that are squeezed to a tenth 2e-6;
    # rounding 1e-16 energy / (h force) ~ 1e-8
    assert np.abs(force[:, 0] - slope).max() < (2e-6 if body.kind in SURFACES else 2e-7) * np.abs(slope).max()


def rotation(seed):
    q, r = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    return q * np.linalg.det(q)


def test_a_rigid_motion_costs_nothing(body):
    moved = body.points @ rotation(2).T + [0.3, -0.2, 0.1]
    u = moved - body.points
    force, energy, det = body(u.reshape(-1, 1))
    if body.kind in LOADED:
        # the energy and the forces of u = 0, turned with the body; stiffness (4e3 N/m) times rounding of positions of
        # 0.3 m is 1e-13 N, some 30 in a sum
        before, stored, _ = body(np.zeros((u.size, 1)))
        assert np.abs(force.reshape(-1, 3) - before.reshape(-1, 3) @ rotation(2).T).max() < 1e-11 * np.abs(before).max()
        assert energy[0] == pytest.approx(stored[0], rel=1e-12, abs=1e-14)
        return
    # zero but for rounding of positions of size 0.3 m: strain 1e-16 * 0.3 / 0.01 ~ 3e-15, in units of E area and E
    # volume
    assert np.abs(force).max() < 1e-13 * E * 0.03**2 * 10
    assert abs(energy[0]) < 1e-13 * E * np.prod(SIZE)
    assert det[0] == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize("size", [2e-4, 8e-3])
def test_tangent_is_the_derivative_of_the_force(body, size):
    u = crumpled(body, size)
    x = np.random.default_rng(3).standard_normal((len(u), 12))
    h = step(body)
    force = body(np.concatenate([u[:, None] + h * x, u[:, None] - h * x], axis=1))[0]
    slope = (force[:, :12] - force[:, 12:]) / (2 * h)
    product = body.tangent_times(u, x, projected=False)
    # as for the force
    assert np.abs(product - slope).max() < (5e-6 if body.kind in SURFACES else 5e-7) * np.abs(slope).max()


@pytest.mark.parametrize("projected", [False, True])
def test_tangent_is_symmetric_and_its_projection_never_negative(body, projected):
    u = crumpled(body, 4e-3)
    whole = body.tangent_times(u, np.eye(len(u)), projected=projected)
    # rounding only; the sums are of 1e2 terms
    assert np.abs(whole - whole.T).max() <= 1e-12 * np.abs(whole).max()
    lowest = np.linalg.eigvalsh(0.5 * (whole + whole.T))[0]
    if projected or body.kind in CONVEX:
        assert lowest >= -1e-12 * np.abs(whole).max()
    else:
        assert lowest < -1e-3 * np.abs(whole).max(), "this state was meant to be unstable"
    if body.kind not in SURFACES and body.device == "cpu":  # the matrix that is factorised is that of the products
        order = body.model.factor.order
        body.elements.add_matrices(0, order, values := np.zeros((len(order.owners), 3, 3)))
        blocks = whole.reshape(*body.points.shape, *body.points.shape)[order.owners, :, order.neighbours]
        assert np.abs(values - blocks).max() < 1e-12 * np.abs(whole).max()


@pytest.mark.parametrize("projected", [False, True])
def test_tangent_at_rest_is_the_rest_stiffness(body, projected):
    n = body.points.size
    tangent = body.tangent_times(np.zeros(n), np.eye(n), projected=projected)
    if projected and body.kind in DOMES:
        return  # its projection leaves out what the pressure takes away
    rest = rest_stiffness(body.model)
    # the projection meets eigenvalues that are zero (rotations) and positive: nothing to do, but for rounding of
    # singular values of 1
    assert np.abs(tangent - rest).max() < 1e-12 * np.abs(rest).max() * (1e4 if projected else 1.0)
    if body.kind not in SURFACES:
        assert np.abs(body.model.factor.stiffness - rest).max() < 1e-12 * np.abs(rest).max()


@pytest.mark.parametrize("stretches", [(0.8, 0.7, 0.6), (0.95, 0.9, 0.8), (1.5, 1.2, 0.3)])
def test_under_pressure_the_projection_adds_no_more_than_it_must(small, device, stretches):
    """Of the nine uniform deformations some have negative stiffness; the projected tangent has the softest at zero."""
    body = Body(small("tet10"), device)
    own = rotation(4)
    u = (body.points @ (own @ np.diag(stretches) @ own.T - np.eye(3))).ravel()
    modes = np.einsum("ni,kc->nkci", body.points, np.eye(3)).reshape(-1, 9)
    exact, projected = (np.linalg.eigvalsh(modes.T @ body.tangent_times(u, modes, projected=p))
                        for p in (False, True))
    assert exact[0] < -0.1 * exact[-1] and abs(projected[0]) < 1e-12 * projected[-1]
