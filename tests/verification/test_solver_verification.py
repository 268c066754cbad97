"""The solver against closed forms: homogeneous states, layers, beams, order of convergence, symmetry."""


import numpy as np
import pytest
from frame_checks import rollers
from scipy.integrate import quad
from scipy.optimize import brentq

from vsfsim.core.shape import Plane, Sphere
from vsfsim.physics.laws.law import lame
from vsfsim.physics.solve.touches import Solver, SolverOptions

TIGHT = SolverOptions(tolerance=1e-7, cg_tolerance=1e-4)


def walls(model, *, all_sides):
    """Rollers (n, 3) of a block: under its base and on two of its sides, or on all four."""
    x = model.mesh.points
    low, high = x.min(axis=0), x.max(axis=0)
    held = np.abs(x - low) < 1e-9
    if all_sides:
        held[:, :2] |= np.abs(x - high)[:, :2] < 1e-9
    return held


def far_away(line, probe, frames=1):
    return line(np.full((frames, 3), 10.0), probe)


# ------------------------------------------------------------------------------------------ homogeneous states (patch
# tests)

SIZE = (0.03, 0.02, 0.025)
# of a block between rollers, confined or not. A free side surface is unstable below a stretch of 0.44 (Biot 1963), so
# homogeneous states beyond are no equilibria that a solver should find
STRETCHES = {True: [0.99, 0.95, 0.85, 0.7], False: [0.99, 0.95, 0.85, 0.7, 0.5]}


def nominal_stress(axial, side, mu, lam):
    """dPsi/d(axial) of the neo-Hookean law (neo_hooke.py) for stretches (side, side, axial)."""
    j = axial * side**2
    return mu * axial + (lam * (j - 1.0) - mu / j) * side**2


def side_stress(axial, side, mu, lam):
    j = axial * side**2
    return mu * side + (lam * (j - 1.0) - mu / j) * axial * side


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45, 0.49])
@pytest.mark.parametrize("confined", [False, True], ids=["uniaxial stress", "uniaxial strain"])
def test_compression_by_a_plane(block, line, device, confined, nu):
    young_modulus = 1e5
    model = block(SIZE, 0.015, young_modulus=young_modulus, poisson_ratio=nu)
    model = rollers(model, walls(model, all_sides=confined))
    mu, lam = (float(v) for v in lame(young_modulus, nu))
    solver = Solver(model, Plane(), device=device, options=TIGHT)
    frames = solver.run(line([[0, 0, SIZE[2] * s] for s in STRETCHES[confined]], Plane()), keep=True)
    assert frames.converged.all()
    for t, s in enumerate(STRETCHES[confined]):
        top = model.mesh.points[:, 2] > SIZE[2] - 1e-9
        shift = solver.history[t].reshape(-1, 3)
        # the penalty lets the plane in by pressure / (1000 E) x element size: the body's own stretch is what counts
        own = 1.0 + shift[top, 2].mean() / SIZE[2]
        assert own == pytest.approx(s, abs=1e-3 * (1.0 - s) * (lam + 2.0 * mu) / young_modulus)
        side = 1.0 if confined else brentq(lambda a, own=own: side_stress(own, a, mu, lam), 0.5, 2.0, xtol=1e-14)
        exact = -nominal_stress(own, side, mu, lam) * SIZE[0] * SIZE[1]
        # the field is homogeneous, which the element holds exactly; left is the solver's tolerance, 1e-7 of unbalanced
        # force, and pressures that differ between triangles of different size, second order in the penetration
        assert frames.force[t, 0] == pytest.approx([0.0, 0.0, exact], rel=2e-6, abs=2e-6 * exact)
        assert frames.min_det_f[t, 0] == pytest.approx(own * side**2, rel=1e-4)
        deformed = model.mesh.points + shift
        corner = model.mesh.points.min(axis=0)
        homogeneous = (model.mesh.points - corner) * [side, side, own] + corner
        assert np.abs(deformed - homogeneous).max() < 1e-6 * SIZE[2]


@pytest.mark.parametrize(("resolution", "contrast"), [(0.01, 1e3), (0.02, 1e8)])
def test_two_layers_are_springs_in_series(block, line, device, resolution, contrast):
    """Heterogeneous E at confined sides: each layer is homogeneous, at any depth and on any mesh, and both carry the
    same closed-form stress."""
    size, soft, stiff, nu = (0.04, 0.04, 0.04), 1e4, 1e4 * contrast, 0.3
    model = block(size, resolution, young_modulus=lambda x: np.where(x[..., 2] > 0.02, soft, stiff), poisson_ratio=nu)
    model = rollers(model, walls(model, all_sides=True))
    frames = Solver(model, Plane(), device=device, options=TIGHT).run(line([[0, 0, 0.039], [0, 0, 0.025]], Plane()))

    def stress(strain, e):
        return -nominal_stress(1.0 - strain, 1.0, *(float(v) for v in lame(e, nu)))

    def left_over(pressure, depth):
        """Depth that is not the shortening of the two layers [m]."""
        return depth - sum(0.02 * brentq(lambda x, e=e: stress(x, e) - pressure, 0.0, 0.99,
                                         xtol=1e-16) for e in (soft, stiff))

    for t, depth in enumerate((0.001, 0.015)):
        exact = brentq(left_over, 0.0, stress(0.98, soft), args=(depth - frames.penetration[t, 0],),
                       xtol=1e-12) * size[0] * size[1]
        # solver tolerance 1e-7, summed over the chain
        assert frames.force[t, 0, 2] == pytest.approx(exact, rel=4e-6)
    assert frames.converged.all()


# ------------------------------------------------------------------------------------------ beams under their own
# weight


def beam(block, line, device, resolution, *, nu, length=0.2, side=0.02, gravity=-1e-3, options=TIGHT):
    """Tip deflection [m] and elastic energy [J] of a cantilever along x."""
    young_modulus, density = 1e6, 1000.0
    # cells of exactly this size: the default meshing gives a thin body two layers, and meshes that do not halve show no
    # order
    long, thick = round(length / resolution), round(side / resolution)
    ticks = (np.linspace(-0.5, 0.5, long + 1) * length, np.linspace(-0.5, 0.5, thick + 1) * side,
             np.linspace(0.0, side, thick + 1))
    model = block((length, side, side), resolution, ticks=ticks, young_modulus=young_modulus,
                  poisson_ratio=nu, density=density, gravity=(0, 0, gravity),
                  fixed=(-0.5 * length - 1e-6, -1, -1, -0.5 * length + 1e-6, 1, 1))
    solver = Solver(model, Sphere(0.01), device=device, options=options)
    frames = solver.run(far_away(line, Sphere(0.01)), keep=True)
    assert frames.converged.all()
    # the supports carry the weight
    assert frames.reaction[0, 0, 2] == pytest.approx(-gravity * density * length * side**2, rel=1e-5)
    end = np.abs(model.mesh.points[:, 0] - 0.5 * length) < 1e-9
    return -solver.history[0].reshape(-1, 3)[end, 2].mean(), frames.energy[0, 0]


@pytest.mark.parametrize("nu", [0.0, 0.3])
def test_cantilever_under_its_own_weight(block, line, device, nu):
    length, side, young_modulus = 0.4, 0.02, 1e6
    tip, _ = beam(block, line, device, 0.01, nu=nu, length=length)
    load, area, inertia = 1e-3 * 1000.0 * side**2, side**2, side**4 / 12
    shear = 10 * (1 + nu) / (12 + 11 * nu)  # Cowper 1966, rectangle
    shear_modulus = young_modulus / (2 * (1 + nu))
    exact = load * length**4 / (8 * young_modulus * inertia) + load * length**2 / (2 * shear * shear_modulus * area)
    # without Poisson's effect the two theories are one (what is left is shear near the clamp); with it the clamped face
    # hinders the section's contraction, which beam theory leaves out: E / (1 - nu^2) over ~0.3 sides of 20, where the
    # moment bends most: 4 * 0.3 / 20 * nu^2 = 0.5 %, and two elements through the thickness cost 0.2 %
    assert tip == pytest.approx(exact, rel=5e-4 if nu == 0.0 else 0.01)


def test_order_of_convergence_where_the_solution_is_smooth(block, line, device):
    """A column between smooth walls under its own weight, E rising smoothly fivefold: the energy's error falls as h^4
    (degree 2)."""
    height, nu, density, g = 0.04, 0.3, 1000.0, 1e-4  # strains of 4e-7: the exact energy is that of small strain

    def modulus(z):
        return 1e4 * np.exp(1.6 * z / height)

    factor = float(lame(1.0, nu)[1] + 2 * lame(1.0, nu)[0])
    # u' = rho g (H - z) / M(z): twice the energy is the work of the weight
    exact = 0.02**2 * quad(lambda z: (density * g * (height - z)) ** 2 / (2 * factor * modulus(z)),
                           0.0, height, epsabs=0, epsrel=1e-12)[0]
    errors = []
    for cells in (2, 4, 8):
        model = block((0.02, 0.02, height), height / cells, young_modulus=lambda x: modulus(x[..., 2]),
                      poisson_ratio=nu, density=density, gravity=(0, 0, -g))
        model = rollers(model, walls(model, all_sides=True))
        options = SolverOptions(tolerance=1e-8, cg_tolerance=1e-6)
        frames = Solver(model, Sphere(0.01), device=device, options=options).run(far_away(line, Sphere(0.01)))
        errors.append(abs(frames.energy[0, 0] / exact - 1.0))
    order = np.log2(np.array(errors[:-1]) / errors[1:])
    # theory: 2 p = 4; integrating a varying modulus with four points keeps it
    assert (order > 3.5).all() and errors[-1] < 1e-5


def test_order_of_convergence_of_a_bent_beam(block, line, device):
    """Bending in three dimensions: differences between successive meshes of the strain energy."""
    energy = [beam(block, line, device, h, nu=0.0, length=0.06)[1] for h in (0.02, 0.01, 0.005)]
    order = np.log2((energy[1] - energy[0]) / (energy[2] - energy[1]))
    assert energy[0] < energy[1] < energy[2], "displacement elements are too stiff: the energy rises to the limit"
    # 4 where all is smooth (above); the edges of a clamped face have mildly singular shear even at nu = 0: 2.57
    # observed here and 2.96 on meshes of half the size (too slow to keep); at nu = 0.3, where the singularity is
    # strong, 1.75
    assert order > 2.4


# ------------------------------------------------------------------------------------------ symmetry and turning


def test_a_turned_scene_gives_the_turned_force(block, line, device):
    rng = np.random.default_rng(0)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    shift = np.array([0.3, -0.1, 0.2])
    probe, slant = Sphere(0.02), np.array([0.4, 0.2, -1.0]) / np.linalg.norm([0.4, 0.2, -1.0])
    start = np.array([-0.006, 0.004, 0.0505])
    way = start + np.array([0.002, 0.004, 0.006])[:, None] * slant
    forces = []
    for r, t in ((np.eye(3), np.zeros(3)), (turn, shift)):
        model = block((0.06, 0.06, 0.03), 0.015, rotation=r, translation=t)
        frames = Solver(model, probe, device=device, options=TIGHT).run(line(way @ r.T + t, probe, r @ slant))
        assert frames.converged.all()
        forces.append(frames.force[:, 0])
    assert np.linalg.norm(forces[0], axis=1).min() > 0.1
    # equilibria of the same tolerance, 1e-7
    assert forces[1] @ turn == pytest.approx(forces[0], abs=1e-5 * np.abs(forces[0]).max())
