"""Shallow contact: the force of S1's ball at six places within an element, on meshes that do not know where."""

import dataclasses

import numpy as np
import pytest

import references
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.physics import tiers
from vsfsim.physics.model import build_model
from vsfsim.physics.solve.touches import Solver

PLACES = np.array([(0.0, 0.0), (0.5, 0.0), (0.25, 0.25), (0.5, 0.5), (0.2, 0.4), (0.35, 0.1)])
"""Places of the ball's axis from a corner of an element (6, 2), over the element's edge [-]."""
DEPTHS = (0.0005, 0.001, 0.0025, 0.005)


def pressed(model, probe, at, depths, *, by_place=True, device="cpu"):
    """Forces (t, k) [N] on a ball that is pressed into a block at ``at`` (k, 2) [m], to ``depths`` (t,) [m]."""
    poses = np.tile(np.eye(4), (len(depths), len(at), 1, 1))
    poses[:, :, :2, 3] = at
    poses[:, :, 2, 3] = (model.mesh.points[:, 2].max() + probe.radius - np.asarray(depths))[:, None]
    options = dataclasses.replace(tiers.options("fem"), indentation_by_place=by_place)
    frames = Solver(model, probe, device=device, options=options).run(poses)
    assert frames.converged.all()
    return frames.force[:, :, 2]


def worst(resolution, places=PLACES):
    """Largest error at each of `DEPTHS` of S1's ball; ``resolution`` [m]."""
    scene = load_scene(find_scene("indent-homogeneous")).sample(0)
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.object, resolution=resolution))
    model = tiers.build(scene, "fem")
    points, curve = model.mesh.points, references.load("s1")
    top = np.flatnonzero((points[model.mesh.faces][:, :, 2] > points[:, 2].max() - 1e-9).all(axis=1))
    middle = np.linalg.norm(points[model.mesh.faces[top]].mean(axis=1)[:, :2], axis=1).argmin()
    edge = float(np.sqrt(2.0 * model.mesh.face_area()[top[middle]]))
    exact = np.interp(DEPTHS, curve["depth_m"], curve["force_N"])[:, None]
    return np.abs(pressed(model, scene.probe, edge * places, DEPTHS) / exact - 1.0).max(axis=1)


@pytest.mark.slow
def test_elements_of_ten_millimetres():
    """Observed 4.0, 3.4, 0.9 and 1.0 %; 5.1, 5.9, 1.1 and 1.3 % by the mean of places, 37 to 70 % at 0.5 mm and 37 % at
    1 mm without any local indentation. At three of the six places, among which are the worst of each depth."""
    assert (worst(0.010, PLACES[[0, 2, 3]]) < [0.10, 0.05, 0.02, 0.02]).all()


def test_elements_of_more_than_half_the_balls_radius():
    """Observed 1.9, 0.8, 1.9 and 1.6 % on elements of 12.5 mm, where the contact radius is a quarter to four fifths of
    an element; 17, 15, 3.3 and 2.1 % by the mean of places."""
    assert (worst(0.0145) < [0.10, 0.05, 0.02, 0.02]).all()


@pytest.mark.slow
def test_an_irregular_mesh_at_random_places(device):
    """S1 on a mesh of 12.5 mm whose vertices lie up to a fifth of a cell from a grid, at twelve places.

    Observed 2.6 % at 0.5 mm and 1.7 % at 1 mm; 18 and 21 % by the mean of places.
    """
    scene = load_scene(find_scene("indent-homogeneous")).sample(0)
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.object, resolution=0.0145))
    solid, modulus = tiers.body(scene, "fem")
    rng, low, high = np.random.default_rng(1), solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    free = (solid.vertices > low + 1e-9) & (solid.vertices < high - 1e-9)
    moved = solid.vertices + free * rng.uniform(-0.0025, 0.0025, solid.vertices.shape)
    model = build_model(dataclasses.replace(solid, vertices=moved), modulus, poisson_ratio=0.45,
                        fixed="bottom", bottom_tolerance=1e-6, where="test")
    depths, curve = np.array([0.0005, 0.001]), references.load("s1")
    exact = np.interp(depths, curve["depth_m"], curve["force_N"])[:, None]
    at = rng.uniform(-0.015, 0.015, (12, 2))
    place, mean = (np.abs(pressed(model, scene.probe, at, depths, by_place=by_place, device=device) / exact - 1.0)
                   for by_place in (True, False))
    assert place.max() < 0.05 and (mean.max(axis=1) > 0.1).all()
