"""A set of rigid shapes, and triangle meshes among them: errors of the baked distance, its derivatives, and what broken
files give."""

import functools
import os

import numpy as np
import pytest
import trimesh
import warp as wp

from vsfsim.core.errors import MeshError
from vsfsim.core.shape import Capsule, MeshFile, Sphere
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import has_edges, inner_radius
from vsfsim.physics.contact.distance_grid import bake, baked
from vsfsim.physics.mesh import account
from vsfsim.physics.mesh.repair import read_surface
from vsfsim.physics.runtime import mat33, vec3

RADIUS = 0.02


@functools.cache
def kernel():
    @wp.kernel(module="test_rigid", enable_backward=False)
    def evaluate(bodies: sdf.Bodies, k: int, x_in: wp.array(dtype=vec3), gap_out: wp.array(dtype=wp.float64),
                 normal_out: wp.array(dtype=vec3), curvature_out: wp.array(dtype=mat33)):
        i = wp.tid()
        gap_out[i] = sdf.gap(bodies, k, x_in[i])
        normal_out[i] = sdf.normal(bodies, k, x_in[i])
        curvature_out[i] = sdf.curvature(bodies, k, x_in[i])

    return evaluate


def evaluate(bodies, k, x, device):
    gap = wp.array(np.full(len(x), np.nan), dtype=wp.float64, device=device)
    normal = wp.array(np.full((len(x), 3), np.nan), dtype=vec3, device=device)
    curvature = wp.array(np.full((len(x), 3, 3), np.nan), dtype=mat33, device=device)
    wp.launch(kernel(), dim=len(x), device=device, inputs=[
        bodies.on(device), k, wp.array(x, dtype=vec3, device=device), gap, normal, curvature])
    return gap.numpy(), normal.numpy(), curvature.numpy()


def icosphere(subdivisions):
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    return np.array(ball.vertices), np.array(ball.faces)


def shell(count, inner, outer):
    """Points (count, 3) [m] between two radii, and these."""
    rng = np.random.default_rng(3)
    d = rng.standard_normal((count, 3))
    r = rng.uniform(inner, outer, count)
    return d / np.linalg.norm(d, axis=1)[:, None] * r[:, None], r


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A fine meshed ball as a file of its own cache."""
    folder = tmp_path_factory.mktemp("ball")
    trimesh.creation.icosphere(subdivisions=4, radius=RADIUS).export(folder / "ball.ply")
    return MeshFile(str(folder / "ball.ply"), 1.0)


def test_a_meshed_ball_converges_to_the_ball_with_its_facets():
    # facets lie up to edge^2 / (8 R) under the sphere: mesh and grid refined together are of second order
    worst = []
    x, r = shell(4000, 0.9 * RADIUS, 1.03 * RADIUS)
    for subdivisions, cells in ((1, 8), (2, 16), (3, 32)):
        grid = bake(*icosphere(subdivisions), spacing=2 * RADIUS / cells)
        worst.append(np.abs(grid.distance(x) - (r - RADIUS)).max())
    orders = np.log2(np.array(worst)[:-1] / np.array(worst)[1:])
    assert orders.min() > 1.8, (orders, worst)
    assert worst[-1] < 8e-3 * RADIUS, worst


@pytest.mark.parametrize("place", ["surface", "edge of the grid"])
def test_gap_normal_and_curvature_of_a_mesh_are_derivatives_of_one_function(ball, device, place):
    bodies = RigidBodies([Sphere(0.01), ball])
    grid = sdf.grid(ball)
    rng = np.random.default_rng(0)
    low, high = grid.domain()
    if place == "surface":
        x, *_ = shell(500, 0.9 * RADIUS, 1.1 * RADIUS)
    else:
        x = np.clip(rng.uniform(1.2 * low, 1.2 * high, (500, 3)), low, high)
    gap, normal, curvature = evaluate(bodies, 1, x, device)
    assert np.abs(gap - bodies.distance(1, x)).max() < 1e-15
    h = 1e-6
    if place != "surface":
        x = x * (1 - 1e-3)  # the difference must stay in the domain
        gap, normal, curvature = evaluate(bodies, 1, x, device)
    ahead, behind = ([evaluate(bodies, 1, x + s * h * e, device) for e in np.eye(3)] for s in (1, -1))
    slope = np.stack([(a[0] - b[0]) / (2 * h) for a, b in zip(ahead, behind)], axis=1)
    # rounding 1e-17 / h = 1e-11; truncation h^2 times a third derivative, at most 1 / spacing^2 = 3e6: 1e-6
    assert np.abs(slope - normal).max() < 2e-6
    bend = np.stack([(a[1] - b[1]) / (2 * h) for a, b in zip(ahead, behind)], axis=2)
    # curvatures are ~ 100 / m; where the difference straddles a cell's face the third derivative jumps: h x 3e6
    assert np.abs(bend - curvature).max() < 5.0 and np.quantile(np.abs(bend - curvature), 0.95) < 0.05
    assert np.abs(curvature - np.swapaxes(curvature, 1, 2)).max() == 0.0


def test_beyond_the_grid_the_gap_never_overestimates_and_is_right_in_size(ball, device):
    bodies = RigidBodies([ball])
    x, r = shell(3000, 0.03, 0.5)
    gap, normal, curvature = evaluate(bodies, 0, x, device)
    assert np.abs(gap - bodies.distance(0, x)).max() < 1e-15
    exact = r - RADIUS
    assert (gap > 0.0).all() and (gap <= exact * (1 + 1e-6) + 2e-3 * RADIUS).all()
    # the box of the grid: a corner is sqrt(3) of half its edge away
    assert (exact - gap).max() < np.linalg.norm(sdf.grid(ball).domain()[1]) - RADIUS
    outside = (np.abs(x) > sdf.grid(ball).domain()[1] + 1e-6).any(axis=1)
    assert np.isfinite(curvature).all() and outside.any()
    assert np.abs(np.linalg.norm(normal[outside], axis=1) - 1.0).max() < 1e-12
    assert (np.einsum("ni,ni->n", normal, x)[outside] > 0.0).all()


def test_each_of_several_meshes_has_its_own_distance(ball, device, tmp_path):
    trimesh.creation.box((0.02, 0.01, 0.03)).export(tmp_path / "box.stl")
    bodies = RigidBodies([ball, Capsule(0.01, 0.03), MeshFile(str(tmp_path / "box.stl"), 1.0), ball])
    x = shell(500, 0.005, 0.04)[0]
    for k in range(4):
        assert np.abs(evaluate(bodies, k, x, device)[0] - bodies.distance(k, x)).max() < 1e-15


def broken(kind):
    """A ball with something wrong, and what the note must say."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)
    if kind == "hole":
        ball.update_faces(ball.triangles_center[:, 2] < 0.9 * RADIUS)
        return ball, "Not watertight"
    if kind == "inside out":
        ball.faces = ball.faces[:, ::-1]
        return ball, "inside out"
    if kind == "wound at random":
        turned = np.random.default_rng(0).random(len(ball.faces)) < 0.3
        ball.faces[turned] = ball.faces[turned][:, ::-1]
        return ball, "wound inconsistently"
    other = ball.copy()
    other.apply_translation((0.008, 0.0, 0.0))
    return trimesh.util.concatenate([ball, other]), "Probe mesh"


@pytest.mark.parametrize("kind", ["hole", "inside out", "wound at random", "overlap"])
def test_broken_files_are_repaired_said_and_right(kind, tmp_path):
    mesh, word = broken(kind)
    mesh.export(tmp_path / "b.ply")
    surface = read_surface(MeshFile(str(tmp_path / "b.ply"), 1.0))
    grid = bake(surface.vertices, surface.faces, spacing=RADIUS / 16, notes=surface.notes)
    assert any(word in note for note in grid.notes), grid.notes
    centre = 0.5 * (mesh.bounds[0] + mesh.bounds[1])
    x = shell(4000, 0.0, 0.035)[0]
    world = x + centre
    exact = np.linalg.norm(world, axis=1) - RADIUS
    if kind == "overlap":
        exact = np.minimum(exact, np.linalg.norm(world - [0.008, 0, 0], axis=1) - RADIUS)
    if kind == "hole":
        cut = world[:, 2] < 0.8 * RADIUS
        x, exact = x[cut], exact[cut]
    far = np.abs(exact) > 0.05 * RADIUS
    assert ((grid.distance(x) < 0) == (exact < 0))[far].all()
    near = (exact > 0) & (exact < 0.1 * RADIUS)
    # facets of a level-3 ball 6e-3 R
    assert near.sum() > 100 and np.abs(grid.distance(x) - exact)[near].max() < 0.012 * RADIUS


def test_a_tip_that_is_replaced_under_the_same_time_stamp_is_the_new_one(tmp_path):
    tip, found = MeshFile(str(tmp_path / "tip.stl"), 1.0), []
    for mesh in trimesh.creation.icosphere(subdivisions=3, radius=0.008), trimesh.creation.box((0.02, 0.02, 0.02)):
        mesh.export(tip.path)
        os.utime(tip.path, (1.7e9, 1.7e9))
        found.append((sdf.reach(tip), inner_radius(tip), has_edges(tip)))
    assert found[0] == pytest.approx((0.008, 0.008, False), rel=0.03)
    assert found[1] == pytest.approx((0.01 * 3**0.5, 0.01, True), rel=0.2)


def test_a_tip_is_accounted_for_against_its_file(tmp_path):
    """A needle is its file; the grid of a smaller ball, or of a ball without its cavity, is not the file's."""
    trimesh.creation.cylinder(0.001, 0.05, sections=12).export(tmp_path / "needle.stl")
    said = baked(MeshFile(str(tmp_path / "needle.stl"), 1.0)).notes[-1]
    assert said.startswith("Distance grid against file: box") and "departs" not in said
    ball, small = (trimesh.creation.icosphere(subdivisions=2, radius=r) for r in (0.016, 0.014))
    cavity = small.copy()
    cavity.invert()
    for mesh, made in ((ball, small), (trimesh.util.concatenate([ball, cavity]), ball)):
        mesh.export(tmp_path / "b.stl")
        grid = bake(made.vertices, made.faces, spacing=0.001)
        found = account.of_tip(read_surface(MeshFile(str(tmp_path / "b.stl"), 1.0)), np.ptp(grid.vertices, axis=0),
                               grid.spacing, grid.coefficients, grid.distance)
        with pytest.raises(MeshError, match="so that it is within 10 % of the file"):
            account.refuse(found, "b.stl could not be taken as a probe", "Repair it")
