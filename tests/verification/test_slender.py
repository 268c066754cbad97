"""Thin plates and slender rods as a scene's default meshing makes them, against plate and beam theory."""

import numpy as np
import pytest
from numpy.polynomial import Polynomial, chebyshev
from scipy.integrate import solve_bvp
from texts import scene

from vsfsim.core.shape import Sphere
from vsfsim.physics import tiers
from vsfsim.physics.solve.touches import Solver

E, DENSITY = 1e6, 1000.0


def clamped(shape, end, *, nu, gravity):
    """A body clamped up to x = ``end``, nothing said about its mesh."""
    fixed = [-1.0, -1.0, -1.0, end + 1e-6, 1.0, 1.0]
    return scene("block", shape=shape, gravity=[0.0, 0.0, -gravity], resolution=None, poisson_ratio=nu, young_modulus=E,
                 density=DENSITY, fixed=fixed, probe=None, press=None).sample(0)


def cantilever_plate(length, width, bending, nu, pressure, *, along=10, across=5):
    """Deflection w(x, y) [m] of a Kirchhoff plate clamped at x = 0, free elsewhere, under uniform ``pressure`` [Pa].

    Ritz's method: w = sum of c x^2 T_i(x) T_j(y), even j, minimises
    D/2 integral of (w_xx + w_yy)^2 - 2 (1 - nu)(w_xx w_yy - w_xy^2) less the work of the pressure (Timoshenko and
    Woinowsky-Krieger, ch. 10).
    """
    terms = [(Polynomial([0, 0, 1]) * Polynomial(chebyshev.cheb2poly([0] * i + [1]))(Polynomial([-1, 2])),
              Polynomial(chebyshev.cheb2poly([0] * j + [1]))) for i in range(along) for j in range(0, 2 * across, 2)]
    x, wx = np.polynomial.legendre.leggauss(along + 4)
    y, wy = np.polynomial.legendre.leggauss(2 * across + 4)
    weight = 0.25 * length * width * np.outer(wx, wy).ravel()

    def values(dx, dy):
        scale = length**dx * (0.5 * width) ** dy
        return np.array([np.outer(p.deriv(dx)(0.5 * x + 0.5), q.deriv(dy)(y)).ravel() / scale for p, q in terms])

    xx, yy, xy, w = values(2, 0), values(0, 2), values(1, 1), values(0, 0)
    stiffness = bending * (((xx + yy) * weight) @ (xx + yy).T - (1 - nu)
                           * ((xx * weight) @ yy.T + (yy * weight) @ xx.T - 2 * (xy * weight) @ xy.T))
    c = np.linalg.solve(stiffness, pressure * (w @ weight))
    return lambda at, side: float(sum(k * p(at / length) * q(2 * side / width) for k,
                                      (p, q) in zip(c, terms, strict=True)))


# at nu = 0.45 thin elements resist the change of curvature through their volume: 1.2 % observed, 0.1 % at 0.3
@pytest.mark.parametrize(("size", "tier", "nu", "clamp"), [
    ((0.06, 0.04, 0.002), "auto", 0.3, 0.0), ((0.06, 0.04, 0.002), "auto", 0.3, 0.0125),
    pytest.param((0.3, 0.2, 0.002), "auto", 0.45, 0.0, marks=pytest.mark.slow),
])
def test_a_clamped_thin_plate_with_default_meshing_bends_as_plate_theory_says(size, tier, nu, clamp):
    """Also clamped over 12.5 mm, where layers of its elements would end before: it bent by 4 % more."""
    length, width, thick = size[0] - clamp, *size[1:]
    gravity = 1e-4  # a deflection of a thousandth of the thickness: theory is linear
    body = clamped(f"{{ box = {list(size)} }}", clamp - 0.5 * size[0], nu=nu, gravity=gravity)
    model = tiers.build(body, tiers.choose(body, tier))
    u = model.factor.solve((model.load * model.free)[:, None]).reshape(-1, 3)
    w = cantilever_plate(length, width, E * thick**3 / (12 * (1 - nu**2)), nu, DENSITY * gravity * thick)
    end = np.abs(model.mesh.points[:, 0] - 0.5 * size[0]) < 1e-9
    for side in (0.0, 0.5 * width):
        there = end & (np.abs(np.abs(model.mesh.points[:, 1]) - side) < 1e-9)
        deflection = -u[there, 2].mean()
        assert deflection == pytest.approx(w(length, side), rel=0.03)
    assert len(model.mesh.tets) <= 16_000


# ------------------------------------------------------------------------------------------ rods

LENGTH, RADIUS = 0.24, 0.003  # 40 times as long as thick
INERTIA, SECTION = np.pi * RADIUS**4 / 4, np.pi * RADIUS**2


@pytest.mark.parametrize("clamp", [0.0, 0.028])
def test_a_slender_rod_under_its_own_weight_is_an_euler_bernoulli_beam(clamp):
    gravity = 1e-5
    body = clamped(f"{{ rod = [{LENGTH}, {RADIUS}] }}", clamp, nu=0.3, gravity=gravity)
    model = tiers.build(body, "fem-coarse")
    u = model.factor.solve((model.load * model.free)[:, None]).reshape(-1, 3)
    tip = -u[np.abs(model.mesh.points[:, 0] - LENGTH) < 1e-9, 2].mean()
    exact = DENSITY * gravity * SECTION * (LENGTH - clamp) ** 4 / (8 * E * INERTIA)
    # shear adds 0.1 % (4 (1 + nu) / k (r / 2 l)^2), the mesh takes 0.5 %
    assert tip == pytest.approx(exact, rel=0.01)


@pytest.mark.slow
def test_a_rod_that_sags_by_five_times_its_thickness_is_the_elastica(line, device):
    """EI theta'' = -q (l - s) cos theta, theta downwards, theta(0) = 0, theta'(l) = 0: q l^3 / EI = 1."""
    load = 1.0
    gravity = load * E * INERTIA / (DENSITY * SECTION * LENGTH**3)
    s = np.linspace(0.0, 1.0, 101)
    found = solve_bvp(lambda t, y: np.array([y[1], -load * (1 - t) * np.cos(y[0])]), lambda a,
                      b: np.array([a[0], b[1]]),
                      s, np.zeros((2, len(s))), tol=1e-8)
    assert found.success
    angle = found.sol(fine := np.linspace(0.0, 1.0, 4001))[0]
    tip = LENGTH * np.array([np.trapezoid(np.cos(angle), fine), -np.trapezoid(np.sin(angle), fine)])
    body = clamped(f"{{ rod = [{LENGTH}, {RADIUS}] }}", 0.0, nu=0.3, gravity=gravity)
    model = tiers.build(body, "fem-coarse")
    solver = Solver(model, Sphere(0.01), device=device, options=tiers.options("fem-coarse"))
    frames = solver.run(line(np.full((1, 3), 10.0), Sphere(0.01)), keep=True)
    end = np.abs(model.mesh.points[:, 0] - LENGTH) < 1e-9
    place = (model.mesh.points + np.asarray(solver.history[0]).reshape(-1, 3))[end].mean(axis=0)
    assert frames.converged.all()
    # the mesh takes 0.5 % (above), the thickness (r / l)^2
    assert place[[0, 2]] - [0.0, RADIUS] == pytest.approx(tip, abs=0.01 * np.abs(tip[1]))
