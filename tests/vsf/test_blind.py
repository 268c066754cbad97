"""From contact forces to the pose of a buried object, through every estimator (Neural VSF section IV-C): the chain, end
to end."""

import numpy as np
import pytest
import torch
from palpation import palpate
from scipy import sparse
from test_localise import pose, wedge

from vsfsim.core.rotation import pose_errors
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.pose.localise import KnownObject, contact_pose, stiffness_pose
from vsfsim.vsf.sticking import stick

torch.set_num_threads(1)
SOFT, STIFF, SPACING, NOISE = 1e8, 3e9, 0.004, 0.003
THRESHOLD = 6e8  # well above the cover's density
SEEDS = 5  # objects of one run: poses, touches and noise


def make_scene(seed):
    """The object lies 3 mm under the surface of a soft block; the sensor feels about 9 mm of it from above. The seed
    turns the object, places the touches and draws their noise."""
    known = KnownObject.of(*wedge())
    truth = pose(0.9 + 2.4 * seed, [0.005, -0.01, -0.018])

    def field(points):
        inside = known.contains((points - truth[:3, 3]) @ truth[:3, :3])
        return np.where(points[:, 2] > 0.0, 0.0, np.where(inside, STIFF, SOFT))

    touches = palpate(field, touches=60, frames=10, extent=(0.16, 0.16), depth=0.012, noise=NOISE, rings=6,
                      seed=3 + seed)
    axes = [np.arange(-0.1, 0.1, SPACING), np.arange(-0.1, 0.1, SPACING), np.arange(-0.0118, 0.0, 0.5 * SPACING)]
    particles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return known, truth, touches, particles, [stick(particles, t.vertices, t.triangles) for t in touches]


@pytest.fixture(scope="module")
def scenes(trial_seed):
    return [make_scene(seed) for seed in range(SEEDS * trial_seed, SEEDS * (trial_seed + 1))]


def errors(scenes, find):
    """Errors of ``find`` (scene -> pose): shifts [m] and turns [rad], one a scene."""
    found = np.array([pose_errors(find(*scene).transform, scene[1]) for scene in scenes])
    print(f"errors: {np.round(1000 * found[:, 0], 1)} mm, {np.round(np.degrees(found[:, 1]), 1)} degrees")
    return found.T


def of_points(touches, particles, contacts, rows, z, noise):
    """Touched particles and the MAP estimate of the stiffness density there."""
    w = sparse.vstack([rows(contact, touch) for contact, touch in zip(contacts, touches)]).tocsr()
    volume = SPACING**2 * 0.5 * SPACING
    stiffness = map_estimate(w, z, noise_std=noise, prior_mean=SOFT * volume,
                             prior_var=(STIFF * volume) ** 2).mean / volume
    touched = np.diff(w.tocsc().indptr) > 0
    return particles[touched], stiffness[touched]


def by_dense_forces(known, _truth, touches, particles, contacts):
    points, stiffness = of_points(
        touches, particles, contacts,
        lambda c, t: dense_force_rows(c, len(particles), t.triangles, t.vertices.shape[1]),
        np.concatenate([t.force.ravel() for t in touches]), NOISE)
    return stiffness_pose(known, points, stiffness, threshold=THRESHOLD)


def by_pressure(known, _truth, touches, particles, contacts):
    points, stiffness = of_points(
        touches, particles, contacts, lambda c, t: force_sum_rows(c.displacements(), len(particles)),
        np.concatenate([np.linalg.norm(t.force.sum(axis=1), axis=1) for t in touches]), 12.0 * NOISE)
    return stiffness_pose(known, points, stiffness, threshold=np.quantile(stiffness, 0.7))


def by_contact_points(known, _truth, touches, _particles, _contacts):
    reached = [t.vertices[-1][np.linalg.norm(t.force[-1], axis=1) > 0.15] for t in touches]
    return contact_pose(known, np.concatenate(reached))


@pytest.mark.slow
def test_dense_forces_on_particles_find_it_and_the_papers_baselines_do_not(scenes):
    shift, turn = errors(scenes, by_dense_forces)
    # Eleven seeds: 0.8 to 10.3 mm and 1.5 to 9.7 degrees, with standard deviations of 3.1 mm and 2.6 degrees about 3.8
    # mm and 4.0 degrees; the medians of five are 2.1 and 2.0 mm. With 10 tries instead of the default 40 every third
    # object is turned over, 120 degrees and more.
    assert shift.max() < 0.016 and np.degrees(turn).max() < 15.0
    assert np.median(shift) < 0.005
    # The pressure alone: 12 to 172 degrees, in the median of eleven 26. The places of the contacts: 110 to 179.
    assert np.median(errors(scenes, by_pressure)[1]) > 2.0 * np.median(turn)
    assert np.median(errors(scenes, by_contact_points)[1]) > np.radians(60.0)
