"""Contact: energy and force of the penalty on the surface."""


import numpy as np
import pytest
import torch

from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, Sphere
from vsfsim.physics.contact import patch
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.rigid_contact import RigidContact

SIZE = (0.04, 0.04, 0.03)
E = 1e5


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, 0.02, young_modulus=lambda x: E * (1.0 + x[..., 0] / SIZE[0]))


def touch(model, probe, poses, device, friction=0.0):
    bodies = RigidBodies(probe)
    poses = poses if poses.ndim == 5 else poses[:, :, None]
    return RigidContact(model, bodies, np.full(len(bodies), friction), poses, device=device)


def states(model, probe, pose, u, device):
    """Contact of the same probe with many displacement fields u (3 n, B): an evaluated `RigidContact`."""
    batch = u.shape[1]
    poses = np.tile(pose, (1, batch, 1, 1))
    contact = touch(model, probe, poses, device)
    contact.move(poses[0][:, None])
    contact.evaluate(torch.arange(batch, device=device), contact.gather(torch.as_tensor(u, device=device)))
    return contact


def nodal(contact, b):
    """Contact forces (3 s,) [N] of touch ``b``, on the host, the padding cut off."""
    found = contact.nodal(torch.tensor([b], device=contact.device))[0]
    return found.cpu().numpy()[:3 * len(contact.patches[b].nodes)]


def dof(contact, b):
    return contact.dof[b].cpu().numpy()[:3 * len(contact.patches[b].nodes)]


def energy(contact):
    return contact.energy(torch.arange(len(contact.patches), device=contact.device)).cpu().numpy()


def tilted(at):
    q, r = np.linalg.qr(np.random.default_rng(1).standard_normal((3, 3)))
    q = q * np.sign(np.diag(r))
    pose = np.eye(4)
    pose[:3, :3] = q * np.linalg.det(q)
    pose[:3, 3] = at
    return pose


PROBES = {
    "sphere": (Sphere(0.012), tilted([0.003, -0.002, 0.039])),
    "capsule": (Capsule(0.008, 0.02), tilted([0.0, 0.0, 0.033])),
    "cylinder": (Cylinder(0.01, 0.02), tilted([0.0, 0.0, 0.034])),
    "box": (Box((0.012, 0.016, 0.02)), tilted([0.0, 0.0, 0.034])),
    "plane": (Plane(), np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 0.0285], [0, 0, 0, 1.0]])),
}


@pytest.mark.parametrize(("probe", "pose"), PROBES.values(), ids=PROBES.keys())
def test_force_is_minus_the_gradient_of_the_energy(model, device, probe, pose):
    rng = np.random.default_rng(2)
    u = 3e-4 * rng.standard_normal(model.mesh.points.size)
    x = rng.standard_normal((len(u), 20))
    h = 1e-8  # m
    contact = states(model, probe, pose, np.column_stack([u[:, None] + h * x, u[:, None] - h * x, u]), device)
    e = energy(contact)
    assert e[40] > 0.0
    slope = (e[:20] - e[20:40]) / (2 * h)
    force = nodal(contact, 40)
    expected = -(x[dof(contact, 40)] * force[:, None]).sum(axis=0)
    # energy over force is about the penetration, 1e-3 m: rounding 1e-16 * 1e-3 / h = 1e-11, some 1e3 terms; truncation
    # (h / 1e-2 m)^2; a Gauss point that crosses the surface or a fillet within h changes the force by h / penetration =
    # 1e-5 of its own share
    assert np.abs(slope - expected).max() < 1e-6 * np.abs(expected).max()


def test_a_plane_on_a_flat_top_meets_stiffness_times_penetration_times_area(model, device):
    depth = 1e-4
    pose = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, SIZE[2] - depth], [0, 0, 0, 1.0]])
    contact = states(model, Plane(), pose, np.zeros((model.mesh.points.size, 1)), device)
    top = np.flatnonzero((model.mesh.points[model.mesh.faces][:, :, 2] == SIZE[2]).all(axis=1))
    area, modulus = model.mesh.face_area()[top], model.surface_modulus[top]
    # pressure = PENALTY x modulus x penetration / element size, with the size the root of the face's area
    by_hand = (area * patch.PENALTY * modulus * depth / np.sqrt(area)).sum()
    force = nodal(contact, 0).reshape(-1, 3).sum(axis=0)
    assert force == pytest.approx([0.0, 0.0, -by_hand], rel=1e-12, abs=1e-12 * by_hand)
    assert float(contact.penetration(torch.tensor([0], device=device))) == pytest.approx(depth, rel=1e-9)
    assert energy(contact)[0] == pytest.approx(0.5 * by_hand * depth, rel=1e-9)


@pytest.mark.parametrize("ratio", [0.1, 0.5, 1.0, 1.7])
def test_no_ball_sinks_into_the_holes_between_the_points_of_a_sheet(ratio):
    """A ball of radius R in a hole of radius 0.4 edge of a part of a face is (0.4 edge)^2 / (2 R) deep: under one per
    cent of the sheet's edge, here 1 m."""
    assert (0.4 / patch.sheet_contact(RigidBodies(Sphere(1.0 / ratio)), 1.0)[0]) ** 2 * ratio < 0.02
