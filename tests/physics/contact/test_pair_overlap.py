"""How deep a membrane and a soft body lie in one another, between their contact points too."""

import numpy as np
import pytest
import torch
from texts import scene

from vsfsim.core.bubble import Bubble
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.physics.contact.intrusion import PairOverlap


@pytest.fixture(scope="module")
def bubble():
    return build_bubble(Bubble(nodes=200))


def block(size=(0.10, 0.10, 0.04)):
    shape = f"{{ box = {list(size)} }}"
    return tiers.build(scene("block", shape=shape, resolution=0.02, press=None).sample(0), "fem-coarse")


def depth(body, bubble, places):
    """Depth (k,) of the overlap with the sensor's origin at ``places`` (k, 3) [m], looking down."""
    turn = torch.as_tensor(np.tile(np.diag([1.0, -1.0, -1.0]), (len(places), 1, 1)))
    check = PairOverlap(body, bubble, device="cpu")
    u = torch.zeros(body.mesh.points.size + bubble.mesh.points.size, len(places), dtype=torch.float64)
    found = check.check(torch.arange(len(places)), turn, torch.as_tensor(np.array(places, float))[:, None], u)
    return found.numpy(), check.tolerance


def test_a_flat_top_is_as_deep_as_the_apex_is_below_it(bubble):
    top, apex = 0.04, bubble.mesh.points[:, 2].max()
    found, tolerance = depth(block(), bubble, [(0.0, 0.0, top + apex - d) for d in (-0.001, 0.0005, 0.004)])
    assert found == pytest.approx([0.0, 0.0005, 0.004], abs=1e-12)
    assert found[1] < tolerance < found[2]


def test_a_corner_of_the_block_in_the_middle_of_a_triangle_is_found(bubble):
    """No node of the membrane is inside the block: the corner is as deep as it is behind the triangle's plane."""
    points, corners = bubble.mesh.points, bubble.mesh.points[bubble.mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    # a flank of the dome that looks to -x and +y, over a corner of a small block that points there
    face = int((normal @ np.array([-1.0, 1.0, 1.0])).argmax())
    middle, below = corners[face].mean(axis=0), 0.001
    turn = np.diag([1.0, -1.0, -1.0])
    place = np.array([0.015, 0.015, 0.04]) - turn @ (middle - below * normal[face])
    found, _ = depth(block((0.03, 0.03, 0.04)), bubble, [place])
    inside = (np.abs((points @ turn.T + place)[:, :2]) < 0.015).all(axis=1) & ((points @ turn.T + place)[:, 2] < 0.04)
    assert not inside.any() and found[0] == pytest.approx(below, rel=1e-6)


def test_what_goes_around_the_sensor_is_outside(bubble):
    """Beside the dome and under the plane of its rim there is nothing to be inside of."""
    found, _ = depth(block((0.20, 0.20, 0.04)), bubble, [(0.17, 0.0, 0.03), (0.0, 0.0, -0.05), (0.0, 0.0, 0.20)])
    assert (found == 0.0).all()
