"""What the particle model and its estimates refuse: each mistake is named, and what would do."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import sparse

from vsfsim.bench.mock import camera_view, particles
from vsfsim.core.errors import VsfError
from vsfsim.core.shape import Sphere
from vsfsim.vsf.dynamics import simulate
from vsfsim.vsf.estimate.evidence import Evidence
from vsfsim.vsf.estimate.kalman import DiagonalFilter
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.features.registry import particle_features
from vsfsim.vsf.fields.line_integrals import SurfaceTouch, dome
from vsfsim.vsf.fields.neural import Fitting, fit
from vsfsim.vsf.meta.calibration import Held, Level, Missed, Width
from vsfsim.vsf.meta.composition import Composition
from vsfsim.vsf.meta.prior import MetaPrior, Spread, train
from vsfsim.vsf.observe import normal_force_rows
from vsfsim.vsf.particles import particles_from_view
from vsfsim.vsf.pose import KnownObject, stiffness_pose
from vsfsim.vsf.sticking import stick

PLACE, NOWHERE, POSE, WEIGHTS = np.zeros((1, 3)), np.full((1, 3), np.nan), np.eye(4)[None], np.ones((3, 5))
BOX = np.array([[0, 0, 0], [0.1, 0.1, 0.1]])
TETRAHEDRON = np.concatenate([PLACE, np.eye(3)]), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
SKIN = np.eye(3)[None], np.array([[0, 1, 2]])
SILENT = SurfaceTouch(np.stack([dome(rings=3)[0]] * 2), dome(rings=3)[1], np.zeros((2, *dome(rings=3)[0].shape)))


def moved(place=PLACE, poses=POSE, friction=0.5, **more):
    return simulate(place, Sphere(0.02), poses, friction=friction, **more)


def estimated(w=WEIGHTS, z=WEIGHTS[:, 0], **more):
    return map_estimate(w, z, **{"noise_std": 1.0, "prior_mean": 1.0, "prior_var": 1.0, **more})


def prior(**more):
    return MetaPrior(4, shared=False, **{"spread": Spread(1.0, 1.0), **more})


def filtered(z=1.0, particles=2):
    DiagonalFilter.start(2, mean=0.0, var=1.0).update(sparse.csr_matrix(np.ones((1, particles))), np.array([z]),
                                                      noise_std=1.0)


def seen(name, place=None, **view):
    return particle_features(name, dataclasses.replace(camera_view(), **view), particles() if place is None else place,
                             spacing=0.005)


@pytest.mark.parametrize(("call", "words"), [
    (lambda: moved(NOWHERE), "finite"), (lambda: moved(np.zeros((3, 2))), r"\(3, 2\)"),
    (lambda: moved(poses=np.eye(4)), r"\(T, 4, 4\)"), (lambda: moved(poses=np.diag([2.0, 1, 1, 1])[None]), "rigid"),
    (lambda: moved(friction=-0.1), "-0.1"), (lambda: moved(friction=math.nan), "nan"),
    (lambda: moved(max_step=0.0), "max_step"),
    (lambda: normal_force_rows(moved(), 9, np.array([0.0, 0.0, 2.0])), "unit vector .*or one a frame"),
    (lambda: stick(NOWHERE, *SKIN), "must be finite"), (lambda: stick(PLACE, SKIN[0], SKIN[1] + 1), "name vertex 3"),
    (lambda: particles_from_view(camera_view(), bounds=-BOX), "upper corner"),
    (lambda: particles_from_view(camera_view(), bounds=BOX, spacing=0.0), "spacing"),
    (lambda: particles_from_view(camera_view(), bounds=BOX, spacing=1e-5), "Is the spacing in metres"),
    (lambda: estimated(z=np.ones(4)), r"\(4,\)"), (lambda: estimated(z=np.array([1, np.nan, 1])), "z has 1 values"),
    (lambda: estimated(np.full((3, 5), np.inf)), "W has 15"), (lambda: estimated(noise_std=0.0), "goes down to 0"),
    (lambda: estimated(noise_std=np.ones(5)), r"noise_std has shape \(5,\)"),
    (lambda: estimated(prior_var=-1.0), "prior_var goes down to -1"),
    (lambda: estimated(prior_mean=np.full(5, np.nan)), "prior_mean has 5"),
    (lambda: filtered(particles=3), "W is 1 x 3 for 1 readings and 2 particles"),
    (lambda: filtered(math.nan), "leave the frame out"),
    (lambda: DiagonalFilter.start(2, mean=0.0, var=0.0), "greater than 0"),
    (lambda: Evidence.of(sparse.csr_matrix(WEIGHTS), np.ones(4), noise_std=1.0), "must fit"),
    (lambda: Evidence.of(sparse.csr_matrix(WEIGHTS), np.full(3, np.nan), noise_std=1.0), "finite"),
    (lambda: Evidence.of(sparse.csr_matrix(WEIGHTS), np.ones(3), noise_std=0.0), "noise_std greater than 0"),
    (lambda: Composition.of("HE", np.zeros((0, 3))), "0 particles"),
    (lambda: Composition.of("HE+SEC", np.ones((2, 3))), r"Did you mean 'HE\+SEG'"),
    (lambda: prior(output="relu6"), "output is 'relu6'"), (lambda: prior(second="var"), "second is 'var'"),
    (lambda: prior(spread=Spread(1.0, 0.0)), "training spread 0"),
    (lambda: train(prior(), [], []), "no touch of a training object"),
    (lambda: Level.of([Held(np.ones(3), np.zeros((3, 3)))]), "that a touched particle explains"),
    (lambda: Width.of([Missed(np.zeros(3), np.ones(3), np.ones(3))]), "no reading of a training object is missed"),
    (lambda: seen("locul"), "the name is 'locul'.*Did you mean 'local'"),
    (lambda: seen("local", np.zeros((0, 3))), "at least one world position"),
    (lambda: seen("local", mask=np.zeros_like(camera_view().mask)), "mask is empty"),
    (lambda: fit("nerf", [], BOX), "no touch with contact forces"), (lambda: fit("hash", [SILENT], BOX), "no field"),
    (lambda: fit("grid", [SILENT], BOX, Fitting(iterations=1)), "all zero"),
    (lambda: stiffness_pose(KnownObject.of(*TETRAHEDRON), np.zeros((50, 3)), np.full(50, 3.0), threshold=10.0),
     "lower the threshold .the stiffest has 3"),
    (lambda: KnownObject.of(TETRAHEDRON[0], TETRAHEDRON[1][:-1]), "not closed"),
    (lambda: KnownObject.of(np.zeros((3, 3)), np.zeros((0, 3), int)), "no triangle")])
def test_a_mistake_is_named(call, words):
    with pytest.raises(VsfError, match=words):
        call()
