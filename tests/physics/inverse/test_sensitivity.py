"""Derivatives of forces by the moduli, against central differences, and fits that use them."""

import dataclasses

import numpy as np
import pytest
from texts import scene

from vsfsim.core.shape import Sphere
from vsfsim.physics import tiers
from vsfsim.physics.contact.mount import Mount
from vsfsim.physics.inverse.modulus_fit import Noise, Press, Prior, fit_modulus, press, smooth_basis
from vsfsim.physics.inverse.sensitivity import Sensitivity

SCENE = scene("block", tier='"fem-coarse"', young_modulus=5e4, probe="{ shape = { sphere = 0.015 } }").sample(0)
MODEL = tiers.build(SCENE, "fem-coarse")
LIMITS = dataclasses.replace(tiers.options("fem-coarse"), tolerance=1e-7)
HALF = (MODEL.mesh.points[MODEL.mesh.tets[:, :4]].mean(axis=1)[:, 0] > 0.0).astype(int)
BASIS = np.stack([1 - HALF, HALF], axis=1).astype(float)
PRIOR = Prior(BASIS, np.full(2, np.log(6e4)), np.eye(2))


def model_of(modulus):
    return tiers.model_of(SCENE, "fem-coarse", MODEL.solid, modulus)


def presses():
    """Two of three frames, over one half and, tilted, over the other."""
    out = []
    for x, axis in ((-0.012, [0.0, 0.0, -1.0]), (0.012, [0.2, 0.1, -1.0])):
        axis = np.array(axis) / np.linalg.norm(axis)
        poses = np.tile(np.eye(4), (3, 1, 1))
        for t, depth in enumerate((-0.004, 0.003, 0.006)):
            poses[t, :3, 3] = np.array([x, 0.003, 0.03]) - (0.015 - depth) * axis
        out.append(Press(poses, axis, np.full(3, np.nan), Sphere(0.015), 800.0))
    return out


def forces(theta, spring, near=None):
    made = presses()
    axis, poses = np.stack([p.axis for p in made]), np.stack([p.poses for p in made], axis=1)
    run = Sensitivity(model_of(PRIOR.modulus(theta)), Sphere(0.015), axis, options=LIMITS, near=near)
    frames = run.run(poses, mount=spring and Mount(spring, axis), keep=True)
    assert frames.converged.all()
    return -(frames.force * axis).sum(axis=2), run


@pytest.mark.parametrize("spring", [None, 800.0])
def test_derivatives_are_those_of_central_differences(spring):
    theta, step = np.log([4e4, 9e4]), 1e-3
    value, run = forces(theta, spring)
    slope = np.stack(run.derivative) @ BASIS  # (T, B, 2)
    assert value[-1].min() > 1.5 and np.all(slope[0] == 0.0)
    for part in range(2):
        away = step * np.eye(2)[part]
        central = (forces(theta + away, spring, run)[0] - forces(theta - away, spring, run)[0]) / (2.0 * step)
        # the local indentation, which the derivative holds, follows a probe on a spring
        np.testing.assert_allclose(slope[:, :, part], central, atol=(2e-4 if spring is None else 4e-3) * value.max())


def test_forces_grow_with_all_moduli_alike_on_a_rigid_mount():
    value, run = forces(np.log([4e4, 9e4]), None)
    np.testing.assert_allclose(np.stack(run.derivative).sum(axis=2), value, rtol=1e-4, atol=1e-6)


def test_a_fit_finds_the_moduli_of_two_halves():
    true = np.log([3e4, 1.2e5])
    read = forces(true, 800.0)[0]
    made = [dataclasses.replace(one, force=read[:, k]) for k, one in enumerate(presses())]
    theta, covariance = fit_modulus(model_of, PRIOR, made, LIMITS, Noise(0.01, 0.0))
    np.testing.assert_allclose(theta, true, atol=0.02)
    assert np.all(np.diag(covariance) < 0.01)
    np.testing.assert_allclose(press(model_of(PRIOR.modulus(theta)), made, LIMITS)[0][1], read[:, 1], atol=0.02)
    none, prior_covariance = fit_modulus(model_of, PRIOR, [], LIMITS, Noise(0.01, 0.0))
    assert np.array_equal(none, PRIOR.mean) and np.array_equal(prior_covariance, np.eye(2))


def test_a_smooth_basis_has_the_covariance_of_its_process():
    places = np.random.default_rng(0).uniform(0.0, 0.1, (80, 3))
    basis = smooth_basis(places, reach=0.05, std=0.5)
    square = ((places[:, None] - places[None]) ** 2).sum(axis=2)
    np.testing.assert_allclose(basis @ basis.T, 0.25 * np.exp(-0.5 * square / 0.05**2), atol=0.01)
    assert basis.shape[1] <= 60
