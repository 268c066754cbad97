"""Where the probe aims, and probe stiffness against a closed form."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from frame_checks import rollers
from texts import scene

from vsfsim.core.errors import SceneError
from vsfsim.core.shape import Box
from vsfsim.generate.aim import aim_probe, clearance, probe_pose, surface_samples
from vsfsim.generate.truth import PROBE_RADIUS, probe_stiffness
from vsfsim.physics.contact import sdf
from vsfsim.physics.solve.touches import Solver, SolverOptions

SIZE = (0.06, 0.06, 0.04)
SCENE = scene("block", ("press = ", "touches = { count = 12, depth = 0.004, approach = 0.005 }\npress = "),
              shape="{ box = [0.06, 0.06, 0.04] }", press=None).sample(0)


@pytest.fixture(scope="module")
def model(block):
    return block(SIZE, 0.02)


def view(*, top=True, side=True, inside=False, under=1.0):
    """The cloud, up to a height ``under`` [m], and where the camera is, as `aim_probe` reads a view: what a camera in
    front of the block's corner at +x sees: top and side; or points that lie inside, as a wrong depth would give."""
    t = np.linspace(-0.028, 0.028, 29)
    a, b = (v.ravel() for v in np.meshgrid(t, t))
    h = (b + 0.03) * 2 / 3
    parts = []
    if top:
        parts.append(np.column_stack([a, b, np.full(len(a), SIZE[2])]))
    if side:
        parts.append(np.column_stack([np.full(len(a), 0.03), a, h]))
    if inside:
        parts.append(np.column_stack([a, b, np.full(len(a), 0.01)]))
    pose = np.eye(4)
    pose[:3, 3] = [0.2, 0.0, 0.25]
    cloud = np.concatenate(parts)
    cloud = cloud[cloud[:, 2] < under]
    return SimpleNamespace(cloud=cloud, points=lambda: cloud, camera_pose=pose)


def streams(seed=0):
    return lambda k: np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(k,)))


def aims(model, seen, **changes):
    scene = dataclasses.replace(SCENE, touches=dataclasses.replace(SCENE.touches, **changes))
    return aim_probe(scene, model, seen, streams())


def test_aims_lie_on_the_cloud_and_go_along_its_normal(model):
    seen = view()
    found = aims(model, seen)
    assert len(found) == 12
    faces = set()
    for a in found:
        assert (np.abs(seen.cloud - a.target).max(axis=1) == 0.0).any()
        away = min(abs(a.target[2] - SIZE[2]), abs(a.target[0] - 0.03)) < 1e-12
        assert away and np.linalg.norm(a.normal) == pytest.approx(1.0) and np.array_equal(a.axis, -a.normal)
        on_top, on_side = a.target[2] == SIZE[2], a.target[0] == 0.03
        # the normal is that of the 40 nearest points within 12 mm: exact where they are of one face
        edge = np.hypot(a.target[0] - 0.03, a.target[2] - SIZE[2])
        if edge > 0.0121:
            assert a.normal == pytest.approx([0, 0, 1] if on_top else [1, 0, 0], abs=1e-9)
            faces.add("top" if on_top else "side")
        assert on_top or on_side
        # the probe's centre at contact: its surface is on the body's, which is sampled every 3 mm or so
        gap = sdf.distance(SCENE.probe, surface_samples(model) - a.contact).min()
        assert -1e-9 <= gap <= 2e-6
    assert faces == {"top", "side"}


@pytest.mark.slow
def test_the_path_never_goes_below_the_table(model):
    # targets near the foot of the block: a ball of 10 mm that comes from the side must stay 10 mm up
    found = aims(model, view(top=False), count=20)
    low = min(min((a.contact - SCENE.touches.approach * a.axis)[2], (a.contact + a.depth * a.axis)[2]) for a in found)
    assert low - 0.01 >= -1e-12
    assert any(a.target[2] < 0.02 for a in found), "low targets were meant to be tried"
    # and where nothing else is to be had, that is said
    with pytest.raises(SceneError, match="no target of 200 can be reached"):
        aims(model, view(top=False, under=0.008), count=1)


def test_blocked_targets_are_drawn_again(model):
    # points 30 mm under the top: the probe meets the top first, far before them
    found = aims(model, view(side=False, inside=True), count=20)
    assert all(a.target[2] == SIZE[2] for a in found)
    with pytest.raises(SceneError, match="no target of 200"):
        aims(model, view(top=False, side=False, inside=True), count=1)


def test_asking_for_more_keeps_the_first(model):
    few, many = aims(model, view(), count=3), aims(model, view(), count=8)
    for a, b in zip(few, many):
        assert np.array_equal(a.target, b.target) and np.array_equal(a.contact, b.contact)
        # the depth is cut by one batched linear solve: equal, but for rounding of a batch of another width
        assert a.depth == pytest.approx(b.depth, rel=1e-6)


@pytest.mark.slow
def test_a_response_that_was_not_found_tells_no_depth(model, monkeypatch):
    """A touch of shoes-v2 has 29 kN in its first frame, which is no equilibrium: the mount stopped at first contact."""
    known, run = aims(model, view(), force_limit=0.4, count=4), Solver.run

    def broken(lost):
        def give(self, poses, **options):
            found = run(self, poses, **options)
            found.converged[lost] = False
            found.force[lost], found.unbalanced_force[lost] = np.nan, 3e4
            return found
        return give

    for lost in ([1, 3], [-1]):  # between frames that are known, and past the last of them
        monkeypatch.setattr(Solver, "run", broken(lost))
        # a straight line for a force that grows with the power 1.5: the press ends sooner, hardly ever later
        for a, b in zip(known, aims(model, view(), force_limit=0.4, count=4), strict=True):
            assert 0.5 * a.depth < b.depth < 1.1 * a.depth
    monkeypatch.setattr(Solver, "run", broken(slice(None)))
    with pytest.raises(SceneError, match=r"the linear response to the touch at .* was not found"):
        aims(model, view(), force_limit=0.4, count=4)


def test_force_limit_cuts_the_depth(model):
    limit = 0.4
    whole, cut = aims(model, view(), force_limit=1e6), aims(model, view(), force_limit=limit)
    assert all(a.depth == SCENE.touches.depth for a in whole)
    assert all(b.depth <= a.depth for a, b in zip(whole, cut)) and any(b.depth < a.depth for a, b in zip(whole, cut))
    poses = np.stack([probe_pose(SCENE.probe, a.contact + a.depth * a.axis, a.axis) for a in cut])[None]
    options = SolverOptions(tolerance=1e-6, local_indentation=True)
    force = np.linalg.norm(Solver(model, SCENE.probe, options=options, linear=True).run(poses).force[0], axis=1)
    # between the eighths of the depth at which it was measured the curve is taken as straight; it is convex as a whole
    # (d^1.5), so that the true force lies under the chord by up to a tenth. Contact points come in one by one, and the
    # curve is lumpy between them: 0.2 % over the limit was measured
    assert (force <= limit * 1.05).all()
    shortened = np.array([b.depth < SCENE.touches.depth for b in cut])
    assert (force[shortened] > 0.8 * limit).all()


# ------------------------------------------------------------------------------------------ probe stiffness


def test_probe_stiffness_of_a_half_space(block, graded):
    """Uniform pressure p on a disc of radius a: mean displacement 16 p a (1 - nu^2) / (3 pi E) (Timoshenko and Goodier,
    art. 139)."""
    young_modulus, nu, size = 1e5, 0.3, 0.4
    ticks = graded(0.002, 2, 2.2, size)
    model = block((size, size, size), None, young_modulus=young_modulus, poisson_ratio=nu,
                  ticks=(ticks, ticks, size - ticks[::-1]))
    # a quarter between rollers carries a quarter of the disc
    held = (model.free == 0.0).reshape(-1, 3)
    held[:, :2] |= model.mesh.points[:, :2] < 1e-12
    found = 4.0 * probe_stiffness(rollers(model, held), np.array([[0.0, 0.0, size]]), np.array([[0.0, 0.0, 1.0]]))[0]
    exact = 3 * np.pi**2 * PROBE_RADIUS * young_modulus / (16 * (1 - nu**2))
    # the disc is made of the points of a barycentric grid, 8 along an edge of 2 mm: its radius of 4 mm is good to ~2 %,
    # and so is the stiffness; the base 100 radii below stiffens by 0.6 %, two elements across the radius by ~1 %
    assert found == pytest.approx(exact, rel=0.03)


def test_a_corner_of_a_box_meets_a_tilted_plane_where_geometry_says():
    """The plane z = x / 10 of two triangles, and a box of 40 mm whose base is 50 mm up: the corner at x = 20 mm is
    first, after 48 mm, whichever corner of a triangle is its first. As a sheet the plane meets the fillet of 0.4 mm."""
    square = np.array([[-0.1, -0.1], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]])
    mesh = SimpleNamespace(points=np.column_stack([square, 0.1 * square[:, 0]]))
    sheet = np.array([[1, 2, 0], [2, 3, 0]])
    solid = np.tile(sheet, 2)
    pose = np.eye(4)
    pose[2, 3] = 0.07
    for mesh.faces, way in ((solid, 0.048), (np.roll(solid, 1, axis=1), 0.048), (sheet, 0.048038)):
        found = clearance(SimpleNamespace(mesh=mesh, element_size=0.02), Box((0.04, 0.04, 0.04)),
                          pose, np.array([0.0, 0.0, -1.0]), samples=np.array([[0.0, 0.0, -100.0]]))
        assert found == pytest.approx(way, abs=3e-6 if mesh.faces is sheet else 1e-9)
