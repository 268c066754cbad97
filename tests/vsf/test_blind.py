"""From contact forces to the pose of a buried object, through every estimator (Neural VSF section IV-C): the chain, end
to end."""

import numpy as np
import pytest
import torch
from scipy import sparse
from test_localise import pose, wedge

from vsfsim.core.rotation import pose_errors
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.fields.neural import Fitting, density, fit
from vsfsim.vsf.fields.palpation import palpate
from vsfsim.vsf.observe import dense_force_rows, force_sum_rows
from vsfsim.vsf.pose.localise import KnownObject, contact_pose, stiffness_pose
from vsfsim.vsf.sticking import stick

torch.set_num_threads(1)
SOFT, STIFF, SPACING, NOISE = 1e8, 3e9, 0.004, 0.003
THRESHOLD = 6e8  # well above the cover's density


@pytest.fixture(scope="module")
def scene(trial_seed):
    """The object lies 3 mm under the surface of a soft block; the sensor feels about 9 mm of it from above. The seed
    turns the object, places the touches and draws their noise."""
    known = KnownObject.of(*wedge())
    truth = pose(0.9 + 2.4 * trial_seed, [0.005, -0.01, -0.018])

    def field(points):
        inside = known.contains((points - truth[:3, 3]) @ truth[:3, :3])
        return np.where(points[:, 2] > 0.0, 0.0, np.where(inside, STIFF, SOFT))

    touches = palpate(field, touches=60, frames=10, extent=(0.16, 0.16), depth=0.012, noise=NOISE, rings=6,
                      seed=3 + trial_seed)
    axes = [np.arange(-0.1, 0.1, SPACING), np.arange(-0.1, 0.1, SPACING), np.arange(-0.0118, 0.0, 0.5 * SPACING)]
    particles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return known, truth, touches, particles, [stick(particles, t.vertices, t.triangles) for t in touches]


def errors(scene, found):
    shift, turn = pose_errors(found.transform, scene[1])
    print(f"errors: {1000 * shift:.1f} mm, {np.degrees(turn):.1f} degrees")
    return shift, turn


def point_estimate(scene, w, z, noise):
    _known, _, _, particles, _contacts = scene
    volume = SPACING**2 * 0.5 * SPACING
    stiffness = map_estimate(w, z, noise_std=noise, prior_mean=SOFT * volume,
                             prior_var=(STIFF * volume) ** 2).mean / volume
    touched = np.diff(w.tocsc().indptr) > 0
    return particles[touched], stiffness[touched]


@pytest.mark.slow
def test_dense_forces_on_particles_find_it(scene):
    known, _, touches, particles, contacts = scene
    w = sparse.vstack([dense_force_rows(c, len(particles), t.triangles, t.vertices.shape[1]) for c,
                       t in zip(contacts, touches)]).tocsr()
    points, stiffness = point_estimate(scene, w, np.concatenate([t.force.ravel() for t in touches]), NOISE)
    shift, turn = errors(scene, stiffness_pose(known, points, stiffness, threshold=THRESHOLD))
    # 1.9 mm and 3.6 degrees. Of three seeds of the registration one ends turned over; the papers take the best of 40.
    assert shift < 0.006 and turn < 0.15


@pytest.mark.slow
def test_the_fast_continuous_field_finds_it(scene):
    known, _, touches, particles, contacts = scene
    bounds = np.array([[-0.1, -0.1, -0.014], [0.1, 0.1, 0.002]])
    model = fit("grid", touches, bounds, Fitting(iterations=600, samples=25, rate=3e-2, free_space=1e-3), cell=SPACING)
    touched = np.unique(np.concatenate([c.particle for c in contacts]))
    # A smooth field has no sharp step at the object's border: the threshold is lower, still four times the cover's
    # density.
    shift, turn = errors(scene, stiffness_pose(known, particles[touched], density(model, particles[touched]),
                                               threshold=4e8, tries=16))
    # Blurred over cells of 4 mm, on an object of which 9 mm are felt: a turned pose may explain the field better than
    # the true one (a loss of 2.9e10 against 5.5e10 at 31 degrees; 5 degrees with seed 1 of the touches), so the turn
    # only excludes an object turned over. The shift was 1.8 and 2.0 mm.
    assert shift < 0.006 and turn < 0.8


@pytest.mark.slow
def test_pressure_alone_and_contact_points_are_the_weaker_baselines_but_run(scene):
    known, _, touches, particles, contacts = scene
    w = sparse.vstack([force_sum_rows(c.displacements(), len(particles)) for c in contacts]).tocsr()
    z = np.concatenate([np.linalg.norm(t.force.sum(axis=1), axis=1) for t in touches])
    points, stiffness = point_estimate(scene, w, z, NOISE * 12)
    assert errors(scene, stiffness_pose(known, points, stiffness, threshold=np.quantile(stiffness, 0.7)))[0] < 0.05
    reached = [t.vertices[-1][np.linalg.norm(t.force[-1], axis=1) > 0.15] for t in touches]
    assert errors(scene, contact_pose(known, np.concatenate(reached)))[0] < 0.05
