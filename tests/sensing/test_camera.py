"""The camera against analytic depth, and the two renderers against each other."""

import math
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from vsfsim.core.scene import CameraSpec
from vsfsim.core.solid import TEXTURES, Appearance
from vsfsim.sensing.camera import fitting_camera, look_at, render
from vsfsim.sensing.render_pyrender import load_pyrender
from vsfsim.sensing.surface import RenderError, Surface

SPEC = CameraSpec(160, 120, 0.8, 0.6, 0.9, 0.7)


def surface_of(mesh: trimesh.Trimesh, appearance: Appearance | None = None, region: int = 0) -> Surface:
    vertices = np.asarray(mesh.vertices)
    return Surface(vertices, np.asarray(mesh.faces), np.full(len(mesh.faces), region), appearance, vertices)


def look(texture: str, contrast: float = 0.5) -> Appearance:
    return Appearance(np.array([[0.4, 0.3, 0.2]]), (texture,), np.array([0.01]), np.array([contrast]))


def rays(intrinsics: np.ndarray, pose: np.ndarray, width: int, height: int) -> np.ndarray:
    """World direction of each pixel with unit z in the camera (H, W, 3)."""
    column, row = np.meshgrid(np.arange(width), np.arange(height))
    camera = np.stack([(column - intrinsics[0, 2]) / intrinsics[0, 0], (row - intrinsics[1, 2]) / intrinsics[1, 1],
                       np.ones_like(row, float)], axis=-1)
    return camera @ pose[:3, :3].T


def test_look_at_puts_the_target_in_the_middle_and_up_up():
    target = np.array([0.1, -0.2, 0.05])
    intrinsics, pose = look_at(SPEC, target)
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3)) and np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    world_to_camera = np.linalg.inv(pose)
    in_camera = world_to_camera[:3, :3] @ target + world_to_camera[:3, 3]
    np.testing.assert_allclose(in_camera, [0, 0, SPEC.distance], atol=1e-12)
    # A point above the target appears higher in the picture (smaller row), one to the camera's right further right.
    above = world_to_camera[:3, :3] @ (target + [0, 0, 0.01]) + world_to_camera[:3, 3]
    assert above[1] < 0 and above[0] == pytest.approx(0.0, abs=1e-12)
    assert pose[2, 3] - target[2] == pytest.approx(0.6 * math.sin(0.7))
    assert 2 * math.atan(0.5 * SPEC.height / intrinsics[1, 1]) == pytest.approx(SPEC.fov)
    assert intrinsics[:2, 2].tolist() == [79.5, 59.5], "the middle of 160 x 120 pixels, whose centres are whole numbers"


def test_a_fitting_camera_has_the_whole_body_in_the_middle():
    points = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)) * [0.3, 0.05, 0.02]
    intrinsics, pose = fitting_camera(points, points, 640, 200)
    pixel = (points - pose[:3, 3]) @ pose[:3, :3] @ intrinsics.T
    low, high = (of(pixel[:, :2] / pixel[:, 2:], axis=0) for of in (np.min, np.max))
    assert 0.5 * (low + high) == pytest.approx([319.5, 99.5])
    assert ((high - low) / [640, 200]).max() == pytest.approx(0.92)


def test_a_picture_is_the_same_whichever_corner_of_a_triangle_comes_first():
    ball = surface_of(trimesh.creation.icosphere(1, 0.1), look("plain", 0.0))
    first, other = (render(replace(ball, triangles=np.roll(ball.triangles, turn, axis=1)), *look_at(SPEC, np.zeros(3)),
                           160, 120).rgb.astype(int) for turn in (0, 1))
    assert np.ptp(first[60, 60:100]) > 20 and np.abs(first - other).max() <= 2


def test_depth_of_a_tilted_plane_is_exact():
    # Off the origin: 40 m is 3 um in float32, and the depth is still that of the plane.
    offset = np.array([40.0, -25.0, 3.0])
    corners = np.array([[-1, -1, -0.1], [1, -1, 0.1], [1, 1, 0.15], [-1, 1, -0.05]]) * [0.2, 0.2, 1] + offset
    surface = Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]), np.zeros(2, int), None, corners)
    intrinsics, pose = look_at(SPEC, offset)
    view = render(surface, intrinsics, pose, 160, 120)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    exact = normal @ (corners[0] - pose[:3, 3]) / (rays(intrinsics, pose, 160, 120) @ normal)
    assert np.abs(normal @ (corners[3] - corners[0])) < 1e-9
    assert view.mask.sum() > 3000
    # Depth is stored as float32: 6e-8 of 0.6 m.
    assert np.abs(view.depth - exact)[view.mask].max() < 1e-7


def test_a_picture_is_bit_identical_when_taken_again():
    surface = surface_of(trimesh.creation.icosphere(subdivisions=5, radius=0.1), look("noise"))
    spec = replace(SPEC, width=640, height=480)
    intrinsics, pose = look_at(spec, np.zeros(3))
    one = render(surface, intrinsics, pose, 640, 480)
    two = render(surface, intrinsics, pose, 640, 480)
    assert np.array_equal(one.rgb, two.rgb) and np.array_equal(one.depth, two.depth)


@pytest.mark.parametrize("texture", TEXTURES)
def test_textures_vary_in_rest_coordinates_and_move_with_the_material(texture):
    mesh = trimesh.creation.box((0.2, 0.2, 0.02))
    mesh.apply_translation([0, 0, -0.01])
    surface = surface_of(mesh, look(texture))
    intrinsics, pose = look_at(replace(SPEC, elevation=1.5), np.zeros(3))
    rgb = render(surface, intrinsics, pose, 160, 120).rgb.astype(int)
    plain = render(replace(surface, appearance=look("plain")), intrinsics, pose, 160, 120).rgb.astype(int)
    spread = (rgb - plain)[40:80, 60:100].reshape(-1, 3).std(axis=0)
    assert np.all(spread > 5) if texture != "plain" else np.all(spread == 0)
    # The body and the camera both shifted: the same picture, as the texture went along.
    shift = np.array([0.033, -0.021, 0.0])
    moved = replace(surface, vertices=surface.vertices + shift)
    pose2 = pose.copy()
    pose2[:3, 3] += shift
    again = render(moved, intrinsics, pose2, 160, 120).rgb.astype(int)
    assert np.mean(np.abs(rgb - again)) < 0.05


@pytest.mark.parametrize("change, words", [
    ({"vertices": np.full((3, 3), np.nan)}, "finite"),
    ({"region": np.array([3])}, "region 3"),
    ({"appearance": look("wool")}, "wool"),
])
def test_bad_surfaces_are_refused(change, words):
    triangle = Surface(np.eye(3), np.array([[0, 1, 2]]), np.array([0]), look("plain"), np.eye(3))
    intrinsics, pose = look_at(SPEC, np.zeros(3))
    with pytest.raises(RenderError) as error:
        render(replace(triangle, **change), intrinsics, pose, 8, 8)
    assert words in str(error.value)


def _pyrender_view(*arguments):
    try:
        return render(*arguments, renderer="pyrender")
    except RenderError as error:
        pytest.skip(f"no GL here: {error}")


def test_pyrender_agrees_on_depth_away_from_silhouettes():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.07)
    box = trimesh.creation.box((0.12, 0.1, 0.05))
    box.apply_translation([0, 0.15, 0])
    surface = surface_of(trimesh.util.concatenate([ball, box]), look("weave"))
    intrinsics, pose = look_at(replace(SPEC, width=320, height=240), np.array([0, 0.07, 0]))
    gl = _pyrender_view(surface, intrinsics, pose, 320, 240)
    cast = render(surface, intrinsics, pose, 320, 240)
    assert (gl.mask != cast.mask).sum() < 40
    # Silhouette: a pixel with a neighbour off the object, or one more than 5 mm away.
    depth = np.where(cast.mask, cast.depth, 10.0)
    rim = np.zeros_like(cast.mask)
    for axis in (0, 1):
        jump = np.abs(np.diff(depth, axis=axis)) > 0.005
        rim |= np.pad(jump, [(0, 1), (0, 0)] if axis == 0 else [(0, 0), (0, 1)])
        rim |= np.pad(jump, [(1, 0), (0, 0)] if axis == 0 else [(0, 0), (1, 0)])
    inner = cast.mask & gl.mask & ~rim
    assert inner.sum() > 4000
    assert np.abs(gl.depth - cast.depth)[inner].max() < 1e-4
    assert gl.rgb[inner].std() > 5


def test_missing_gl_is_one_paragraph_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrender", None)  # its import fails
    monkeypatch.setenv("PYOPENGL_PLATFORM", "egl")
    with pytest.raises(RenderError) as error:
        load_pyrender()
    text = str(error.value)
    assert "(egl: " in text and "apt-get install" in text and "\n" not in text
