"""Observation matrices against the elastic energy's derivative and each other, and the sticking that feeds them."""

import math

import numpy as np
import pytest

from vsfsim.core.shape import Sphere
from vsfsim.vsf.dynamics import simulate
from vsfsim.vsf.observe import dense_force_rows
from vsfsim.vsf.sticking import stick


def plate(count=9, size=0.04):
    """A flat square of triangles in z = 0, outer side down, and its triangles."""
    x = np.linspace(-size / 2, size / 2, count)
    vertices = np.stack([*np.meshgrid(x, x, indexing="ij"), np.zeros((count, count))], axis=-1).reshape(-1, 3)
    i = np.arange(count * count).reshape(count, count)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return vertices, np.concatenate([np.stack([a, c, b], axis=1), np.stack([a, d, c], axis=1)])


def grid(low, high, spacing):
    axes = [np.arange(a + 0.31 * spacing, b, spacing) for a, b in zip(low, high)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def test_dense_forces_are_the_derivative_of_the_springs_energy():
    base, triangles = plate()
    vertices = base + np.linspace(0.004, -0.01, 8)[:, None, None] * [0.0, 0.0, 1.0]
    rng = np.random.default_rng(0)
    # a surface that bends as it goes
    vertices = vertices + 0.002 * np.linspace(0, 1, 8)[:, None, None] * rng.normal(size=base.shape)
    particles = grid([-0.015, -0.015, -0.02], [0.015, 0.015, 0.0], 0.004)
    k = rng.uniform(10, 100, len(particles))
    contacts = stick(particles, vertices, triangles)
    w = dense_force_rows(contacts, len(particles), triangles, len(base))
    force = (w @ k).reshape(8, len(base), 3)
    t = 7
    part = slice(contacts.pointer[t], contacts.pointer[t + 1])
    index, corner, weight = contacts.particle[part], triangles[contacts.triangle[part]], contacts.weight[part]
    assert len(index) > 50

    def energy(v):
        u = np.einsum("kj,kji->ki", weight, v[corner]) - particles[index]
        return 0.5 * np.sum(k[index] * np.sum(u * u, axis=1))

    for vertex in np.unique(corner)[::7]:
        for axis in range(3):
            step = np.zeros_like(base)
            step[vertex, axis] = 1e-6
            slope = (energy(vertices[t] + step) - energy(vertices[t] - step)) / 2e-6
            assert force[t, vertex, axis] == pytest.approx(-slope, rel=1e-6, abs=1e-9)
    # Together they are the force of all springs.
    np.testing.assert_allclose(force[t].sum(axis=0), -(k[index, None] * contacts.displacement[part]).sum(axis=0),
                               rtol=1e-10)
    assert np.diff(w.tocsc().indptr).max() <= 9 * 8


def test_a_rigid_sphere_of_triangles_moves_particles_like_the_exact_sphere():
    # Latitude-longitude sphere, fine; sticking of both models is the same law.
    rings, around, radius = 40, 80, 0.02
    polar, azimuth = np.linspace(0.02, np.pi - 0.02, rings), np.arange(around) * 2 * np.pi / around
    base = radius * np.stack([np.sin(polar)[:, None] * np.cos(azimuth), np.sin(polar)[:, None] * np.sin(azimuth),
                              np.broadcast_to(np.cos(polar)[:, None], (rings, around))], axis=-1).reshape(-1, 3)
    i = np.arange(rings * around).reshape(rings, around)
    a, b, c, d = i[:-1], np.roll(i, -1, axis=1)[:-1], np.roll(i, -1, axis=1)[1:], i[1:]
    triangles = np.concatenate([np.stack([x.ravel() for x in t], axis=1) for t in ((a, d, c), (a, c, b))])
    centre = np.linspace([0, 0, 0.022], [0.003, 0, 0.012], 11)
    particles = grid([-0.02, -0.02, -0.01], [0.02, 0.02, 0.0], 0.0023)
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, :3, 3] = centre
    exact = simulate(particles, Sphere(radius), poses, friction=math.inf)
    ours = stick(particles, base + centre[:, None], triangles)
    (p0, u0), (p1, u1) = exact.frame(10), ours.frame(10)
    both, at0, at1 = np.intersect1d(p0, p1, return_indices=True)
    assert len(both) > 0.95 * max(len(p0), len(p1))
    # The triangles lie up to 0.03 mm inside the sphere.
    np.testing.assert_allclose(u1[at1], u0[at0], atol=2e-4)
    assert np.abs(u1[at1] - u0[at0]).mean() < 5e-5


def test_nothing_sticks_where_there_is_nothing():
    base, triangles = plate(3)
    assert len(stick(np.zeros((0, 3)), base[None], triangles).particle) == 0
    assert stick(np.zeros((1, 3)), np.zeros((0, 9, 3)), triangles).pointer.tolist() == [0]
