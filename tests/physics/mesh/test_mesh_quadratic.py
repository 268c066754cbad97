"""The quadratic mesh: integration, weight, supports."""

import numpy as np
import pytest

from vsfsim.core.solid import Solid
from vsfsim.physics.mesh.quadratic import gauss_points, quadratic_mesh
from vsfsim.physics.mesh.structured import box
from vsfsim.physics.model import gravity_load, held_nodes

SIZE = (0.04, 0.05, 0.03)


def solid_of(vertices, tets):
    return Solid(vertices, tets, np.zeros(len(tets), int), ("body",))


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
