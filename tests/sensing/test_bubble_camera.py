"""The camera inside the bubble: where it stands, exact depth, and a pattern that moves with the skin."""

import numpy as np
import pytest

from vsfsim.physics.mesh.structured import disc
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside

SMALL = BubbleCamera(width=160, height=120, focal=107.5)


def dome(rings=10):
    flat, triangles = disc(1.0, rings)
    flat = flat * [0.05725, 0.040]
    rho = np.hypot(flat[:, 0] / 0.05725, flat[:, 1] / 0.040)
    return np.column_stack([flat, 0.03089 * np.maximum(1 - rho**2, 0.0) ** 0.763]), triangles, flat


def test_it_stands_where_the_notes_say():
    camera = BubbleCamera()
    pose = camera.pose
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-15)
    assert np.linalg.det(pose[:3, :3]) == pytest.approx(1.0)
    assert np.degrees(np.arccos(pose[2, 2])) == pytest.approx(25.0)
    assert pose[2, 3] == -0.054
    # the public mesh, in its camera's frame: rim centre (0.0157, 0, 0.0655) m (openvsf_format.md); our round figures
    # are 25 and not 23.2 degrees
    centre = np.linalg.inv(pose) @ [0.0, 0.0, 0.0, 1.0]
    assert centre[:3] == pytest.approx([0.0157, 0.0, 0.0655], abs=0.003)
    assert camera.intrinsics[0, 0] == 430.0 and (camera.width, camera.height) == (640, 480)


def test_depth_lies_on_the_triangles(device):
    points, triangles, flat = dome()
    depth, rgb = look_inside(points[None], triangles, flat, SMALL, device=device)
    depth = depth[0].astype(float)
    assert rgb.shape == (1, 120, 160, 3) and rgb.dtype == np.uint8
    assert (depth > 0).mean() > 0.7  # the dome fills most of the picture
    row, column = np.nonzero(depth)
    ray = np.linalg.solve(SMALL.intrinsics, np.stack([column, row, np.ones_like(row)]).astype(float)).T
    hit = (ray * depth[row, column][:, None]) @ SMALL.pose[:3, :3].T + SMALL.pose[:3, 3]
    a, b, c = (points[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # float32 of a depth under 0.11 m is good to 7.5e-9 m
    off = np.abs(np.einsum("pmi,mi->pm", hit[::37, None] - a[None], normal))
    assert off.min(axis=1).max() < 2e-8
    # and near the smooth dome: a chord of 1/10 of the radius is under 0.6 mm below it, and more at the steep rim
    rho = np.hypot(hit[:, 0] / 0.05725, hit[:, 1] / 0.040)
    inside = rho < 0.8
    assert np.abs(hit[inside, 2] - 0.03089 * (1 - rho[inside] ** 2) ** 0.763).max() < 6e-4


def test_the_pattern_rides_on_the_skin(device):
    # the same material carried to the right, on a plane: the pattern moves by focal * shift / depth; the highlight does
    # not move with it
    points, triangles, flat = dome()
    camera = BubbleCamera(width=160, height=120, focal=160.0, tilt=0.0, offset=0.0)
    shift = 0.00675  # 20 pixels at 54 mm
    still = points * [1.0, 1.0, 0.0]
    _, rgb = look_inside(np.stack([still, still + [shift, 0.0, 0.0]]), triangles, flat, camera, device=device)
    green = rgb[..., 1].astype(float)
    pixels = round(160.0 * shift / 0.054)
    before, here = green[:, 20:100, 30:130].reshape(2, -1)
    there = green[1, 20:100, 30 + pixels:130 + pixels].ravel()
    assert before.std() > 10.0
    assert np.corrcoef(before, there)[0, 1] > 0.95 and abs(np.corrcoef(before, here)[0, 1]) < 0.5
