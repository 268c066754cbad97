"""Read-outs of the bubble: interpolation by material coordinates, and forces that keep their net force and moment."""

import numpy as np
import pytest

from vsfsim.physics.bubble.sensor import FlatMesh
from vsfsim.physics.mesh.structured import disc
from vsfsim.sensing.bubble import BubbleReadout


def wrench(points, force):
    """Net force and moment about the origin (T, 3) of forces (T, n, 3) at points (T, n, 3)."""
    return force.sum(axis=1), np.cross(points, force).sum(axis=1)


def flat(rings):
    points, triangles = disc(1.0, rings)
    return FlatMesh(points * [0.05725, 0.040], triangles, np.arange(len(points))[-6 * rings:])


def dome(points):
    rho = np.hypot(points[:, 0] / 0.05725, points[:, 1] / 0.040)
    return np.column_stack([points, 0.030 * np.maximum(1.0 - rho**2, 0.0)])


@pytest.mark.parametrize("where", ["everywhere", "one node", "rim"])
def test_net_force_and_moment_are_kept(where):
    rng, fine, coarse = np.random.default_rng(1), flat(17), flat(6)
    points = np.stack([dome(fine.flat), dome(fine.flat) + 0.002 * rng.standard_normal((len(fine.flat), 3))])
    force = rng.standard_normal(points.shape)
    if where == "one node":
        force[:, np.arange(len(fine.flat)) != 400] = 0.0
    if where == "rim":
        force[:, :-6 * 17] = 0.0
    readout = BubbleReadout(fine.flat, fine.faces, coarse)
    moved = readout.forces(points, force)
    nodes = readout.positions(points)
    origin = np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 0.3]])
    for before, after in zip(wrench(points - origin[:, None], force), wrench(nodes - origin[:, None], moved)):
        assert after == pytest.approx(before, abs=1e-12 * np.abs(force).sum())
    # and it stays local: what acts on one node is spread over one triangle and is about as large
    if where == "one node":
        assert (np.linalg.norm(moved[0], axis=1) > 0).sum() <= 3
        assert np.linalg.norm(moved[0], axis=1).max() < 3 * np.linalg.norm(force[0, 400])


@pytest.fixture(scope="module")
def model():
    from vsfsim.core.bubble import Bubble
    from vsfsim.physics.bubble.sensor import build_bubble
    return build_bubble(Bubble(nodes=200))


def test_the_real_sensor_is_read_on_its_390_nodes(model):
    from vsfsim.sensing.bubble import readout_of

    readout, inner = readout_of(model), np.ones(390, bool)
    inner[model.read_out.rim] = False
    assert len(readout.readout.flat) == 390 and len(readout.readout.faces) == 714 and inner.sum() == 390 - 64
    nodes = readout.positions(model.mesh.points[None])[0]
    assert np.abs(nodes[~inner, 2]).max() < 1e-12  # the rim is planar
    # linear functions of the material are interpolated exactly, but outside the coarser rim
    off = readout.positions(np.pad(model.flat, ((0, 0), (0, 1)))[None])[0, :, :2] - readout.readout.flat
    assert np.abs(off[inner]).max() < 1e-12
    # and a force on any node keeps its moment
    force = np.zeros((1, len(model.mesh.points), 3))
    force[0, ::7] = np.random.default_rng(0).standard_normal((len(force[0, ::7]), 3))
    before = wrench(model.mesh.points[None], force)
    after = wrench(nodes[None], readout.forces(model.mesh.points[None], force))
    assert after[0] == pytest.approx(before[0], abs=1e-12) and after[1] == pytest.approx(before[1], abs=1e-13)
