"""Stick-slip of independent particles against closed forms."""

import itertools
import math

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from vsfsim.core.shape import Box, Plane, Sphere
from vsfsim.vsf.dynamics import simulate
from vsfsim.vsf.observe import force_sum_rows, normal_force_rows

R = 0.02
DOWN = Rotation.from_euler("x", 180, degrees=True).as_matrix()


def path(*corners: tuple, frames: int = 5, rotation: np.ndarray | None = None) -> np.ndarray:
    """Straight legs between corners, ``frames`` steps each."""
    poses = []
    for a, b in itertools.pairwise(corners):
        for s in np.linspace(0, 1, frames + 1)[0 if not poses else 1:]:
            pose = np.eye(4)
            pose[:3, :3] = np.eye(3) if rotation is None else rotation
            pose[:3, 3] = np.asarray(a) + s * (np.asarray(b) - np.asarray(a))
            poses.append(pose)
    return np.array(poses)


def last(particles, probe, poses, friction, **options):
    """Displacements (n, 3) in the last frame, zero for particles at rest."""
    particles = np.atleast_2d(particles).astype(float)
    moved = simulate(particles, probe, poses, friction=friction, **options)
    out = np.zeros_like(particles)
    index, u = moved.frame(moved.frames - 1)
    out[index] = u
    return out


@pytest.mark.parametrize("friction", [0.0, math.inf])
def test_plane_carries_particles_by_its_normal_motion_since_contact(friction):
    particles = np.array([[0, 0, 0.0], [0.01, 0, -0.004], [0, 0.02, -0.02]])
    u = last(particles, Plane(), path((0, 0, 0.013), (0, 0, -0.007), rotation=DOWN), friction)
    expected = np.array([[0, 0, -0.007], [0, 0, -0.003], [0, 0, 0]])
    np.testing.assert_allclose(u, expected, atol=1e-15)


def test_sticking_particle_turns_with_the_probe():
    poses = path((0, 0, 0.03), (0, 0, 0.015))
    turned = poses[-1].copy()
    angle = 0.3
    turned[:3, :3] = Rotation.from_euler("z", angle).as_matrix()
    x0 = np.array([0.004, 0.0, 0.0])
    u = last(x0, Sphere(R), np.concatenate([poses, turned[None]]), math.inf)
    p = np.array([0.004 * math.cos(angle), 0.004 * math.sin(angle), 0.015 - math.sqrt(R**2 - 0.004**2)])
    np.testing.assert_allclose(u, [p - x0], atol=1e-12)


def test_frictionless_sphere_moves_particles_to_its_nearest_surface_point():
    rng = np.random.default_rng(0)
    x0 = rng.uniform([-0.02, -0.02, -0.015], [0.02, 0.02, 0.0], (300, 3))
    centre = np.array([0.003, 0.0, 0.008])
    u = last(x0, Sphere(R), path((0.003, 0, 0.03), centre), 0.0)
    away = x0 - centre
    r = np.linalg.norm(away, axis=1, keepdims=True)
    np.testing.assert_allclose(u, np.where(r < R, away * (R / r - 1), 0.0), atol=1e-11)
    assert (np.linalg.norm(u, axis=1) > 0).sum() > 50


def test_sliding_stops_on_the_edge_of_the_friction_cone():
    mu = 0.4
    # Sphere pressed onto an off-axis particle: the pull leaves the cone, and |u_t| = mu u.n from then on.
    x0 = np.array([0.012, 0.0, 0.0])
    centre = np.array([0, 0, 0.005])
    u = last(x0, Sphere(R), path((0, 0, 0.03), centre), mu)[0]
    n = (x0 + u - centre) / R
    assert np.linalg.norm(n) == pytest.approx(1.0, abs=1e-12)
    tangential = np.linalg.norm(u - (u @ n) * n)
    assert tangential == pytest.approx(mu * (u @ n), rel=1e-9)
    # Closed form: |u_t| = d sin(a), u.n = R - d cos(a) with d = |x0 - c| and a the angle between p and x0.
    d = np.linalg.norm(x0 - centre)
    a = math.asin(mu * R / (d * math.sqrt(1 + mu**2))) - math.atan(mu) if mu > 0 else 0.0
    a = math.pi - math.asin(mu * R / (d * math.sqrt(1 + mu**2))) - math.atan(mu) if a < 0 else a
    assert math.acos(n @ (x0 - centre) / d) == pytest.approx(a, rel=1e-6)


def test_particle_is_let_go_when_its_pull_points_outwards():
    # A sticking particle is dragged sideways by a sphere that then lifts off.
    particle = np.array([[0.0, 0.0, 0.0]])
    poses = path((0, 0, 0.03), (0, 0, 0.015), (0, 0, 0.03))
    moved = simulate(particle, Sphere(R), poses, friction=0.8)
    assert len(moved.frame(5)[0]) == 1
    assert len(moved.frame(moved.frames - 1)[0]) == 0
    for t in range(moved.frames):
        for u in moved.frame(t)[1]:
            np.testing.assert_allclose(u, [0, 0, poses[t, 2, 3] - R], atol=1e-14)


def test_no_particle_is_skipped_at_20_mm_a_frame():
    # One frame above, the next below: a thin plate of 2 mm carries along everything on its way.
    rng = np.random.default_rng(4)
    cloud = rng.uniform([-0.01, -0.01, -0.016], [0.01, 0.01, -0.002], (400, 3))
    u = last(cloud, Box((0.05, 0.05, 0.002)), path((0, 0, 0.001), (0, 0, -0.019), frames=1), 0.3)
    np.testing.assert_allclose(u[:, 2], -0.02 - cloud[:, 2], atol=1e-12)


def field(spacing: float, depth: float, half: float) -> np.ndarray:
    """Cell centres of a uniform grid below z = 0."""
    x = np.arange(-half + spacing / 2, half, spacing)
    z = -np.arange(spacing / 2, depth, spacing)
    return np.stack(np.meshgrid(x, x, z, indexing="ij"), axis=-1).reshape(-1, 3)


def test_sphere_on_a_dense_field_converges_to_the_integral():
    kappa, depth = 1e8, 0.01
    c = R - depth
    # Frictionless, |u| = R - r and u.z = (R - r) cos; over the cap below z = 0, centre at height c.
    total, vertical = (
        kappa * quad(lambda w, k=k: 2 * np.pi * w**k * (_shell(R, 3) - _shell(c / w, 3)), c / R, 1)[0] for k in (0, 1)
    )
    errors = []
    for spacing in (0.002, 0.001, 0.0005):
        grid = field(spacing, depth, 0.02)
        moved = simulate(grid, Sphere(R), path((0, 0, R + 0.001), (0, 0, c)), friction=0.0)
        stiffness = np.full(len(grid), kappa * spacing**3)
        summed = (force_sum_rows(moved, len(grid)) @ stiffness)[-1]
        normal = (normal_force_rows(moved, len(grid), np.array([0, 0, -1.0])) @ stiffness)[-1]
        errors.append([abs(summed / total - 1), abs(normal / vertical - 1)])
    errors = np.array(errors)
    # The integrand vanishes on the sphere, but not on the plane of the grid, so midpoint sums are second order
    # up to the noise of which cells the sphere cuts.
    assert np.all(errors[-1] < 1e-3)
    assert np.all(np.log2(errors[0] / errors[-1]) / 2 > 1.5)


def _shell(r: float, power: int) -> float:
    """Antiderivative of (R - r) r^2 at ``r``."""
    return R * r**power / power - r ** (power + 1) / (power + 1)


def test_unloading_with_friction_and_slip_returns_to_rest_and_is_deterministic():
    grid = field(0.002, 0.015, 0.02)
    poses = path((0, 0, 0.025), (0.004, 0, 0.012), (0, 0, 0.025))
    one, two = (simulate(grid, Sphere(R), poses, friction=0.3) for _ in range(2))
    assert np.diff(one.pointer)[-1] == 0 and np.diff(one.pointer).max() > 50
    assert np.array_equal(one.displacement, two.displacement) and np.array_equal(one.particle, two.particle)
