"""The PNGs a user looks at: they hold what they should, checked by their pixels."""

import numpy as np
import trimesh
from PIL import Image
from scipy import ndimage

from vsfsim.core.scene import CameraSpec
from vsfsim.core.shape import Sphere
from vsfsim.core.solid import Appearance
from vsfsim.data.contact_sheet import contact_sheet
from vsfsim.data.records import ObjectView, Touch
from vsfsim.sensing.camera import look_at, render
from vsfsim.sensing.surface import Surface
from vsfsim.sensing.turntable import turntable

RED = Appearance(np.array([[0.6, 0.02, 0.02]]), ("plain",), np.ones(1), np.zeros(1))


def block() -> Surface:
    mesh = trimesh.creation.box((0.1, 0.06, 0.05))
    vertices = np.asarray(mesh.vertices) + [0, 0, 0.025]
    return Surface(vertices, np.asarray(mesh.faces), np.zeros(12, int), RED, vertices)


def picture(path) -> np.ndarray:
    return np.asarray(Image.open(path).convert("RGB")).astype(int)


def reddish(image: np.ndarray) -> np.ndarray:
    return (image[..., 0] > 1.8 * image[..., 1]) & (image[..., 0] > 60)


def test_turntable_shows_the_object_from_eight_sides(tmp_path):
    out = tmp_path / "turn.png"
    turntable(block(), out, title="block")
    parts, count = ndimage.label(reddish(picture(out)))
    assert count == 8, "each whole and apart from the others"
    assert np.bincount(parts.ravel())[1:].min() > 0.1 * 320**2 / 2


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
    contact_sheet([object_view(0, 3)], one)
    contact_sheet([object_view(k, k) for k in range(3)], three, title="three")
    first, all_three = picture(one), picture(three)
    assert all_three.shape[1] == first.shape[1] and all_three.shape[0] > 2.8 * first.shape[0]
    assert reddish(first[:, : first.shape[1] // 4]).sum() > 1000
    # The curves: something coloured on the white of the last panel.
    last = first[:, 3 * first.shape[1] // 4:]
    assert ((last.max(axis=2) - last.min(axis=2)) > 60).sum() > 200
