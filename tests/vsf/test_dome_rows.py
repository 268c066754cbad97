"""Particles and surface points under the free dome of a bubble: what a method that does not know the dent makes of a
touch."""

import numpy as np
import pytest

from vsfsim.bench.inclusions import reached
from vsfsim.core.dome import Dome
from vsfsim.vsf.dynamics import simulate
from vsfsim.vsf.fields.line_integrals import dome as cap
from vsfsim.vsf.observe import normal_force_rows


@pytest.fixture(scope="module")
def dome():
    points, triangles = cap(radius=0.03, height=0.015, rings=6)
    # apex up, rim in the plane z = 0
    return Dome.of(points * [1.0, 1.0, -1.0] + [0.0, 0.0, 0.015], triangles[:, ::-1])


def down(depths):
    """Poses that bring the apex ``depths`` [m] below z = 0."""
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (len(depths), 1, 1))
    poses[:, 2, 3] = 0.015 - np.asarray(depths)
    return poses


def test_particles_stick_to_the_skin_and_are_carried(dome):
    assert dome.heights(np.zeros((1, 2)))[0] == pytest.approx(0.015)
    particles = np.array([[0.0, 0.0, -0.001], [0.006, 0.0, -0.002], [0.0, 0.0, -0.02], [0.05, 0.0, -0.001]])
    depths = np.array([-0.004, 0.0, 0.003, 0.005, -0.004])
    moved = simulate(particles, dome, down(depths), friction=0.0)
    assert moved.frames == 5
    found = [dict(zip(*(x.tolist() for x in moved.frame(t)))) for t in range(5)]
    assert [sorted(f) for f in found] == [[], [], [0, 1], [0, 1],
                                          []], "one lies too deep, one beside; all are let go at the end"
    # met where the skin passes over them, then as deep as the mount goes on
    assert found[2][0] == pytest.approx([0.0, 0.0, -0.002],
                                        abs=1e-6) and found[3][0] == pytest.approx([0.0, 0.0, -0.004], abs=1e-6)
    # of the skin over the second one when the apex is at 0, and the particle's own depth
    below = dome.heights(np.array([[0.006, 0.0]]))[0] - 0.015 - 0.002
    assert found[3][1] == pytest.approx([0.0, 0.0, -0.005 - below], abs=1e-6)
    sideways = simulate(particles, dome, down(depths), friction=np.inf)
    assert np.array_equal(sideways.displacement, moved.displacement), "rubber sticks, whatever friction is asked for"
    rows = normal_force_rows(moved, 4, down(depths)[:, :3, 2])
    assert rows[3, 0] == pytest.approx(0.004, rel=1e-3) and (rows.toarray() >= 0.0).all()


def test_points_that_a_dome_reaches(dome):
    points = np.array([[0.0, 0.0, -0.001], [0.0, 0.0, -0.012], [0.05, 0.0, 0.0], [0.0, 0.0, 0.5]])
    assert reached(points, dome, down([-0.004, 0.005])).tolist() == [True, False, False, False]
    assert reached(points, dome, down([0.008])).tolist() == [True, True, False, False]


def test_a_triangle_has_vertices_that_are_there(dome):
    count = len(dome.vertices)
    assert Dome(dome.vertices, ((0, 1, count - 1),)).height == dome.height
    with pytest.raises(ValueError, match="of three vertices each that are there"):
        Dome(dome.vertices, ((0, 1, count),))
