"""The ends of what a scene may ask: contrast, Poisson's ratio, stiffness, depth, bad meshes, weight. Every frame
converges or says why not."""


import numpy as np
import pytest
from frame_checks import from_above, numbers_stand_for_equilibria, rollers

from vsfsim.core.shape import Plane, Sphere
from vsfsim.core.solid import Solid, smallest_sine
from vsfsim.generate.record import REASONS
from vsfsim.physics.mesh.quadratic import gauss_points
from vsfsim.physics.mesh.structured import box
from vsfsim.physics.model import build_model
from vsfsim.physics.solve.frames import OF_AN_EQUILIBRIUM, Reason
from vsfsim.physics.solve.touches import Solver, SolverOptions
from vsfsim.robot.path import turn_to

SIZE = (0.06, 0.06, 0.03)
PROBE = Sphere(0.015)


def body(modulus=lambda x: np.full(x.shape[:-1], 1e5), *, nu=0.3, solid=None, resolution=0.015, **more):
    if solid is None:
        vertices, tets = box(SIZE, resolution)
        solid = Solid(vertices, tets, np.zeros(len(tets), int), ("body",))
    return build_model(solid, modulus(gauss_points(solid)), poisson_ratio=nu, fixed="bottom", bottom_tolerance=1e-9,
                       where="test", **more)


def inclusion(contrast, young_modulus=1e5):
    """A cube of other stuff in the middle of the base, decided element by element."""
    def modulus(x):
        centre = np.broadcast_to(x.mean(axis=1, keepdims=True), x.shape)
        inside = (np.abs(centre[..., :2]) < 0.015).all(axis=-1) & (centre[..., 2] < 0.015)
        return young_modulus * np.where(inside, contrast, 1.0)

    return modulus


def press(model, depths, device, *, linear=False, **limits):
    """Frames at ``depths`` (parts of the thickness), which hold what every run must hold, whether it converged or
    not."""
    poses = np.tile(np.eye(4), (len(depths), 1, 1, 1))
    # off the planes of symmetry, so that nothing cancels
    poses[:, 0, :3, 3] = np.array([0.003, 0.001, SIZE[2] + 0.015]) - np.asarray(depths)[:, None] * [0.0, 0.0, SIZE[2]]
    options = SolverOptions(**{"seconds": 1e9, **limits})
    frames = Solver(model, PROBE, device=device, linear=linear, options=options).run(poses, start=from_above(poses))
    good = frames.converged
    numbers_stand_for_equilibria(frames)
    assert (good == (frames.reason == Reason.NONE)).all(), "a frame that failed says why, and only that one"
    assert (frames.residual[good] <= options.tolerance).all() and (frames.force_balance[good] <= 1e-3).all()
    return frames


# ------------------------------------------------------------------------------------------ contrast, Poisson's ratio


@pytest.mark.parametrize("nu", [0.0, 0.49])
@pytest.mark.parametrize("contrast", [1e-4, 1e8])
def test_contrast_and_poissons_ratio(device, contrast, nu):
    """A fifth of the thickness: every one of these converges."""
    frames = press(body(inclusion(contrast), nu=nu), [0.1, 0.2], device)
    assert frames.converged.all() and (frames.min_det_f > 0.0).all()
    assert frames.force[0, 0, 2] > 0.0 and (np.diff(frames.force[:, 0, 2]) > 0.0).all()


def test_nearly_incompressible(device):
    assert press(body(nu=0.4999), [0.05, 0.1], device).converged.all()


@pytest.mark.parametrize("linear", [False, True])
def test_force_is_proportional_to_the_modulus_over_nine_decades(device, linear):
    force = np.array([press(body(inclusion(100.0, e)), [0.1, 0.2], device, linear=linear).force[:, 0] / e
                      for e in (1e2, 1e5, 1e11)])
    # nothing in the solver knows what a pascal is; the equilibria are found to 1e-4
    within = 3e-4 * force[1].max()
    assert force[0] == pytest.approx(force[1], abs=within) and force[2] == pytest.approx(force[1], abs=within)


# ------------------------------------------------------------------------------------------ depth


@pytest.mark.parametrize(("nu", "least"), [(0.0, 6), (0.3, 7), (0.45, 8)])
def test_tenths_of_the_thickness(device, nu, least):
    """A frame that converged has the probe outside, pushed back the way it came, and no inverted element."""
    frames = press(body(nu=nu), np.linspace(0.1, 0.8, 8), device)
    good = frames.converged[:, 0]
    # with little of Poisson's effect little moves aside, and the last frames squeeze elements to nothing: those may be
    # marked
    assert good[:least].all()
    assert (frames.force[good, 0, 2] > 0.0).all(), "the probe went through the surface"
    assert (np.diff(frames.force[good, 0, 2]) > 0.0).all()
    assert (frames.min_det_f[good, 0] > 0.0).all()


def test_a_crushed_element_is_marked(device):
    """Between walls a flat press to 93 % leaves 7 % of the volume: an equilibrium of the continued law, and no datum.
    Its numbers are kept apart."""
    size = 0.02
    vertices, tets = box((size,) * 3, 0.01)
    model = body(solid=Solid(vertices, tets, np.zeros(len(tets), int), ("cube",)), nu=0.0)
    held = (model.free == 0.0).reshape(-1, 3) | np.array([True, True, False])
    poses = np.tile(np.eye(4), (4, 1, 1, 1))
    poses[:, 0, :3, :3] = turn_to(np.array([0.0, 0.0, -1.0]), Plane())
    poses[:, 0, 2, 3] = size * np.array([0.7, 0.4, 0.2, 0.07])
    options = SolverOptions(tolerance=1e-3)
    frames = Solver(rollers(model, held), Plane(), device=device, options=options).run(poses)
    assert frames.reason[:, 0].tolist() == [Reason.NONE, Reason.NONE, Reason.NONE, Reason.CRUSHED]
    assert all(REASONS[reason - 1] == reason.text for reason in Reason if reason), "datasets say why in words"
    assert frames.min_det_f[-1, 0] < 0.1 < frames.min_det_f[2, 0]
    assert frames.iterations[-1, 0] < 30, "the same equilibrium found twice is enough; 63 shorter steps took 68"
    for name in OF_AN_EQUILIBRIUM:
        values = getattr(frames, name)
        assert np.isfinite(values[:3]).all() and np.isnan(values[3]).all(), name
    assert (frames.unbalanced_force[:3] == 0.0).all() and frames.unbalanced_force[3, 0, 2] > frames.force[2, 0, 2]


# ------------------------------------------------------------------------------------------ meshes


def slivered(degrees):
    """The block with inner vertices pushed towards a neighbour until the least dihedral angle is about ``degrees``."""
    vertices, tets = box(SIZE, 0.01)
    inside = np.flatnonzero(((np.abs(vertices[:, :2]) < 0.02) & (vertices[:, 2:] > 0.005)
                             & (vertices[:, 2:] < 0.015)).all(axis=1))
    low, high = 0.0, 1.0
    for _ in range(40):
        part = 0.5 * (low + high)
        moved = vertices.copy()
        moved[inside[::2], 2] += part * 0.01
        low, high = (part, high) if smallest_sine(moved, tets).min() > np.sin(np.radians(degrees)) else (low, part)
    moved = vertices.copy()
    moved[inside[::2], 2] += low * 0.01
    return Solid(moved, tets, np.zeros(len(tets), int), ("body",))


def test_slivers(device):
    """Dihedral angles down to one degree make the problem ill-conditioned, and the force hardly another."""
    bad, good = slivered(1.0), slivered(20.0)
    assert smallest_sine(bad.vertices, bad.tets).min() == pytest.approx(np.sin(np.radians(1.0)), rel=0.1)
    forces = [press(body(solid=s, nu=0.45), [0.1, 0.2], device) for s in (bad, good)]
    assert all(f.converged.all() for f in forces)
    # a few flat elements in 540 interpolate worse; they do not lock the body
    assert forces[0].force[-1, 0, 2] == pytest.approx(forces[1].force[-1, 0, 2], rel=0.03)


# ------------------------------------------------------------------------------------------ weight


def test_a_ball_deeper_than_its_radius_is_not_let_through(block, line, device):
    """There the surface may slide around the ball. Over five places of the ball within 0.5 mm and two kinds of
    processor the last push is 11.11 to 11.15 N, after 11 to 33 Newton steps."""
    model = block((0.04, 0.04, 0.12), 0.0101, poisson_ratio=0.45)
    ball = Sphere(0.008)
    at = line([[0.0, 0.0, 0.12 + 0.008 - d] for d in (0.0045, 0.009, 0.0135)], ball)
    frames = Solver(model, ball, device=device, options=SolverOptions(tolerance=1e-3)).run(at, start=from_above(at))
    assert frames.converged.all() and frames.iterations[2, 0] <= 35
    assert np.isclose(frames.force[2, 0, 2], 11.12, rtol=0.01)
    assert (np.diff(frames.force[:, 0, 2]) > 3.0).all()
