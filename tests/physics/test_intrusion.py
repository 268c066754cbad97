"""No rigid body lies inside an object unnoticed: the check by geometry, contact between the points, marked frames."""

import numpy as np
import pytest
import torch
from frame_checks import from_above
from texts import scene

from vsfsim.core.bubble import Bubble
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Box, Capsule, Cylinder, Sphere
from vsfsim.generate.effectors.bubble import solve as solve_bubble
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import inner_radius
from vsfsim.physics.contact.intrusion import Intrusion
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.solve.frames import Reason, SolverOptions
from vsfsim.physics.solve.touches import Solver

SIZE = (0.06, 0.06, 0.04)
CELL = 0.01

BODIES = {
    "ball": Sphere(0.008), "small ball": Sphere(0.001), "capsule": Capsule(0.004, 0.01),
    "cylinder": Cylinder(0.005, 0.01), "box": Box((0.008, 0.01, 0.012)),
}


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, CELL)


def at(*places):
    """Poses (B, 1, 4, 4) of a body at places [m]."""
    out = np.tile(np.eye(4), (len(places), 1, 1, 1))
    out[:, 0, :3, 3] = places
    return out


@pytest.mark.parametrize("shape", BODIES.values(), ids=BODIES.keys())
def test_depth_of_a_body_in_a_block_at_rest(model, device, shape):
    """Flat boundaries and straight elements, where every depth is known."""
    check = Intrusion(model.mesh, RigidBodies(shape), model.element_size, device=device)
    half = sdf.support(shape, np.array([0.0, 0.0, -1.0]))
    sunk = 0.3 * half
    places = [(0.0012, 0.0007, 0.02), (0.0, 0.0, 0.2), (0.0012, 0.0007, SIZE[2] + half - sunk),
              (0.0012, 0.0007, SIZE[2] + half)]
    u = torch.zeros((model.mesh.points.size, len(places)), dtype=torch.float64, device=device)
    faces, near = check.check(torch.arange(len(places), device=device), at(*places), u)
    inside = near.amax(dim=1).cpu().numpy()
    lowest = min(0.02, 0.02 + half)
    # buried: its samples reach the height of its centre, half a spacing off at most
    assert inside[0] > 0.02 - 0.6 * inner_radius(shape) and inside[0] <= lowest + 1e-9
    assert inside[1] == 0.0 and not faces[1].any()
    # samples are half a radius apart, so that the lowest one of a round body is a quarter from its pole at most
    assert sunk - inner_radius(shape) / 32.0 <= inside[2] <= 1.05 * sunk
    assert inside[3] < 1e-9


def test_what_is_behind_a_dent_past_its_rim_is_inside_a_membrane(device):
    """A ball behind the tip of a dent of 40 mm, past the plane of the rim, is as deep as its far pole is away from the
    tip; one in the dent is outside, and so is one beside the cone that closes the membrane."""
    sheet = build_bubble(Bubble(nodes=200)).mesh
    apex, u = int(sheet.points[:, 2].argmax()), np.zeros((*sheet.points.shape, 3))
    u[apex, 2] = -0.04
    check = Intrusion(sheet, RigidBodies(Sphere(0.001)), 0.005, device=device)
    places = sheet.points[apex] + [[0.0, 0.0, -0.043], [0.0, 0.0, -0.02], [-0.017, -0.038, -0.055]]
    u = torch.as_tensor(u.reshape(-1, 3), device=device)
    depth = check.check(torch.arange(3, device=device), at(*places), u)[1].amax(dim=1)
    assert depth.tolist() == pytest.approx([0.004, 0.0, 0.0], abs=5e-5)


def test_a_ball_smaller_than_an_element_is_met_wherever_it_is(model, device):
    """A ball of 1 mm on cells of 10 mm, whose six points a face it would pass between."""
    ball = Sphere(0.001)
    # a node, the middle of an edge, of a face, and places between
    spots = [(0.0, 0.0), (0.005, 0.0), (0.0033, 0.0033), (0.0012, 0.0047), (0.0081, 0.0013)]
    depth = 0.0003 * np.arange(1, 4)
    poses = np.stack([at(*[(x, y, SIZE[2] + 0.001 - d) for x, y in spots]) for d in depth])
    frames = Solver(model, ball, device=device, options=SolverOptions(tolerance=1e-3)).run(
        poses, start=from_above(poses))
    assert frames.converged.all()
    force = frames.force[:, :, 2]
    assert (force[0] > 0.0).all() and (np.diff(force, axis=0) > 0.0).all()
    # no more than the solver marks, and the report says it
    assert frames.penetration.max() < 0.03 * model.element_size


@pytest.mark.parametrize("linear", [False, True], ids=["fem", "linear"])
def test_a_frame_with_a_body_inside_the_object_is_marked(model, device, line, monkeypatch, linear):
    """Contact points that push with nothing: the probe passes into the block, as it did between them."""
    make = RigidContact._patch

    def without_force(self, b, faces):
        patch = make(self, b, faces)
        patch.parts["stiffness"] = 0.0
        return patch

    monkeypatch.setattr(RigidContact, "_patch", without_force)
    ball = Sphere(0.003)
    poses = line([[0.0, 0.0, SIZE[2] + 0.003 - d] for d in (0.001, 0.003)] + [[0.0, 0.0, 0.06]], ball)
    frames = Solver(model, ball, device=device, linear=linear,
                    options=SolverOptions(tolerance=1e-3, halvings=1)).run(poses, start=from_above(poses))
    assert (frames.reason[:2, 0] == Reason.INTRUSION).all() and not frames.converged[:2].any()
    assert frames.converged[2, 0], "free again"
    assert frames.penetration[1, 0] == pytest.approx(0.003, rel=0.1)


def test_a_ball_that_went_through_a_membrane_is_never_in_silence():
    """A ball of 3 mm goes 20 mm into a bubble of 390 nodes, too fast for it: every frame has a push or is marked."""
    found = solve_bubble(scene("bubble").sample(0), Request(limit=2.0)).solved.frames
    good = found.converged[:, 0]
    assert (np.linalg.norm(found.force[good, 0], axis=1) > 0.1).all()
    assert np.isnan(found.force[~good, 0]).all()


def test_a_box_that_cuts_in_between_points_is_met_from_where_it_is(block, device):
    """Its faces get more points in the second frame: what lies inside stays under the depth from which a frame is
    marked, a twentieth of an element of 25 mm."""
    poses = np.tile(np.eye(4), (2, 1, 1, 1))
    poses[:, 0, 2, 3] = 0.065 - np.array([0.0115, 0.015])
    model = block((0.1, 0.1, 0.05), 0.025, poisson_ratio=0.3)
    frames = Solver(model, Box((0.03, 0.03, 0.03)), device=device).run(poses, start=from_above(poses))
    assert frames.converged.all() and frames.penetration[1, 0] < 0.05 * 0.025
    assert np.abs(frames.force[:, 0, :2]).max() < 1e-3 * frames.force[1, 0, 2]
