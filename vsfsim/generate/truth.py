"""The truth of an object view: Young's modulus, the stiffness at surface points, and the oracle VSF."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from vsfsim.core.shape import ProbeShape
from vsfsim.data.records import Touch, Truth, View
from vsfsim.generate.aim import cloud_normals, voxel_sample
from vsfsim.physics.contact.patch import shape_values
from vsfsim.physics.convergence import SAFETY, curve_limit
from vsfsim.physics.model import Model
from vsfsim.vsf.dynamics import simulate_each
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.observe import normal_force_rows
from vsfsim.vsf.particles import bounds_from_view, particles_from_view

PROBE_RADIUS = 0.004  # radius of the disc that models the tip of a small conical probe [m]
PROBE_VOXEL = 0.01  # edge of the voxels that the cloud is down-sampled by, SBML appendix C.4 [m]
VSF_SPACING = 0.005  # spacing of the particles, SBML appendix B.2 for shoes [m]
_GRID = 8  # barycentric points along the edge of a triangle, which spread the disc's pressure over nodes


def probe_stiffness(model: Model, points: np.ndarray, normals: np.ndarray, *, device: str = "cpu") -> np.ndarray:
    """Small-strain stiffness at surface points (k,) [N/m]: force over displacement of a tip of radius `PROBE_RADIUS`.

    A uniform pressure acts on the disc around each point, along minus the normal; the displacement is the
    pressure-weighted mean along the normal. This is the limit for small depth of the force over displacement that SBML
    appendix C.4 measures, for a tip that the mesh resolves.

    Args:
        model: the body.
        points: on its surface (k, 3) [m].
        normals: outward unit normals there (k, 3) [-].
        device: Warp device.
    """
    mesh = model.mesh
    steps = np.array([(i + 1 / 3, j + 1 / 3, _GRID - i - j - 2 / 3) for i in range(_GRID)
                      for j in range(_GRID - i)]) / _GRID
    values = shape_values(steps)
    samples = np.einsum("sa,fac->fsc", values, mesh.points[mesh.faces]).reshape(-1, 3)
    weight = np.repeat(mesh.face_area() / len(steps), len(steps))
    face = np.repeat(np.arange(len(mesh.faces)), len(steps))
    local = np.tile(np.arange(len(steps)), len(mesh.faces))
    tree = cKDTree(samples)
    right = np.zeros((len(model.free), len(points)))
    for k, (point, normal) in enumerate(zip(points, normals, strict=True)):
        near = np.array(tree.query_ball_point(point, PROBE_RADIUS), dtype=int)
        if not len(near):
            near = np.atleast_1d(tree.query(point)[1])
        share = weight[near] / weight[near].sum()
        nodal = np.zeros(len(mesh.points))
        np.add.at(nodal, mesh.faces[face[near]], share[:, None] * values[local[near]])
        right[:, k] = (nodal[:, None] * -normal).ravel() * model.free
    softness = model.factor.softness(right, device)
    # where all nodes under the tip are held, there is no compliance
    return np.where(softness > 0.0, 1.0 / np.where(softness > 0.0, softness, 1.0), np.inf)


def probed_points(view: View) -> tuple[np.ndarray, np.ndarray]:
    """Points of the visible cloud whose stiffness a dataset records, and their normals (k, 3)."""
    cloud = view.points()
    points = voxel_sample(cloud, PROBE_VOXEL)
    return points, cloud_normals(cloud, points, view.camera_pose[:3, 3])


def oracle(particles: np.ndarray, rows: Sequence[sparse.csr_matrix],
           values: Sequence[np.ndarray]) -> dict[str, Any]:
    """The fields of a `Truth` of the papers' particle model, fitted to noise-free readings (zero mean, std 1e4 N/m,
    noise 1e-3).

    Args:
        particles: (n, 3) [m].
        rows: of the readings of each touch, how they depend on the stiffnesses (k, n).
        values: the readings (k,).
    """
    w = sparse.csr_matrix(sparse.vstack([sparse.csr_matrix((0, len(particles))), *rows]))
    fitted = map_estimate(w, np.concatenate([np.zeros(0), *values]), noise_std=1e-3, prior_mean=0.0,
                          prior_var=1e8) if len(particles) else np.zeros(0)
    return {"vsf_points": particles, "vsf_stiffness": fitted, "vsf_touched": np.diff(w.tocsc().indptr) > 0}


def truth_of(model: Model, view: View, touches: list[Touch], probes: Sequence[ProbeShape], *,
             friction: float, device: str, finer: Sequence[Model] = ()) -> Truth:
    """The truth of a solid object's view, which no method may see.

    The oracle VSF is fitted to all converged readings of this view, see `oracle`.

    Args:
        model: the object.
        view: its picture.
        touches: all touches of the view.
        probes: the shape that made each touch.
        friction: Coulomb coefficient between probe and object [-].
        device: Warp device.
        finer: the object on two finer meshes, for the stiffness extrapolated and its error; else that of ``model``.
    """
    mesh, (points, normals) = model.mesh, probed_points(view)
    found = np.stack([probe_stiffness(one, points, normals, device=device) for one in (model, *finer)])
    keep = np.isfinite(found).all(axis=0)
    stiffness, known = found[0, keep], dict[str, Any]()
    if finer and keep.any():
        limit = curve_limit([one.element_size for one in (model, *finer)], found[:, keep], tolerance=1e-6)
        spread = SAFETY * np.ptp(found[:, keep], axis=0)  # where two meshes came out of the same size
        stiffness, known = limit.value, {"probe_error": np.where(np.isfinite(limit.error), limit.error, spread)}
    bounds = bounds_from_view(view, margin=0.01)
    particles = particles_from_view(view, bounds=bounds, spacing=VSF_SPACING)
    moves = [(probe, touch.probe_pose()) for touch, probe in zip(touches, probes, strict=True)]
    moved = simulate_each(particles, moves, friction=friction, device=device)
    rows = [normal_force_rows(way, len(particles), touch.axis)[np.flatnonzero(touch.converged)]
            for touch, way in zip(touches, moved, strict=True)]
    return Truth(
        points=mesh.points[mesh.tets[:, :4]].mean(axis=1), young_modulus=model.young_modulus.mean(axis=1),
        region=np.asarray(model.solid.region), region_names=model.solid.region_names,
        probe_points=points[keep], probe_normals=normals[keep], probe_stiffness=stiffness, **known,
        **oracle(particles, rows, [touch.normal_force()[touch.converged] for touch in touches]))
