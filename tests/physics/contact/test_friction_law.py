"""The regularised law of friction at single points: its energy is the work of its force, from stick through slip."""

import numpy as np
import pytest
import warp as wp

from vsfsim.physics.contact import friction

STIFFNESS, LIMIT = 2.0e4, 3.0
WAYS = np.linspace(0.0, 6.0 * LIMIT / STIFFNESS, 2401)  # slip begins at a sixth of the way


@wp.kernel(module="unique")
def ask(ways: wp.array(dtype=wp.float64), stiffness: wp.float64, limit: wp.float64, energy: wp.array(dtype=wp.float64),
        force: wp.array(dtype=wp.vec3d)):
    k = wp.tid()
    energy[k] = friction.energy(ways[k], stiffness, limit)
    force[k] = friction.force(ways[k] * wp.vec3d(wp.float64(0.6), wp.float64(0.8), wp.float64(0.0)), stiffness, limit)


@pytest.fixture(scope="module")
def law():
    energy, force = wp.zeros(len(WAYS), dtype=wp.float64), wp.zeros(len(WAYS), dtype=wp.vec3d)
    wp.launch(ask, len(WAYS), [wp.array(WAYS, dtype=wp.float64), STIFFNESS, LIMIT, energy, force])
    return energy.numpy(), force.numpy()


def test_the_force_is_coulombs(law):
    _, force = law
    expected = np.minimum(STIFFNESS * WAYS, LIMIT)
    np.testing.assert_allclose(force, expected[:, None] * [0.6, 0.8, 0.0], atol=1e-12 * LIMIT)


def test_the_energy_is_the_work_of_the_force(law):
    """By the trapezoidal rule, which is exact on both branches; the kink lies on a point of the grid."""
    energy, force = law
    size = np.linalg.norm(force, axis=1)
    work = np.concatenate([[0.0], np.cumsum(0.5 * np.diff(WAYS) * (size[1:] + size[:-1]))])
    np.testing.assert_allclose(energy, work, atol=1e-12 * work[-1])
    assert energy[-1] == pytest.approx(LIMIT * WAYS[-1] - 0.5 * LIMIT**2 / STIFFNESS)
