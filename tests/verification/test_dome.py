"""A thin dome against the closed form of a shallow shell."""

import numpy as np
import pytest

from vsfsim.core.shape import Sphere
from vsfsim.core.solid import Solid
from vsfsim.physics.mesh.quadratic import gauss_points
from vsfsim.physics.mesh.structured import box
from vsfsim.physics.model import build_model
from vsfsim.physics.solve.touches import Solver, SolverOptions

NU = 0.3


@pytest.mark.slow
def test_a_dome_of_one_millimetre_is_reissners_shallow_shell(line, device):
    """The stiffness of the top of a spherical cap, 1 mm thick at a radius of 50 mm, under a small ball, against the
    point load of E. Reissner (J. Math. Phys. 25, 1946), F / w = 4 E t^2 / (R sqrt(3 (1 - nu^2)))."""
    thick, radius, length, young_modulus = 0.001, 0.05, 0.05, 1e7
    flat, tets = box((length, length, thick), 0.00125)
    arc = np.hypot(flat[:, 0], flat[:, 1])
    ring = (radius - 0.5 * thick + flat[:, 2]) * np.array([np.sin(arc / radius), np.cos(arc / radius)])
    cap = np.column_stack([flat[:, :2] / np.maximum(arc, 1e-12)[:, None] * ring[0][:, None], ring[1]])
    solid = Solid(cap, tets, np.zeros(len(tets), int), ("dome",))
    rim = cap[np.abs(flat[:, :2]).max(axis=1) > 0.5 * length - 1e-9, 2].max()
    model = build_model(solid, np.full(gauss_points(solid).shape[:2], young_modulus),
                        poisson_ratio=NU, fixed=(-1.0, -1.0, -1.0, 1.0, 1.0, float(rim) + 1e-6),
                        bottom_tolerance=1e-9, where="test")
    ball = Sphere(0.005)
    depth = np.array([2e-5, 5e-5, 1e-4])
    frames = Solver(model, ball, device=device, options=SolverOptions(tolerance=1e-4, seconds=1e9)).run(
        line([[0.0, 0.0, cap[:, 2].max() + ball.radius - d] for d in depth], ball))
    assert frames.converged.all()
    # the first contact of facets is uncertain by micrometres, so slopes are compared; from 0.1 of the thickness on a
    # dome softens. When this was written they were 490 and 470 N/m.
    slope = np.diff(frames.force[:, 0, 2]) / np.diff(depth)
    assert slope == pytest.approx(4.0 * young_modulus * thick**2 / (radius * np.sqrt(3.0 * (1.0 - NU**2))), rel=0.06)
