"""The quadratic mesh: counts, winding, integration, weight."""

import numpy as np
import pytest

from vsfsim.core.solid import Solid
from vsfsim.physics.elements.tet10_shape import EDGES
from vsfsim.physics.mesh.quadratic import gauss_points, quadratic_mesh
from vsfsim.physics.mesh.structured import ball, box
from vsfsim.physics.model import gravity_load, held_nodes

SIZE = (0.04, 0.05, 0.03)


def solid_of(vertices, tets):
    return Solid(vertices, tets, np.zeros(len(tets), int), ("body",))


@pytest.fixture(scope="module", params=["box", "ball"])
def solid(request):
    return solid_of(*(box(SIZE, 0.02) if request.param == "box" else ball(0.03, 0.015)))


def test_counts_and_where_the_edge_nodes_are(solid):
    mesh = quadratic_mesh(solid)
    edges = {tuple(sorted(pair)) for tet in solid.tets for pair in tet[EDGES].tolist()}
    assert len(mesh.points) == len(solid.vertices) + len(edges)
    assert mesh.tets.shape == (len(solid.tets), 10)
    corners = mesh.points[mesh.tets[:, :4]]
    middle = corners[:, EDGES].mean(axis=2)
    assert np.abs(mesh.points[mesh.tets[:, 4:]] - middle).max() < 1e-15
    # the boundary of a body without holes: Euler's V - E + F = 2 with E = 3 F / 2, and six-node triangles have V + E
    # nodes
    faces = len(mesh.faces)
    assert len(mesh.surface_nodes()) == 2 + faces // 2 + 3 * faces // 2
    # gradients of the last three barycentric coordinates: 1 at the own corner, 0 at the others
    rise = np.einsum("mqkc,mjc->mqkj", mesh.gradients, corners[:, 1:] - corners[:, :1])
    assert np.abs(rise - np.eye(3)).max() < 1e-12


def test_faces_look_outwards_and_know_their_edges(solid):
    mesh = quadratic_mesh(solid)
    a, b, c, ab, bc, ca = (mesh.points[mesh.faces[:, k]] for k in range(6))
    normal = np.cross(b - a, c - a)
    inside = mesh.points[mesh.tets[mesh.owner, :4]].mean(axis=1)
    assert (np.einsum("fi,fi->f", normal, a - inside) > 0).all()
    for edge, (p, q) in zip((ab, bc, ca), ((a, b), (b, c), (c, a))):
        assert np.abs(edge - 0.5 * (p + q)).max() < 1e-15
    # Gauss: the volume from the surface
    volume = np.einsum("fi,fi->f", a + b + c, normal).sum() / 18.0
    assert volume == pytest.approx(mesh.volume.sum(), rel=1e-12)
    assert mesh.face_area().sum() == pytest.approx(0.5 * np.linalg.norm(normal, axis=1).sum(), rel=1e-12)
    # every boundary triangle belongs to its owner
    assert all(set(f) <= set(t) for f, t in zip(mesh.faces.tolist(), mesh.tets[mesh.owner].tolist()))


def test_gauss_points_integrate_a_quadratic_exactly():
    solid = solid_of(*box(SIZE, 0.02))
    mesh = quadratic_mesh(solid)
    x = gauss_points(solid)
    weight = mesh.volume[:, None] / 4.0
    lx, ly, lz = SIZE
    volume = lx * ly * lz
    # closed forms over [-lx/2, lx/2] x [-ly/2, ly/2] x [0, lz]
    for values, exact in ((np.ones(x.shape[:2]), volume), (x[..., 2], volume * lz / 2),
                          (x[..., 0] ** 2, volume * lx**2 / 12),
                          (x[..., 2] ** 2, volume * lz**2 / 3),
                          (x[..., 1] ** 2 + 3 * x[..., 2], volume * (ly**2 / 12 + 1.5 * lz))):
        assert (weight * values).sum() == pytest.approx(exact, rel=1e-12)
    # and not everything: the rule is of degree 2, degree 4 must differ (else this test would prove nothing)
    assert abs((weight * x[..., 2] ** 4).sum() - volume * lz**4 / 5) > 1e-4 * volume * lz**4


def test_weight_and_its_moment():
    mesh = quadratic_mesh(solid_of(*box(SIZE, 0.02)))
    gravity = np.array([1.0, -2.0, -9.81])
    load = gravity_load(mesh, 1200.0, gravity).reshape(-1, 3)
    mass = 1200.0 * np.prod(SIZE)
    assert load.sum(axis=0) == pytest.approx(mass * gravity, rel=1e-12)
    # work in a linear field: that of the weight at the centroid; in a quadratic one: the integral
    field = mesh.points @ [0.3, 0.5, 0.7]
    assert field @ load[:, 2] == pytest.approx(mass * gravity[2] * 0.7 * SIZE[2] / 2, rel=1e-12)
    assert mesh.points[:, 2] ** 2 @ load[:, 2] == pytest.approx(mass * gravity[2] * SIZE[2] ** 2 / 3, rel=1e-12)


def test_held_nodes():
    mesh = quadratic_mesh(solid_of(*box(SIZE, 0.02)))
    bottom = held_nodes(mesh.points, "bottom", 1e-6)
    assert bottom.any() and (mesh.points[bottom, 2] == 0.0).all() and (mesh.points[~bottom, 2] > 0.0).all()
    # a box may be given by any two opposite corners
    assert (held_nodes(mesh.points, (1, 1, 0.0, -1, -1, -1), 0.0) == bottom).all()
