"""Thickness and place in a picture: ribbons of known width, a part before another, and ways along branches."""

from __future__ import annotations

import numpy as np
import pytest

from vsfsim.data.records import View
from vsfsim.vsf.features.registry import particle_features, view_token
from vsfsim.vsf.features.thickness import local_thickness, place


def picture(depth):
    """A view whose camera looks along +y from (0, -1, 0.5) m, 1 mm a pixel at 1 m, rows downwards; ``depth`` (H, W)."""
    height, width = depth.shape
    pose = np.eye(4)
    pose[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    pose[:3, 3] = [0.0, -1.0, 0.5]
    intrinsics = np.array([[1000.0, 0.0, width / 2 - 0.5], [0.0, 1000.0, height / 2 - 0.5], [0.0, 0.0, 1.0]])
    return View(np.full((*depth.shape, 3), 90, np.uint8), depth.astype(np.float32), depth > 0.0, intrinsics, pose)


def test_a_ribbon_has_its_width_and_a_blade_before_a_wall_its_own():
    depth = np.zeros((200, 200))
    depth[20:180, 30:36] = 1.0  # 6 mm
    depth[20:180, 100:140] = 1.0  # 40 mm
    found = local_thickness(picture(depth))
    assert np.median(found[60:140, 30:36]) == pytest.approx(0.006, abs=0.001)
    assert np.median(found[60:140, 110:130]) == pytest.approx(0.040, abs=0.004)
    assert (found[:, :30] == 0.0).all()
    depth = np.full((200, 200), 1.05)
    depth[:, 90:102] = 1.0  # 12 mm, 50 mm before a wall
    found = local_thickness(picture(depth))
    assert np.median(found[60:140, 93:99]) == pytest.approx(0.012, abs=0.002)
    assert np.median(found[60:140, 20:40]) > 0.05


def test_the_way_follows_the_branch_and_crosses_a_gap_at_a_price():
    """An upright U turned over: the free end of the second leg is near the foot, and its way is long."""
    depth = np.zeros((300, 120))
    depth[20:290, 20:30] = 1.0
    depth[20:30, 20:100] = 1.0
    depth[20:200, 90:100] = 1.0
    view = picture(depth)
    where = np.full(depth.shape + (3,), np.nan)
    where[view.mask] = place(view)
    way, axis, height = np.moveaxis(where, 2, 0)
    # up 0.26 m, across 0.07 m, down 0.17 m; the graph's paths are some per cent longer or shorter
    assert way[198, 95] == pytest.approx(0.26 + 0.07 + 0.17, rel=0.12)
    assert way[150, 25] == pytest.approx(0.13, abs=0.02)
    assert axis[198, 95] == pytest.approx(0.07, abs=0.01) and height[20, 25] == pytest.approx(0.269, abs=0.01)
    depth[100:140, 90:100] = 0.0  # the end of the leg is cut off: 40 mm of air count ten times, less than around
    cut = picture(depth)
    where = np.full(depth.shape + (3,), np.nan)
    where[cut.mask] = place(cut)
    assert where[198, 95, 0] > way[198, 95] + 0.15


def test_place_is_thickness_and_place_alone_as_logarithms():
    """On a stem of 20 mm, 0.25 m high, with an arm of 6 mm to the side near its top."""
    depth = np.zeros((300, 220))
    depth[40:290, 20:40] = 1.0
    depth[60:66, 40:200] = 1.0
    view = picture(depth)
    ends = np.array([[-0.08, 0.0, 0.40], [-0.08, 0.0, 0.55], [0.08, 0.0, 0.5870]])  # low and high in the stem; the arm
    found = particle_features("place", view, ends, spacing=0.01)
    assert found.shape == (3, 6) and np.isfinite(found).all() and np.isfinite(view_token("place", view)).all()
    thick, way, axis, height = np.exp(found[:, :4].T)
    assert thick[:2] == pytest.approx(0.020, rel=0.1) and thick[2] == pytest.approx(0.006, rel=0.2)
    assert axis - 0.05 == pytest.approx([0.0, 0.0, 0.16], abs=0.012)
    assert height - 0.05 == pytest.approx([0.04, 0.19, 0.227], abs=0.012)
    along = np.array([0.025, 0.175, 0.225 - 0.015 + 0.15])
    # a voxel of 10 mm at the end, and some per cent more or less along the graph
    assert (np.abs(way - 0.05 - along) < 0.010 + 0.12 * along).all()
