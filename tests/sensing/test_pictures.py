"""The PNGs a user looks at: they hold what they should, checked by their pixels."""

import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy import ndimage
from scipy.spatial import Delaunay

from vsfsim.core.scene import CameraSpec
from vsfsim.core.shape import Sphere
from vsfsim.core.solid import Appearance
from vsfsim.data.contact_sheet import contact_sheet
from vsfsim.data.records import ObjectView, Touch
from vsfsim.sensing.camera import look_at, render
from vsfsim.sensing.cut import Elements, cut, opened
from vsfsim.sensing.portrait import portrait
from vsfsim.sensing.surface import Surface

RED = Appearance(np.array([[0.6, 0.02, 0.02]]), ("plain",), np.ones(1), np.zeros(1))


def block() -> Surface:
    mesh = trimesh.creation.box((0.1, 0.06, 0.05))
    vertices = np.asarray(mesh.vertices) + [0, 0, 0.025]
    return Surface(vertices, np.asarray(mesh.faces), np.zeros(12, int), RED, vertices)


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def reddish(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > 1.8 * image[..., 1]) & (image[..., 0] > 60)


def cells(stiff: float = 1e6) -> Elements:
    """A box of 0.1 x 0.1 x 0.05 m, whose part with x, y in 10 to 30 mm and z in 15 to 35 mm is stiff."""
    axes = [np.linspace(-0.05, 0.05, 11), np.linspace(-0.05, 0.05, 11), np.linspace(0.0, 0.05, 11)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    tets = Delaunay(points + 1e-4 * np.random.default_rng(0).standard_normal(points.shape) * (
        abs(points - [0, 0, 0.025]) < [0.049, 0.049, 0.024])).simplices
    away = abs(points[tets].mean(axis=1) - [0.02, 0.02, 0.025]).max(axis=1)
    volume = np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]])
    tets = np.where(volume[:, None] < 0.0, tets[:, [0, 2, 1, 3]], tets)[abs(volume) > 1e-12]
    return Elements(points, tets, np.where(away[abs(volume) > 1e-12] < 0.01, stiff, 1e5), np.arange(len(tets)))


@pytest.mark.parametrize("normal", [(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.48, -0.6, 0.64)])
@pytest.mark.parametrize("shift", [0.0, 0.0033])
def test_a_body_that_is_cut_open_is_closed_and_has_the_volume_that_is_left(normal, shift):
    body, normal = cells(), np.array(normal)
    place = np.array([0.0, 0.0, 0.025]) + shift * normal
    left = cut(body, (body.points - place) @ normal, normal)
    for stretch in (np.eye(3), np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.0], [0.2, 0.0, 1.0]])):  # of a deformed state
        a, b, c = np.moveaxis(left.at(body.points @ stretch.T)[left.triangles], 1, 0)
        area = np.cross(b - a, c - a) / 2.0
        assert abs(area.sum(axis=0)).max() < 1e-12, "a closed surface"
        volume = (area * a).sum() / 3.0
        fine = np.stack(np.meshgrid(*(np.linspace(-0.5, 0.5, 81)[1:] - 1 / 160,) * 3), axis=-1).reshape(-1, 3)
        part = ((fine * [0.1, 0.1, 0.05] + [0, 0, 0.025] - place) @ normal <= 0.0).mean()
        assert volume == pytest.approx(5e-4 * part * np.linalg.det(stretch), rel=0.01)


def test_the_face_of_a_cut_shows_the_elements_that_it_passes():
    body = cells()
    for y, met in ((0.02, True), (-0.02, False)):
        surface, shows = opened(body, np.array([0.0, -1.0, 0.0]), np.array([0.0, y, 0.0]))
        middle = surface.vertices[surface.triangles].mean(axis=1)
        face = (abs(middle[:, 1] - y) < 1e-4) & (shows >= 0)
        stiff = face & (body.young_modulus[shows] > 1e5)
        assert stiff.any() == met and (shows == -1).any()
        assert (abs(middle[stiff] - [0.02, y, 0.025]) <= 0.0101).all()


def test_the_picture_of_an_object_shows_it_from_two_sides_and_what_is_hidden_in_it(tmp_path):
    out = tmp_path / "block.png"
    portrait(block(), None, out, title="block")
    parts, count = ndimage.label(reddish(picture(out)))
    assert count == 2, "each whole and apart from the other"
    assert np.bincount(parts.ravel())[1:].min() > 20_000
    yellow = {}
    for stiff in (1e5, 1e6):
        portrait(block(), cells(stiff), out, title="block")
        image = picture(out)[:, :900]  # without the bar
        yellow[stiff] = int(((image[..., 1] > 150) & (image[..., 2] < 90)).sum())
    assert yellow[1e5] == 0 and yellow[1e6] > 1000


def object_view(index: int, touches: int) -> ObjectView:
    intrinsics, pose = look_at(CameraSpec(160, 120, 0.5, 0.4, 0.5 + index, 0.7), np.array([0, 0, 0.025]))
    view = render(block(), intrinsics, pose, 160, 120)
    cloud = view.points()
    made = []
    for k in range(touches):
        depth = np.array([0.0, 0.01, 0.02, 0.01])
        poses = np.repeat(np.eye(4)[None], 4, axis=0)
        poses[:, 2, 3] = 0.09 - depth
        force = np.zeros((4, 3))
        force[:, 2] = (k + 1) * 100 * np.maximum(depth - 0.005, 0)
        made.append(Touch(np.arange(4) / 30, poses, np.array([0, 0, -1.0]), cloud[k * 50], np.array([0, 0, 1.0]), force,
                          -force,
                          np.array([True, True, k != 1, True]), np.zeros(4), np.ones(4, int), k != 2, np.zeros(4, int)))
    return ObjectView(f"block-{index:04d}-v0", index, 0, "test", Sphere(0.02), view, tuple(made), None)


def test_contact_sheet_has_a_row_a_view(tmp_path):
    one, three = tmp_path / "one.png", tmp_path / "three.png"
    seen = object_view(0, 3)
    panel = contact_sheet([seen], one).axes[2]
    for line, touch in zip(panel.lines[::2], seen.touches, strict=True):
        ends = np.stack([touch.target, touch.target - 0.02 * touch.axis]) - seen.view.camera_pose[:3, 3]
        pixel = ends @ seen.view.camera_pose[:3, :3] @ seen.view.intrinsics.T
        assert line.get_xydata() == pytest.approx(pixel[:, :2] / pixel[:, 2:])
    rows, columns = (np.flatnonzero(seen.view.mask.any(axis=k)) for k in (1, 0))
    assert panel.get_ylim()[1] < rows[0] - 2 and rows[-1] + 2 < panel.get_ylim()[0], "the whole object is shown"
    assert panel.get_xlim()[0] < columns[0] - 2 and columns[-1] + 2 < panel.get_xlim()[1]
    contact_sheet([object_view(k, k) for k in range(3)], three, title="three")
    first, all_three = picture(one), picture(three)
    assert all_three.shape[1] == first.shape[1] and all_three.shape[0] > 2.8 * first.shape[0]
    assert reddish(first[:, : first.shape[1] // 4]).sum() > 1000
    # The curves: something coloured on the white of the last panel.
    last = first[:, 3 * first.shape[1] // 4:]
    assert ((last.max(axis=2) - last.min(axis=2)) > 60).sum() > 200
