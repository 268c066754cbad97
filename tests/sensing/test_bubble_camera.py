"""The camera inside the bubble: where it stands, exact depth, a print that moves with the skin, and colours whose
statistics are those of a real Punyo's pictures."""

import itertools
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import ndimage

sys.path.insert(0, str(Path(__file__).parent))
from toy_bubble import disc

from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside
from vsfsim.sensing.membrane_fe import SensorError

PUNYO = {
    "membrane mean": (24.0, 129.0, 73.0),
    "dark skin": (7.0, 86.0, 36.0),
    "bright patches": (61.0, 226.0, 158.0),
    "bright share": 0.32,
    "saturated share": 0.13,
    "spectrum slope": -2.65,
    "corners": ((24, 193, 111), (45, 177, 104), (83, 153, 83), (89, 184, 103)),
}
"""Statistics of real pictures of 640 x 480 pixels.

sRGB means of the membrane, of its dark and of its bright part (divided by Otsu's threshold of green), the bright share
of the membrane's area, the share with green at 250 or more, the slope of the power spectral density of green from 0.02
to 0.25 cycles a pixel, and the colours of the housing in the corners (top left, top right, bottom left, bottom right).
"""
SMALL = BubbleCamera(width=160, height=120, focal=107.5)


def dome(rings=10):
    flat, triangles, _ = disc(rings)
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
    view = look_inside(points[None], triangles, flat, SMALL, device=device)
    depth = view.depth[0].astype(float)
    assert view.rgb.shape == (1, 120, 160, 3) and view.rgb.dtype == np.uint8
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


def test_the_print_rides_on_the_skin(device):
    # the same material carried 3 mm to the right, on a plane: the picture moves by focal * 3 mm / depth and is
    # otherwise the same
    flat, triangles, _ = disc(10)
    camera = BubbleCamera(width=160, height=120, focal=160.0, tilt=0.0, offset=0.0)
    shift = 0.00675  # 20 pixels at 54 mm
    still = np.column_stack([flat, np.zeros(len(flat))])
    view = look_inside(np.stack([still, still + [shift, 0.0, 0.0]]), triangles, flat, camera, device=device)
    bright = (view.rgb[..., 1] > 160) & (view.depth > 0)
    assert 0.15 < bright[0].mean() < 0.5
    pixels = round(160.0 * shift / 0.054)
    # what stands in front of the skin at the left does not move
    a, b = bright[0, :, 80:130], bright[1, :, 80 + pixels:130 + pixels]
    assert (a == b).mean() > 0.97
    assert (bright[0, :, 80:130] == bright[1, :, 80:130]).mean() < 0.8


def otsu(values):
    """The threshold that divides values of 0 to 255 into two classes of the largest variance between them."""
    share = np.bincount(values.ravel(), minlength=256) / values.size
    below, sums = share.cumsum(), (share * np.arange(256)).cumsum()
    with np.errstate(divide="ignore", invalid="ignore"):
        return int(np.nanargmax((sums[-1] * below - sums) ** 2 / (below * (1.0 - below))))


def statistics(rgb, seen):
    """The quantities of `PUNYO` for a picture (H, W, 3) whose pixels ``seen`` (H, W) show skin."""
    green = rgb[..., 1]
    limit = otsu(green[seen])
    bright = seen & (green > limit)
    size = np.bincount(ndimage.label(bright)[0].ravel())[1:]
    window = green[112:368, 192:448].astype(float)
    window = (window - window.mean()) * np.outer(np.hanning(256), np.hanning(256))
    power, f = np.abs(np.fft.fft2(window)) ** 2, np.hypot(*np.meshgrid(np.fft.fftfreq(256), np.fft.fftfreq(256)))
    edges = np.geomspace(0.02, 0.25, 12)
    mean = [power[(f >= low) & (f < high)].mean() for low, high in itertools.pairwise(edges)]
    slope = np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(mean), 1)[0]
    return {"membrane mean": rgb[seen].mean(axis=0), "dark skin": rgb[seen & ~bright].mean(axis=0),
            "bright patches": rgb[bright].mean(axis=0), "bright share": bright.sum() / seen.sum(),
            "saturated share": (green[seen] >= 250).mean(), "spectrum slope": slope,
            "patches": (size > 150).sum() / (seen.sum() * 0.0206**2),  # 0.206 mm a pixel in the middle [1/cm^2]
            "corners": [rgb[row, column] for row in (12, 467) for column in (12, 627)]}


def test_the_picture_has_a_real_punyos_statistics():
    points, triangles, flat = dome(16)
    view = look_inside(points[None], triangles, flat, BubbleCamera())
    found = statistics(view.rgb[0], view.depth[0] > 0)
    for name, value in found.items():
        print(f"{name:16} {np.round(value, 2).tolist()}   real: {PUNYO.get(name, 0.74)}")
    # sRGB levels: a real sensor's exposure and print vary by more from frame to frame and from skin to skin
    for name in ("membrane mean", "dark skin", "bright patches"):
        assert np.abs(found[name] - PUNYO[name]).max() < 15.0, name
    assert found["bright share"] == pytest.approx(PUNYO["bright share"], abs=0.05)
    assert found["saturated share"] == pytest.approx(PUNYO["saturated share"], abs=0.05)
    assert found["spectrum slope"] == pytest.approx(PUNYO["spectrum slope"], abs=0.25)
    assert found["patches"] == pytest.approx(0.74, rel=0.35)
    for corner, real in zip(found["corners"], PUNYO["corners"], strict=True):
        # green first, then blue, then red
        assert corner[1] > corner[2] > corner[0] and np.abs(corner.astype(int) - real).max() < 80


def test_what_it_refuses():
    points, triangles, flat = dome(3)
    with pytest.raises(SensorError, match="tilt"):
        BubbleCamera(tilt=2.0)
    with pytest.raises(SensorError, match="not finite"):
        look_inside(np.full((1, *points.shape), np.nan), triangles, flat, SMALL)
    with pytest.raises(SensorError, match="behind"):
        look_inside(points[None] - [0.0, 0.0, 0.5], triangles, flat, SMALL)
