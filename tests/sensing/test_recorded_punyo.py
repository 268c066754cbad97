"""A recorded Punyo: a dome that is drawn here, by an exact deformation, is read back from pictures and clouds."""

import numpy as np
import pytest
from drawn_punyo import punyo
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from vsfsim.sensing.bubble_touch import estimate_forces, rim_of
from vsfsim.sensing.membrane_fe import SensorError
from vsfsim.sensing.recorded_punyo import read_sequence
from vsfsim.sensing.track import track

SIZE, FOCAL, CENTRE = (260, 340), 217.0, (160.0, 130.0)
REST = 7820.0


def speckle(rng, shape):
    return 255.0 * (gaussian_filter(rng.standard_normal(shape), 2.0, mode="wrap") > 0.0)


def test_points_are_followed_over_a_known_warp():
    rng = np.random.default_rng(0)
    before = gaussian_filter(speckle(rng, (200, 260)), 1.0)
    row, column = np.mgrid[:200.0, :260.0]
    # where each pixel of the second picture comes from: a shift that grows towards a corner
    dx, dy = 3.0 + 0.01 * column, -2.0 + 0.01 * row
    after = 0.8 * map_coordinates(before, [row - dy, column - dx], order=3, mode="nearest") + 20.0
    points = rng.uniform([50, 40], [200, 150], (40, 2))
    found, likeness = track(before, after, points)
    assert likeness.min() > 0.9
    back = np.stack([3.0 + 0.01 * found[:, 0], -2.0 + 0.01 * found[:, 1]], axis=1)
    assert np.abs(found - back - points).max() < 0.15
    flat, alike = track(np.zeros((200, 260)), after, points)
    assert (alike == -1.0).all() and np.isfinite(flat).all()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Two frames at rest and two in which the dome is moved by a smooth field; the picture is painted on the skin."""
    folder, rng = tmp_path_factory.mktemp("punyo"), np.random.default_rng(1)
    bubble = punyo(np.eye(4))
    vertices, faces = bubble.vertices, bubble.triangles[:714]
    paint = gaussian_filter(speckle(rng, (700, 700)), 1.5)
    weight = rng.dirichlet(np.ones(3), (len(faces), 180))
    samples = np.einsum("fkc,fcx->fkx", weight, vertices[faces]).reshape(-1, 3)
    spot = vertices[np.argmax(vertices[:, 2])] + [0.008, 0.006, 0.0]
    axis = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2))).sum(axis=0)
    axis /= np.linalg.norm(axis)
    height = np.clip((samples - vertices[rim_of(faces, len(vertices))].mean(axis=0)) @ axis, 0.0, None) / 0.03

    def moved(points, share, high):
        dent = share * np.exp(-((points - spot) ** 2).sum(axis=1) / 0.012**2) * high
        return points + dent[:, None] * (0.3 * np.array([0.0, 1.0, 0.0]) - axis)

    colour = paint[tuple((np.rint(samples[:, [0, 1]] * 4500 + 300).astype(int) % 700).T)]
    for k, share in enumerate((0.0, 0.0, 0.004, 0.006)):
        here = moved(samples, share, height)
        pixel = np.rint(here[:, :2] / here[:, 2:] * FOCAL + CENTRE).astype(int)
        picture, cloud = np.zeros(SIZE), np.zeros((*SIZE, 3))
        count = np.zeros(SIZE)
        shown = ((pixel >= 0) & (pixel < SIZE[::-1])).all(axis=1)
        pixel = pixel[shown]
        np.add.at(picture, tuple(pixel[:, ::-1].T), colour[shown])
        np.add.at(count, tuple(pixel[:, ::-1].T), 1.0)
        some = count > 0
        picture[some] /= count[some]
        row, column = np.nonzero(some)
        ray = np.column_stack([(column - CENTRE[0]) / FOCAL, (row - CENTRE[1]) / FOCAL, np.ones(len(row))])
        nearest = cKDTree(here[:, :2] / here[:, 2:]).query(ray[:, :2])[1]
        cloud[row, column] = ray * here[nearest, 2:]
        np.save(folder / f"rgb_{k}.npy", np.repeat(picture[..., None], 3, axis=2).astype(np.uint8))
        np.save(folder / f"pc_{k}.npy", cloud.reshape(-1, 3).astype(np.float32))
        np.save(folder / f"pressure_{k}.npy", 1065.0 + 1e3 * share)
    own = np.clip((vertices - vertices[rim_of(faces, len(vertices))].mean(axis=0)) @ axis, 0.0, None) / 0.03
    return folder, vertices, faces, moved(vertices, 0.006, own)


def test_a_dome_that_is_dented_by_a_known_field_is_read_back(recorded):
    folder, vertices, faces, true = recorded
    found = read_sequence(folder, vertices, faces, rest_pressure=REST, reference=(0, 1))
    assert found.frames == (2, 3) and found.seen.sum(axis=1).min() > 0.7 * 326
    assert np.allclose(found.touch.pressure, [REST + 400.0, REST + 600.0])
    off = np.linalg.norm(found.touch.node_position[1] - true, axis=1)
    assert np.linalg.norm(true - vertices, axis=1).max() > 0.004
    assert off[found.seen[1]].max() < 6e-4 and off.max() < 0.0015 and off[rim_of(faces, len(vertices))].max() < 1e-12
    force = estimate_forces(found.touch, stiffness=680.0, method="paper")
    push = force.force.sum(axis=1)
    assert force.converged.all() and (push @ found.touch.axis < -1.0).all() and push[1] @ push[1] > push[0] @ push[0]


def test_what_is_missing_or_unfit_is_named(recorded, tmp_path):
    folder, vertices, faces, _ = recorded
    with pytest.raises(SensorError, match=r"rgb_9.npy cannot be read"):
        read_sequence(folder, vertices, faces, rest_pressure=REST, reference=(0,), frames=[9])
    with pytest.raises(SensorError, match=r"has 0 frames"):
        read_sequence(tmp_path, vertices, faces, rest_pressure=REST)
    with pytest.raises(SensorError, match=r"follows 0 of 326 nodes"):
        read_sequence(folder, vertices + [0.3, 0.0, 0.0], faces, rest_pressure=REST, reference=(0,))
