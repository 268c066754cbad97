"""Signed distances of the probes: the kernels against the host, normals against finite differences."""


import numpy as np
import pytest
from test_rigid import evaluate

from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, Sphere
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.bodies import RigidBodies

PROBES = [Sphere(0.02), Capsule(0.01, 0.03), Cylinder(0.015, 0.04), Cylinder(0.03, 0.005), Box((0.02, 0.03, 0.05)),
          Plane()]
IDS = ["sphere", "capsule", "cylinder", "disc", "box", "plane"]


def near_surface(probe, count=4000):
    """Points of both sides within a few millimetres of the surface."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.06, 0.06, (40 * count, 3))
    return x[np.abs(sdf.distance(probe, x)) < 0.004][:count]


@pytest.mark.parametrize("probe", PROBES, ids=IDS)
def test_gap_is_the_hosts_distance_and_normal_its_gradient(probe, device):
    x = near_surface(probe)
    assert len(x) > 1000
    gap, normal, _ = evaluate(RigidBodies([Sphere(1.0), probe]), 1, x, device)
    assert np.abs(gap - sdf.distance(probe, x)).max() < 1e-15
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-12
    h = 1e-7
    slope = np.stack([(sdf.distance(probe, x + h * e) - sdf.distance(probe, x - h * e)) / (2 * h) for e in np.eye(3)],
                     axis=1)
    # rounding 1e-17 / h = 1e-10, truncation h / fillet ~ 1e-7 / 5e-5 = 2e-3 where a difference straddles a fillet's end
    off = np.abs(normal - slope).max(axis=1)
    # inside, the medial surface has no gradient: points whose difference straddles it are few (measure zero) and left
    # out
    smooth = np.linalg.norm(slope, axis=1) > 0.999
    assert smooth.mean() > 0.995
    assert off[smooth].max() < 3e-3
    assert np.quantile(off, 0.95) < 1e-6


@pytest.mark.parametrize("probe", PROBES, ids=IDS)
def test_nothing_is_nan_where_a_shape_has_no_normal(probe, device):
    special = np.array([[0, 0, 0], [0, 0, 0.01], [0, 0, -0.015], [0, 0, 0.02], [0.01, 0, 0], [0, -0.015, 0],
                        [0.01, 0.015, 0.025], [1e-300, 0, 0]], float)
    gap, normal, curvature = evaluate(RigidBodies([Sphere(1.0), probe]), 1, special, device)
    assert np.isfinite(gap).all() and np.isfinite(normal).all() and np.isfinite(curvature).all()
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-12
    assert np.abs(gap - sdf.distance(probe, special)).max() < 1e-15


def test_distances_that_can_be_told_by_hand():
    assert sdf.distance(Sphere(0.02), [0.0, 0.03, 0.0]) == pytest.approx(0.01)
    assert sdf.distance(Capsule(0.01, 0.03), [[0.02, 0, 0.01], [0, 0, 0.04]]) == pytest.approx([0.01, 0.015])
    assert sdf.distance(Cylinder(0.015, 0.04), [[0.02, 0, 0], [0, 0, 0.03],
                                                [0, 0, 0]]) == pytest.approx([0.005, 0.01, -0.015])
    assert sdf.distance(Box((0.02, 0.03, 0.05)), [[0.02, 0, 0], [0, 0, -0.03],
                                                  [0, 0, 0]]) == pytest.approx([0.01, 0.005, -0.01])
    assert sdf.distance(Plane(), [1.0, 2.0, -0.5]) == pytest.approx(-0.5)


@pytest.mark.parametrize("probe", PROBES[:-1], ids=IDS[:-1])
def test_reach_and_support_hold_the_whole_probe(probe):
    rng = np.random.default_rng(1)
    x = rng.uniform(-0.06, 0.06, (400_000, 3))
    x = x[sdf.distance(probe, x) <= 0.0]
    assert np.linalg.norm(x, axis=1).max() <= sdf.reach(probe)
    fillet = sdf.encode(probe)[1][3]
    for direction in np.vstack([np.eye(3), -np.eye(3), rng.standard_normal((10, 3))]):
        d = direction / np.linalg.norm(direction)
        # against a far plane: the distance from a point far along d is what is left of the way, exactly for a convex
        # shape at infinity
        far = 1e5
        exact = far - float(sdf.distance(probe, far * d))
        # the support is that of the sharp shape, past the rounded one by (sqrt 3 - 1) fillets at most; 1e5 m cost 1e-11
        # m of rounding and size^2 / far = 1e-7 m of parallax
        assert -1e-7 <= sdf.support(probe, d) - exact <= 0.74 * fillet + 1e-7
