"""A dataset felt by a bubble: aims, paths and limits; whole and readable; what is refused."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from texts import scene

from vsfsim.core.bubble import Bubble
from vsfsim.core.dome import Dome
from vsfsim.core.errors import SceneError
from vsfsim.core.shape import parse_probe_shapes, probe_table
from vsfsim.data.dataset import Dataset
from vsfsim.data.verify import skin_loss, verify
from vsfsim.generate import bubble_touch as touch_bubble
from vsfsim.generate.aim import Aim, tilted
from vsfsim.generate.resim import again
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.robot.path import turn_to


def rim_of(triangles, nodes):
    """True (n,) at the nodes of an edge that belongs to one triangle alone."""
    edges, count = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1),
                             axis=0, return_counts=True)
    return np.isin(np.arange(nodes), edges[count == 1])


@pytest.fixture(scope="module")
def made(generated):
    return generated("felt").path


def test_it_verifies_and_every_frame_is_the_bubbles(made):
    report = verify(made)
    assert report.ok and report.touches == 2 and report.unconverged == 0, report.text()
    (view,) = Dataset.open(made)
    assert isinstance(view.probe, Dome) and view.probe.height == pytest.approx(0.0305, abs=0.001)
    # inside the rim, openvsf's A_base
    assert ConvexHull(view.probe.points[:, :2]).volume == pytest.approx(7.18e-3, rel=0.01)
    gas = Bubble()
    for touch in view.touches:
        assert touch.touched and touch.rest_pressure == gas.gauge_pressure
        # free, then in: pressure and force rise together
        assert touch.pressure[0] == pytest.approx(gas.gauge_pressure,
                                                  abs=1e-3) and (np.diff(touch.pressure) > 10.0).all()
        force = touch.normal_force()
        assert force[0] == 0.0 and force[2] > force[1] > 0.1
        # what the nodes feel is the force, and its moment about the mount the stored one
        node, push = touch.node_position.astype(float), touch.node_force.astype(float)
        assert push.sum(axis=1) == pytest.approx(touch.force, abs=1e-4)
        assert np.cross(node - touch.mount_pose[:, None, :3, 3],
                        push).sum(axis=1) == pytest.approx(touch.moment, abs=1e-5)
        # the rim is clamped to the mount, and so is the rest shape what the first frame shows
        local = np.einsum("tni,tij->tnj", node - touch.mount_pose[:, None, :3, 3], touch.mount_pose[:, :3, :3])
        rim = rim_of(touch.node_triangles, len(touch.node_rest))
        assert local[:, rim] == pytest.approx(np.broadcast_to(touch.node_rest[rim], local[:, rim].shape), abs=1e-6)
        assert local[0] == pytest.approx(touch.node_rest,
                                         abs=1e-6) and view.probe.points == pytest.approx(touch.node_rest, abs=1e-8)
        # the mesh that was solved carries the same forces and starts from the same dome
        assert touch.fine_position.shape == touch.fine_force.shape == (3, 100, 3)
        on_rim = int(rim_of(touch.fine_triangles, 100).sum())
        assert touch.fine_triangles.shape == (2 * 100 - 2 - on_rim, 3)  # Euler, of a disc
        assert touch.fine_force.astype(float).sum(axis=1) == pytest.approx(touch.force, abs=1e-4)
        fine = np.einsum("tni,tij->tnj", touch.fine_position - touch.mount_pose[:, None, :3, 3],
                         touch.mount_pose[:, :3, :3])
        assert fine[0] == pytest.approx(touch.fine_rest, abs=1e-6)
        assert fine[:, rim_of(touch.fine_triangles, 100), 2] == pytest.approx(0.0, abs=1e-6)
        volume = np.array([dome_volume(x, touch.fine_triangles) for x in fine])
        kept = (touch.pressure + 101325.0) * (volume + gas.gas_volume - volume[0]) ** gas.gamma
        assert kept == pytest.approx(kept[0], rel=1e-6), "the solved gas law, to the rounding of the stored positions"
        assert touch.inside_rgb.shape == (3, 12, 16, 3) and (touch.inside_depth > 0.02).mean() > 0.5
        # it came straight along the normal, and depth counts from first contact
        way = (touch.mount_pose[:, :3, 3] - touch.mount_pose[0, :3, 3]) @ touch.axis
        assert way == pytest.approx([0.0, 0.005 + 0.0015, 0.005 + 0.003], abs=1e-9)
        assert touch.mount_pose[:, :3, 2] == pytest.approx(np.broadcast_to(touch.axis, (3, 3)))
    assert view.truth.vsf_touched.any() and np.isfinite(view.truth.vsf_stiffness).all()


def test_a_plan_made_again_is_the_touch(made):
    dataset = Dataset.open(made)
    (view,) = dataset
    plan = SimpleNamespace(poses=view.touches[1].mount_pose, axis=view.touches[1].axis, probe=view.probe)
    (found,) = again(dataset.recipe, view.name, [plan])
    # frames are balanced to 1e-4 of the acting force, and the sideways parts are small differences of large forces
    bound = 1e-4 * np.abs(view.touches[1].force).max()
    assert found.force == pytest.approx(view.touches[1].force, rel=1e-3, abs=bound)
    assert found.pressure - found.rest_pressure == pytest.approx(
        view.touches[1].pressure - view.touches[1].rest_pressure, rel=1e-3, abs=1e-2)


def test_a_read_out_that_loses_force_is_found(made):
    touch = Dataset.open(made).load("felt-0000-v0").touches[0]
    assert skin_loss(touch) is None and skin_loss(dataclasses.replace(touch, node_force=None)) is None
    frame, off = skin_loss(dataclasses.replace(touch, node_force=0.99 * touch.node_force))
    assert frame == 1 and off == pytest.approx(0.01 * np.linalg.norm(touch.force[1]), rel=1e-3)


def dome_volume(points, triangles):
    """Between a surface over the rim plane and that plane [m^3]."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    return float((area * (a[:, 2] + b[:, 2] + c[:, 2]) / 3.0).sum())


def test_a_dome_is_read_back_and_knows_its_heights(made):
    (view,) = Dataset.open(made)
    (again,) = parse_probe_shapes(probe_table(view.probe), "here")
    assert again == view.probe
    at = again.points[:, :2]
    assert again.heights(at) == pytest.approx(again.points[:, 2], abs=1e-9)
    assert again.heights(np.array([[0.0, 0.05], [0.06, 0.0]])).tolist() == [-np.inf, -np.inf]
    with pytest.raises(SceneError, match="unknown key 'vertixes'"):
        parse_probe_shapes({"dome": {"vertixes": []}}, "here")


# ------------------------------------------------------------------------------------------ aims


def test_first_contact_is_where_the_dome_meets_the_body():
    dome = touch_bubble.dome_of(build_bubble(Bubble(nodes=100)))
    grid = np.stack(np.meshgrid(np.linspace(-0.1, 0.1, 81), np.linspace(-0.1, 0.1, 81)), axis=-1).reshape(-1, 2)
    floor = np.column_stack([grid, np.zeros(len(grid))])
    down = np.array([0.0, 0.0, -1.0])
    assert touch_bubble.first_contact(dome, floor, np.zeros(3),
                                      down) == pytest.approx([0.0, 0.0, dome.height], abs=1e-4)
    # a post beside the target, 20 mm high: met by the flank of the dome, whose skin is lower there
    post = np.vstack([floor, [[0.03, 0.0, 0.02]]])
    turn = turn_to(down, touch_bubble.LEADING)
    flank = dome.heights((np.array([[0.03, 0.0, 0.0]]) @ turn)[:, :2])[0]
    assert touch_bubble.first_contact(dome, post, np.zeros(3), down)[2] == pytest.approx(0.02 + flank, abs=1e-9)
    assert 0.02 + flank > dome.height


def test_tilted_directions_fill_a_cone():
    rng = np.random.default_rng(0)
    axis = np.array([0.6, 0.0, -0.8])
    drawn = np.array([tilted(axis, 0.5, rng) for _ in range(2000)])
    assert np.linalg.norm(drawn, axis=1) == pytest.approx(1.0)
    cosine = drawn @ axis
    # even by solid angle: cosines are uniform from cos 0.5 to 1, of standard error (1 - cos 0.5) / sqrt(12 * 2000) =
    # 8e-4; sideways they cancel
    assert cosine.min() >= np.cos(0.5) and cosine.mean() == pytest.approx(0.5 * (1.0 + np.cos(0.5)), abs=4e-3)
    assert np.abs((drawn - cosine[:, None] * axis).mean(axis=0)).max() < 0.03


@pytest.mark.slow
def test_the_force_limit_of_a_flat_wall():
    model = build_bubble(Bubble(nodes=390))
    depth = np.array([touch_bubble.depth_at(model, force) for force in (5.0, 20.0, 60.0)])
    assert (np.diff(depth) > 0.0).all() and np.isinf(touch_bubble.depth_at(model, 1e5))
    # a cap of an ellipsoid with the apex curvatures of the real dome, 13.8 and 25.0 1/m: pi 2 d / sqrt(k1 k2); its
    # pressure hardly rises yet
    assert depth[0] == pytest.approx(5.0 / (7820.0 * 2.0 * np.pi / np.sqrt(13.8 * 25.0)), rel=0.2)


def test_the_way_out_is_over_readings_of_the_way_in():
    spec = dataclasses.replace(scene("felt").sample(0).touches, frames=(2, 3, 1, 2))
    a = Aim(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, 0, -1.0]), np.array([0, 0, 0.03]), 0.006)
    poses = touch_bubble.mount_path(spec, a)
    assert poses[:, 2, 3] == pytest.approx([0.035, 0.035, 0.028, 0.026, 0.024, 0.024, 0.026, 0.028])
    assert poses[:, :3, 2] == pytest.approx(np.tile([0.0, 0.0, -1.0], (8, 1)))
