"""Read-outs of the bubble: interpolation by material coordinates, and forces that keep their net force and moment."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parent))
from toy_bubble import disc

from vsfsim.sensing.bubble import BubbleReadout, FlatMesh, locate, wrench
from vsfsim.sensing.membrane_fe import SensorError


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


def test_weights_interpolate_what_is_linear(fine, coarse):
    nodes, weight = locate(coarse.points, fine)
    assert weight.sum(axis=1) == pytest.approx(1.0) and weight.min() >= 0.0
    found = np.einsum("ka,kai->ki", weight, fine.points[nodes])
    assert found[~coarse.rim] == pytest.approx(coarse.points[~coarse.rim], abs=1e-12)
    # rims are polygons: the other mesh's rim nodes bulge out by at most the sagitta of a chord, here of 1/102 and 1/36 of the way round
    assert np.linalg.norm(found - coarse.points, axis=1).max() < 0.05725 * (1 - np.cos(np.pi / 102))
    nodes, weight = locate(fine.points, coarse)
    assert np.linalg.norm(np.einsum("ka,kai->ki", weight, coarse.points[nodes]) - fine.points, axis=1).max() < 0.05725 * (1 - np.cos(np.pi / 36))
    own, weight = locate(fine.points, fine)
    assert own[np.arange(len(own)), weight.argmax(axis=1)].tolist() == list(range(len(fine.points))) and weight.max(axis=1) == pytest.approx(1.0)


def test_positions_follow_the_skin(fine, coarse):
    readout = BubbleReadout(fine, coarse)
    shape = dome(fine.points)
    shift = shape + [0.001, 0.002, -0.003]
    out = readout.positions(np.stack([shape, shift]))
    assert out[1] - out[0] == pytest.approx(np.tile([0.001, 0.002, -0.003], (len(coarse.points), 1)))
    # chords of 1/17 of the radius are under 30 mm (1/17)^2 below the dome
    assert np.abs(out[0] - dome(coarse.points)).max() < 0.030 / 17**2 + 1e-9
    same = BubbleReadout(coarse, coarse)
    assert (same.positions(shape[None, :len(coarse.points)]) == shape[None, :len(coarse.points)]).all()


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


def test_frames_hold_everything(fine, coarse):
    points = np.stack([dome(fine.points)] * 3)
    force = np.zeros_like(points)
    force[2, 0] = [0.0, 0.0, -2.0]  # at the apex, the first point of the disc
    out = BubbleReadout(fine, coarse).frames(points, force, np.array([7000.0, 7010.0, 7300.0]), rest_pressure=7000.0, origin=np.array([0.1, 0.0, 0.0]))
    assert out.pressure_change.tolist() == [0.0, 10.0, 300.0]
    assert out.force[2].tolist() == [0.0, 0.0, -2.0] and (out.force[:2] == 0).all()
    assert out.moment[2] == pytest.approx([0.0, -0.2, 0.0])  # (-0.1, 0, h) x (0, 0, -2)
    assert out.node_force[2, 0] == pytest.approx([0.0, 0.0, -2.0])
    assert out.node_position.shape == (3, len(coarse.points), 3)


def test_what_it_refuses(fine, coarse):
    readout = BubbleReadout(fine, coarse)
    points = dome(fine.points)[None]
    with pytest.raises(SensorError, match="all nodes of the solver's mesh"):
        readout.positions(points[:, :5])
    with pytest.raises(SensorError, match="frames of positions"):
        readout.forces(points, np.concatenate([points, points]))
    with pytest.raises(SensorError, match="pressure has shape"):
        readout.frames(points, points, np.zeros(2), rest_pressure=0.0)
    with pytest.raises(SensorError, match="rim"):
        FlatMesh(coarse.points, coarse.triangles, np.zeros(3, bool))
