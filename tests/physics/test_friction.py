"""Coulomb friction: stick, slip, history, and the bounds that hold whatever the body."""

import numpy as np
import pytest
import torch

from vsfsim.core.shape import Plane, Sphere
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.touches import Solver

SIZE = (0.04, 0.04, 0.02)
E, NU = 1e5, 0.3
TIGHT = SolverOptions(tolerance=1e-5, cg_tolerance=1e-3)
USUAL = SolverOptions(tolerance=5e-4)  # the fem tier's


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, 0.01, young_modulus=E, poisson_ratio=NU)


@pytest.fixture(scope="module")
def coarse(block):
    """For a plate on the whole top, whose laws hold on any mesh."""
    return block(SIZE, 0.0134, young_modulus=E, poisson_ratio=NU)


def drag(line, probe, start, down, sideways):
    """Down in 3 frames, then the given sideways positions [m]."""
    x0, y0, z0 = start
    path = [[x0, y0, z0 - down * k / 3] for k in (0, 1, 2, 3)] + [[x0 + x, y0, z0 - down] for x in sideways]
    return line(path, probe)


def plate(line, down, sideways):
    return drag(line, Plane(), (0.0, 0.0, SIZE[2]), down, sideways)


@pytest.mark.parametrize(("linear", "options", "within"), [
    (False, TIGHT, 1e-4), (True, SolverOptions(tolerance=1e-4), 2e-3)])  # 5e-4: there the limit counts as renewed
def test_a_dragged_plate_slides_at_mu_times_the_normal_force(coarse, line, device, linear, options, within):
    mu = 0.3
    solver = Solver(coarse, Plane(), friction=mu, device=device, options=options, linear=linear)
    frames = solver.run(plate(line, 0.001, [0.002, 0.006, 0.006]))
    assert frames.converged.all()
    along, normal = frames.force[:, 0, 0], frames.force[:, 0, 2]
    # every point slips the same way, so the sum of the limits is the limit of the sum
    assert -along[-1] / normal[-1] == pytest.approx(mu, rel=within)
    # and nowhere is it passed: sums of forces on a flat plate are bounded by the sum of the limits
    assert (np.abs(along) <= mu * normal * (1.0 + within) + 1e-6).all()
    assert (frames.force_balance < 1e-3).all()
    assert frames.force[-1] == pytest.approx(frames.force[-2], rel=2e-3, abs=1e-4), "holding still"
    assert np.abs(frames.force[:4, 0, :2]).max() < 1e-3 * normal[3], "straight down it adds up to nothing"


def test_with_much_friction_the_top_is_glued(coarse, line, device):
    """No point slips: the force is that of a top which follows the plate, the same for any larger coefficient."""
    forces = []
    for mu in (50.0, 500.0):
        frames = Solver(coarse, Plane(), friction=mu, device=device,
                        options=TIGHT).run(plate(line, 0.001, [0.0002, 0.0005]))
        assert frames.converged.all() and (frames.slipping[3:] == 0.0).all()
        forces.append(frames.force[:, 0])
    assert forces[0] == pytest.approx(forces[1], rel=1e-4, abs=1e-4)
    # a glued block of side 40 mm and height 20 mm under simple shear: G A x / h bounds it from above, since the sides
    # are free to bend
    shear = E / (2 * (1 + NU)) * SIZE[0] * SIZE[1] * 0.0005 / SIZE[2]
    assert 0.6 * shear < -forces[0][-1, 0] < shear * 1.02


def test_limits_hold_at_every_frame_and_friction_opposes_the_motion(model, line, device):
    mu = 0.4
    sideways = [0.0003, 0.0006, 0.001, 0.002, 0.003, 0.002, 0.001, 0.0, -0.001, -0.002]
    solver = Solver(model, Sphere(0.015), friction=mu, device=device, options=USUAL)
    frames = solver.run(drag(line, Sphere(0.015), (-0.0, 0.0, SIZE[2] + 0.015), 0.003, sideways))
    assert frames.converged.all()
    along, normal = frames.force[4:, 0, 0], frames.force[4:, 0, 2]
    assert (along[2:5] < 0.0).all() and (along[-3:] > 0.0).all(), "the force on the ball points back along its way"
    # the law itself, at every point: the tangential force is at most mu times the normal one, to the tolerance of the
    # sum
    contact = solver.contact
    force, outward = (of[0][contact.gap[0] < 0.0] for of in (contact.force, contact.normal))
    normal_force = (force * outward).sum(dim=1)
    tangential = (force - normal_force[:, None] * outward).norm(dim=1)
    assert (tangential - mu * normal_force < 5e-4 * normal_force.sum()).all()
    assert (tangential > 0.9 * mu * normal_force).any()
    # the normal forces of the ploughed wall add to the drag: 0.028 of the normal force at most, measured
    assert (np.abs(along) < (mu + 0.05) * normal).all()
    # a loop that turns back loses energy: the force at the same place differs between the ways
    assert along[6] - along[sideways.index(0.001)] > 0.5 * mu * normal[2]
    # points that are laid out anew, as when the patch of another touch grows, keep what they stick to
    (held,) = contact.friction_state()[1]
    contact._renew(contact.friction_state())
    solver._end_step(torch.arange(1, device=contact.device))
    assert (held["owner"] >= 0).any() and torch.equal(contact.friction_state()[1][0]["owner"], held["owner"])


@pytest.mark.parametrize("linear", [False, True])
def test_without_friction_a_plate_is_not_dragged(coarse, line, device, linear):
    frames = Solver(coarse, Plane(), friction=0.0, device=device, options=TIGHT,
                    linear=linear).run(plate(line, 0.001, [0.001, 0.002, 0.001, 0.0]))
    assert np.abs(frames.force[:, 0, :2]).max() < 1e-6 * frames.force[3, 0, 2]
    assert (frames.slipping == 0.0).all()


def test_two_fingers_pinch_and_lift(block, line, device):
    """Two balls press a rod from both sides and pull it up: friction alone carries the pull."""
    model = block((0.02, 0.02, 0.06), 0.01, young_modulus=E, poisson_ratio=NU)
    r, squeeze = 0.008, 0.003
    rows = [[[side * (0.01 + r - squeeze * inward), 0.0, 0.045 + up] for side in (-1, 1)]
            for inward, up in [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.0, 0.0004), (1.0, 0.0008)]]
    poses = np.tile(np.eye(4), (len(rows), 1, 2, 1, 1))
    poses[:, 0, :, :3, 3] = rows
    frames = Solver(model, (Sphere(r), Sphere(r)), friction=(0.8, 0.8), device=device, options=TIGHT).run(poses)
    assert frames.converged.all()
    left, right = frames.body_force[-1, 0]
    assert left[0] < 0.0 < right[0] and left[0] == pytest.approx(-right[0], rel=0.02)  # the mesh is not quite symmetric
    assert frames.force[-1, 0, 2] < 0.0, "the object is pulled up, so it pulls the fingers down"
    assert frames.reaction[-1, 0, 2] == pytest.approx(frames.force[-1, 0, 2], rel=1e-3)
    assert frames.body_force[-1, 0].sum(axis=0) == pytest.approx(frames.force[-1, 0], rel=1e-9, abs=1e-12)


def test_moment_is_that_of_the_points_on_the_surface(model, line, device):
    """A plate off to one side: the moment about its origin is that of the nodal forces."""
    solver = Solver(model, Plane(), device=device, options=TIGHT)
    poses = line([[0.013, -0.004, SIZE[2] - 0.001]], Plane())
    frames = solver.run(poses, keep=True)
    nodes = model.mesh.surface_nodes()
    force = -solver.surface_force[-1][:, :, 0]
    places = model.mesh.points[nodes] + solver.history[-1].reshape(-1, 3)[nodes]
    assert frames.body_moment[-1, 0, 0] == pytest.approx(np.cross(places - poses[-1, 0, :3, 3], force).sum(axis=0),
                                                         rel=1e-9, abs=1e-12)
