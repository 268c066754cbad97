"""Read-outs of the bubble: interpolation by material coordinates, and forces that keep their net force and moment."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_bubble import disc

from vsfsim.sensing.bubble import BubbleReadout, FlatMesh, wrench


def flat(rings):
    points, triangles, rim = disc(rings)
    held = np.zeros(len(points), bool)
    held[rim] = True
    return FlatMesh(points, triangles, held)


def dome(points):
    rho = np.hypot(points[:, 0] / 0.05725, points[:, 1] / 0.040)
    return np.column_stack([points, 0.030 * np.maximum(1.0 - rho**2, 0.0)])


@pytest.fixture(scope="module")
def fine():
    return flat(17)


@pytest.fixture(scope="module")
def coarse():
    return flat(6)


@pytest.mark.parametrize("where", ["everywhere", "one node", "rim"])
def test_net_force_and_moment_are_kept(fine, coarse, where):
    rng = np.random.default_rng(1)
    points = np.stack([dome(fine.points), dome(fine.points) + 0.002 * rng.standard_normal((len(fine.points), 3))])
    force = rng.standard_normal(points.shape)
    if where == "one node":
        force[:, np.arange(len(fine.points)) != 400] = 0.0
    if where == "rim":
        force[:, ~fine.rim] = 0.0
    readout = BubbleReadout(fine, coarse)
    moved = readout.forces(points, force)
    nodes = readout.positions(points)
    origin = np.array([[0.0, 0.0, 0.0], [0.1, -0.2, 0.3]])
    for before, after in zip(wrench(points, force, origin=origin), wrench(nodes, moved, origin=origin)):
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

    readout = readout_of(model)
    assert (len(readout.readout.points) == 390 and len(readout.readout.triangles) == 714
            and readout.readout.rim.sum() == 64)
    nodes = readout.positions(model.mesh.points[None])[0]
    inner = ~readout.readout.rim
    # the sensor's own interpolation, which differs outside the finer rim alone
    assert nodes[inner] == pytest.approx(model.read_out.positions(model.mesh.points)[inner], abs=1e-12)
    assert np.abs(nodes[~inner, 2]).max() < 1e-12  # the rim is planar
    # and a force on any node keeps its moment
    force = np.zeros((1, len(model.mesh.points), 3))
    force[0, ::7] = np.random.default_rng(0).standard_normal((len(force[0, ::7]), 3))
    before = wrench(model.mesh.points[None], force)
    after = wrench(nodes[None], readout.forces(model.mesh.points[None], force))
    assert after[0] == pytest.approx(before[0], abs=1e-12) and after[1] == pytest.approx(before[1], abs=1e-13)


def test_the_pressure_is_that_of_the_solvers_gas(model):
    import warp as wp

    from vsfsim.physics.solve.elasticity import Elasticity
    from vsfsim.sensing.bubble import gauge_pressure

    u = np.zeros_like(model.mesh.points)
    u[:, 2] = -0.2 * model.mesh.points[:, 2]
    elastic = Elasticity(model, device="cpu")
    elastic.begin(1)
    elastic.forces(wp.zeros(1, dtype=wp.int32, device="cpu"),
                   wp.array(u.reshape(-1, 1), dtype=wp.float64, device="cpu"))
    found = gauge_pressure(model, np.stack([model.mesh.points, model.mesh.points + u]))
    assert found[0] == pytest.approx(model.pressure, rel=1e-9)
    assert found[1] == pytest.approx(float(elastic.pressure.numpy()[0]), rel=1e-9)
    assert found[1] > model.pressure + 1000.0
