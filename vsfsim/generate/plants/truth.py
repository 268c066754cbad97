"""The truth of a plant: modulus and section of every segment, stiffness at visible points, and the papers' particle
model fitted to all torques."""

from __future__ import annotations

import numpy as np

from vsfsim.core.chain import Chain
from vsfsim.data.records import Touch, Truth, View
from vsfsim.generate.truth import oracle, probed_points
from vsfsim.physics.rods.model import RodModel
from vsfsim.vsf.observations import arm_torque_rows_each
from vsfsim.vsf.particles import bounds_from_view, particles_from_view

# twice the spacing of SBML appendix B.2, 10 mm, because the oracle is fitted for every view of every dataset [m]
VSF_SPACING = 0.02
FITTED_FRAMES = 40  # frames of a touch that the oracle is fitted to, evenly spread


def nearest_material_points(model: RodModel, points: np.ndarray) -> tuple[np.ndarray, np.ndarray,
                                                                          np.ndarray, np.ndarray]:
    """The points of the plant's surface nearest to ``points`` (k, 3) [m].

    Returns:
        The segment of each (k,), its place along the segment from 0 to 1 (k,), its offset from the segment's middle
        line (k, 3) [m], and its distance from the given point (k,) [m].
    """
    plant = model.plant
    a, b = plant.nodes[plant.parent[1:]], plant.nodes[1:]
    along = b - a
    best = np.full(len(points), np.inf)
    segment, place, offset = np.ones(len(points), int), np.zeros(len(points)), np.zeros((len(points), 3))
    for i in range(1, len(plant.nodes)):
        s = np.clip((points - a[i - 1]) @ along[i - 1] / (along[i - 1] @ along[i - 1]), 0.0, 1.0)
        out = points - a[i - 1] - s[:, None] * along[i - 1]
        side = np.zeros_like(out)
        if plant.half_width[i] > 0.0:
            width = model.frame[i][:, 1]
            side = np.clip(out @ width, -plant.half_width[i], plant.half_width[i])[:, None] * width
        gap = np.abs(np.linalg.norm(out - side, axis=1) - plant.radius[i])
        better = gap < best
        best[better], segment[better], place[better], offset[better] = gap[better], i, s[better], side[better]
    return segment, place, offset, best


def plant_truth(model: RodModel, view: View, touches: list[Touch], chain: Chain, *, friction: float,
                device: str) -> Truth:
    """The truth of a plant's view, which no method may see.

    ``probe_stiffness`` is the force along minus the visible normal over the displacement of the material point there,
    at rest. The oracle VSF is fitted to the torques of this view's converged frames, see `oracle`.

    Args:
        model: the plant as beams.
        view: its picture.
        touches: all touches of the view.
        chain: the arm as a method sees it.
        friction: Coulomb coefficient between arm and plant [-].
        device: Warp device.
    """
    points, normals = probed_points(view)
    segment, along, offset, away = nearest_material_points(model, points)
    stiffness = model.point_stiffness(segment, along, offset, normals)
    keep = np.isfinite(stiffness) & (away < 0.01)
    bounds = bounds_from_view(view, margin=0.01)
    particles = particles_from_view(view, bounds=bounds, spacing=VSF_SPACING, tolerance=0.5 * VSF_SPACING)
    some = [np.unique(np.rint(np.linspace(0, len(touch.time) - 1, FITTED_FRAMES)).astype(int)) for touch in touches]
    joints = [touch.q[k] for touch, k in zip(touches, some, strict=True) if touch.q is not None]
    found = arm_torque_rows_each(particles, chain, joints, friction=friction, device=device, max_step=4e-3)
    rows, values = [], []
    for touch, k, w in zip(touches, some, found, strict=True):
        assert touch.torque is not None
        good = touch.converged[k]
        rows.append(w[np.flatnonzero(np.repeat(good, chain.dof))])
        values.append(touch.torque[k][good].ravel())
    plant = model.plant
    ends = np.stack([plant.nodes[plant.parent[1:]], plant.nodes[1:]], axis=1)
    return Truth(points=ends.mean(axis=1), young_modulus=plant.young_modulus[1:],
                 region=plant.region[1:].astype(np.int64), region_names=plant.region_names,
                 radius=plant.radius[1:], half_width=plant.half_width[1:], segment_ends=ends,
                 probe_points=points[keep], probe_normals=normals[keep], probe_stiffness=stiffness[keep],
                 notes=plant.notes if plant.name else None, **oracle(particles, rows, values))
