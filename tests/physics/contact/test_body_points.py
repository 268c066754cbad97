"""Edges, corners and rims of rigid bodies as contact points: felt from the first touch on, whatever the path."""

import numpy as np
import pytest
import trimesh
from frame_checks import from_above
from scipy.spatial.transform import Rotation

from measurements.stability.scene import write_pyramid
from vsfsim.core.shape import Box, Cylinder, MeshFile
from vsfsim.generate.aim import clearance
from vsfsim.physics.contact.body_samples import has_edges, sharp_samples
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.touches import Solver

SIZE = (0.06, 0.06, 0.03)
CELL = 0.01
SIDE = 0.012
CORNER = Rotation.align_vectors([[0.0, 0.0, -1.0]], [[1.0, 1.0, 1.0]])[0].as_matrix()
EDGE = Rotation.from_euler("x", 45.0, degrees=True).as_matrix()
SHARP = {
    "corner": (Box((SIDE, SIDE, SIDE)), CORNER, np.sqrt(0.75) * SIDE),
    "edge": (Box((SIDE, SIDE, SIDE)), EDGE, np.sqrt(0.5) * SIDE),
    "rim": (Cylinder(0.5 * SIDE, SIDE), EDGE, np.sqrt(0.5) * SIDE),
}
SPOTS = np.array([[0.0, 0.0], [0.005, 0.0], [0.0033, 0.0021], [0.0012, 0.0047], [0.0081, 0.0013]])
"""A node, the middle of an edge, and places between, in cells of 10 mm [m]."""


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, CELL)


def down(turn, above, spots, depths):
    """Poses (T, B, 1, 4, 4) of a body turned by ``turn``, at ``depths`` (T,) [m] over ``spots`` (B, 2) [m]."""
    poses = np.tile(np.eye(4), (len(depths), len(spots), 1, 1, 1))
    poses[..., :3, :3] = turn
    poses[..., :2, 3] = np.asarray(spots)[None, :, None]
    poses[..., 2, 3] = (SIZE[2] + above - np.asarray(depths))[:, None, None]
    return poses


@pytest.mark.parametrize(("kind", "linear"), [("corner", False), ("edge", True), ("rim", True)])
def test_an_edge_is_felt_from_the_first_touch_on_wherever_it_is(model, device, kind, linear):
    shape, turn, above = SHARP[kind]
    depths = CELL * np.array([-0.01, 0.002, 0.01, 0.02, 0.04, 0.08])
    frames = Solver(model, shape, device=device, linear=linear, options=SolverOptions(tolerance=1e-3)).run(
        down(turn, above, SPOTS, depths))
    assert frames.converged.all(), frames.reason
    force = frames.force[:, :, 2]
    assert (force[0] == 0.0).all() and (force[1] > 0.0).all() and (np.diff(force, axis=0) > 0.0).all()
    assert frames.penetration[1:].max() < 0.04 * model.element_size
    # symmetry says nothing of the sideways force at these places; the mesh gives some, which does not lead
    assert (np.linalg.norm(frames.force[1:, :, :2], axis=2) < 0.5 * force[1:]).all()


def test_an_edge_that_its_file_divides_stands_for_the_same_length(tmp_path):
    """The whole one, but for half a spacing at the corners of the box."""
    plain = trimesh.creation.box((0.02, 0.02, 0.02))
    for name, mesh in (("plain", plain), ("divided", plain.subdivide().subdivide())):
        mesh.export(tmp_path / f"{name}.stl")
        stands = sharp_samples(MeshFile(str(tmp_path / f"{name}.stl"), 1.0), 0.002)[2]
        assert stands.sum() == pytest.approx(12 * 0.02, rel=0.11)


@pytest.mark.parametrize("kind", ["corner", "edge"])
def test_the_energy_is_the_work_of_an_edge(model, device, kind):
    """With the indentation that the mesh is too coarse for: most of the energy at first."""
    shape, turn, above = SHARP[kind]
    depths = CELL * np.linspace(0.0, 0.12, 13)
    frames = Solver(model, shape, device=device, options=SolverOptions(tolerance=1e-5)).run(
        down(turn, above, SPOTS[2:3], depths))
    assert frames.converged.all()
    force, energy = frames.force[:, 0, 2], frames.energy[:, 0]
    work = np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(depths))])
    # the sum of trapezia, the penalty's own energy, and points that move to another place of the object
    assert np.abs(energy[1:] - work[1:]).max() < 0.04 * work[-1]


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "linear"), [
    (Box((0.02, 0.024, 0.02)), False), (Cylinder(0.012, 0.02), True)], ids=["box", "cylinder"])
def test_the_force_of_a_flat_punch_does_not_depend_on_the_number_of_frames(block, device, shape, linear):
    """A punch of two elements: 0.1 % are left, where the rim was found between the points it was 11 % (linear: 20 %).
    Of a punch that is one element wide up to 5 % are left."""
    model = block(SIZE, 0.012, young_modulus=5e4)
    last = []
    for count in (1, 2, 8):
        depths = 0.003 * np.arange(1, count + 1) / count
        poses = down(np.eye(3), 0.01, SPOTS[:1], depths)
        frames = Solver(model, shape, device=device, linear=linear, options=SolverOptions(tolerance=1e-3)).run(
            poses, start=from_above(poses))
        assert frames.converged.all(), frames.reason
        last.append(frames.force[-1, 0, 2])
    assert last == pytest.approx([last[0]] * 3, rel=0.01)


def test_edges_of_a_mesh_are_found(tmp_path):
    write_pyramid(tmp_path / "pyramid.obj", 0.01)
    points, outward, length = sharp_samples(MeshFile(str(tmp_path / "pyramid.obj")), 0.002)
    tip = points[:, 2].argmin()
    assert length[tip] == 0.0 and outward[tip] == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
    assert (length == 0.0).sum() == 5, "the tip and four corners"
    assert length.max() <= 0.002 + 1e-12, "as far apart as asked at most"
    trimesh.creation.icosphere(subdivisions=3, radius=0.01).export(tmp_path / "ball.obj")
    assert not has_edges(MeshFile(str(tmp_path / "ball.obj"))) and has_edges(MeshFile(str(tmp_path / "pyramid.obj")))


@pytest.mark.parametrize("kind", SHARP)
def test_first_contact_is_where_the_edge_is(model, kind):
    """Without the fillet, and between the samples of the object's surface."""
    shape, turn, above = SHARP[kind]
    for x, y in SPOTS:
        pose = down(turn, above, [(x, y)], [-0.004])[0, 0, 0]
        assert clearance(model, shape, pose, np.array([0.0, 0.0, -1.0])) == pytest.approx(0.004, abs=2e-5)


def test_friction_holds_a_corner_within_coulombs_law(model, device):
    """A corner pressed in and dragged: it slides at mu times its normal force."""
    shape, turn, above = SHARP["corner"]
    mu, depth = 0.3, 0.0008
    ways = np.linspace(0.0, 0.002, 6)
    poses = down(turn, above, SPOTS[2:3], [0.5 * depth, depth] + [depth] * len(ways))
    poses[2:, :, 0, 0, 3] += ways[:, None]
    frames = Solver(model, shape, friction=mu, device=device, options=SolverOptions(tolerance=1e-3)).run(poses)
    assert frames.converged.all(), frames.reason
    along, normal = -frames.force[-1, 0, 0], frames.force[-1, 0, 2]
    assert normal > 0.0 and along == pytest.approx(mu * normal, rel=0.25)  # the dent is no plane
