"""Contact: quadrature, energy, force and stiffness of the penalty on the surface."""

import math

import numpy as np
import pytest
import warp as wp

from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, Sphere
from vsfsim.physics import contact
from vsfsim.physics.touching import Touching

SIZE = (0.04, 0.04, 0.03)
E = 1e5


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, 0.02, young_modulus=lambda x: E * (1.0 + x[..., 0] / SIZE[0]))


def test_shape_functions_are_a_partition_of_unity_and_nodal():
    bary = np.random.default_rng(0).dirichlet([1, 1, 1], 20)
    values = contact.shape_values(bary)
    assert np.abs(values.sum(axis=1) - 1.0).max() < 1e-14
    nodes = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0], [0, 0.5, 0.5], [0.5, 0, 0.5]])
    assert np.abs(contact.shape_values(nodes) - np.eye(6)).max() < 1e-14
    # a quadratic field is interpolated exactly
    def field(b):
        return b[:, 0] ** 2 + 3 * b[:, 1] * b[:, 2] - b[:, 2]

    assert np.abs(values @ field(nodes) - field(bary)).max() < 1e-13


@pytest.mark.parametrize("degree", range(7))
def test_six_point_rule_is_exact_to_degree_four(degree):
    worst = 0.0
    for a in range(degree + 1):
        for b in range(degree + 1 - a):
            c = degree - a - b
            # mean over a triangle of L1^a L2^b L3^c = 2 a! b! c! / (a + b + c + 2)!
            exact = 2 * math.factorial(a) * math.factorial(b) * math.factorial(c) / math.factorial(degree + 2)
            worst = max(worst, abs(contact.WEIGHTS @ np.prod(contact._BARY ** [a, b, c], axis=1) - exact))
    # the constants are given to 15 digits
    if degree <= 4:
        assert worst < 2e-15
    else:
        assert worst > 1e-5, "a rule that is exact here too would not be this one"


def states(model, probe, pose, u, device):
    """Contact of the same probe with many displacement fields u (3 n, B): a `Touching` that has been evaluated."""
    batch = u.shape[1]
    poses = np.tile(pose, (1, batch, 1, 1))
    touching = Touching(model, probe, poses, device=device, real=wp.float64)
    touching.evaluate(np.arange(batch), poses[0], wp.array(u, dtype=wp.float64, device=device))
    return touching


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
    touching = states(model, probe, pose, np.column_stack([u[:, None] + h * x, u[:, None] - h * x, u]), device)
    assert touching.touches(40) and touching.energy[40] > 0.0
    slope = (touching.energy[:20] - touching.energy[20:40]) / (2 * h)
    force = touching.nodal(40)
    expected = -(x[touching.dof(40)] * force[:, None]).sum(axis=0)
    # energy over force is about the penetration, 1e-3 m: rounding 1e-16 * 1e-3 / h = 1e-11, some 1e3 terms; truncation (h / 1e-2 m)^2;
    # a Gauss point that crosses the surface or a fillet within h changes the force by h / penetration = 1e-5 of its own share
    assert np.abs(slope - expected).max() < 1e-6 * np.abs(expected).max()


@pytest.mark.parametrize("name", ["sphere", "capsule", "plane"])
def test_rows_and_geometric_block_are_the_derivative_of_the_force(model, device, name):
    probe, pose = PROBES[name]
    rng = np.random.default_rng(3)
    u = 3e-4 * rng.standard_normal(model.mesh.points.size)
    x = rng.standard_normal((len(u), 10)) * model.free[:, None]
    h = 1e-9
    touching = states(model, probe, pose, np.column_stack([u[:, None] + h * x, u[:, None] - h * x, u]), device)
    slope = np.stack([(touching.nodal(k) - touching.nodal(10 + k)) / (2 * h) for k in range(10)], axis=1)
    rows, stiffness, bend = touching.rows(20, geometric=True)
    free = model.free[touching.dof(20)][:, None]
    found = (rows.T @ (stiffness[:, None] * rows) + bend) @ x[touching.dof(20)]
    # forces of ~10 N have rounding 1e-15 N, over 2 h: 1e-6 of slopes ~ 1e6
    assert np.abs((found + slope) * free).max() < 1e-5 * np.abs(slope).max()
    assert np.linalg.eigvalsh(0.5 * (bend + bend.T)).max() < 1e-9 * np.abs(slope).max(), "the geometric part only ever softens"


def test_a_plane_on_a_flat_top_meets_stiffness_times_penetration_times_area(model, device):
    depth = 1e-4
    pose = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, SIZE[2] - depth], [0, 0, 0, 1.0]])
    touching = states(model, Plane(), pose, np.zeros((model.mesh.points.size, 1)), device)
    top = np.flatnonzero((model.mesh.points[model.mesh.faces][:, :, 2] == SIZE[2]).all(axis=1))
    area, modulus = model.mesh.face_area()[top], model.surface_modulus[top]
    # pressure = PENALTY x modulus x penetration / element size, with the size the root of the face's area
    by_hand = (area * contact.PENALTY * modulus * depth / np.sqrt(area)).sum()
    force = touching.nodal(0).reshape(-1, 3).sum(axis=0)
    assert force == pytest.approx([0.0, 0.0, -by_hand], rel=1e-12, abs=1e-12 * by_hand)
    assert touching.penetration(0) == pytest.approx(depth, rel=1e-9)
    assert touching.energy[0] == pytest.approx(0.5 * by_hand * depth, rel=1e-9)


def test_a_probe_out_of_reach_has_an_empty_patch_and_no_force(model, device):
    pose = np.eye(4)
    pose[:3, 3] = [0.0, 0.0, 0.2]
    touching = states(model, Sphere(0.01), pose, np.zeros((model.mesh.points.size, 1)), device)
    assert len(touching.patches[0].faces) == 0 and not touching.touches(0)
    assert touching.penetration(0) == 0.0 and touching.energy[0] == 0.0 and not touching.nodal(0).any()


def test_batched_touches_do_not_see_each_other(model, device):
    """Patches of different length share padded arrays: each must answer as if alone."""
    u = np.zeros((model.mesh.points.size, 3))
    poses = np.stack([PROBES["sphere"][1], np.eye(4), tilted([0.01, 0.01, 0.036])])[None]
    poses[0, 1, :3, 3] = [0, 0, 0.5]
    together = Touching(model, Sphere(0.012), poses, device=device, real=wp.float64)
    together.evaluate(np.arange(3), poses[0], wp.array(u, dtype=wp.float64, device=device))
    for b in range(3):
        alone = Touching(model, Sphere(0.012), poses[:, b:b + 1], device=device, real=wp.float64)
        alone.evaluate(np.array([0]), poses[0, b:b + 1], wp.array(u[:, :1].copy(), dtype=wp.float64, device=device))
        assert np.array_equal(alone.nodal(0), together.nodal(b)) and alone.energy[0] == together.energy[b]
