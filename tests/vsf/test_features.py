"""Features: projected where the camera sees, averaged where it does not, and free of what the background shows."""

import dataclasses

import numpy as np
import pytest

from vsfsim.bench.mock import camera_view, particles
from vsfsim.vsf.features.descriptor import LocalDescriptor
from vsfsim.vsf.features.interface import NEIGHBOURS, FeatureImage, Normaliser, project, projection
from vsfsim.vsf.features.registry import particle_features


@pytest.fixture(scope="module")
def view():
    return camera_view()


def test_bilinear_on_the_seen_and_mean_of_ten_on_the_hidden(view):
    # A feature that is linear in the pixel is read without error by bilinear interpolation.
    rows, columns = np.indices(view.mask.shape)
    image = FeatureImage(np.stack([columns, 2.0 * rows], axis=-1).astype(np.float32), np.ones_like(view.mask),
                         np.zeros(1))
    projected = projection(view, particles(), 0.005)
    out = project(image, projected)
    seen = projected.visible
    assert 0 < seen.sum() < len(seen) and np.abs(projected.behind[seen]).max() <= 0.005
    np.testing.assert_allclose(out[seen], projected.pixel[seen] * [1.0, 2.0], atol=1e-4)
    hidden = int(np.flatnonzero(~seen)[0])
    away = np.linalg.norm(projected.points[seen] - projected.points[hidden], axis=1)
    ten = np.sort(away)[NEIGHBOURS - 1]
    near = away < ten - 1e-9  # ties at the rim may fall either way
    low, high = out[seen][near].min(axis=0), out[seen][away <= ten + 1e-9].max(axis=0)
    assert (out[hidden] >= low - 1e-3).all() and (out[hidden] <= high + 1e-3).all()


def test_the_local_descriptor_tells_colours_textures_and_depth_apart(view):
    rng = np.random.default_rng(0)
    columns = np.indices(view.mask.shape)[1]
    rough = view.rgb.astype(float)
    rough[columns < 32] *= rng.uniform(0.3, 1.7, view.mask.shape)[columns < 32][:, None]
    textured = dataclasses.replace(view, rgb=np.clip(rough, 0, 255).astype(np.uint8))
    points = particles()
    features = particle_features("local", textured, points, spacing=0.005)
    assert features.shape[1] == 11
    assert features.dtype == np.float32 and np.isfinite(features).all()
    top = points[:, 2] > 0.025
    left, right = features[top & (points[:, 0] < -0.01)], features[top & (points[:, 0] > 0.01)]
    apart = np.abs(left.mean(axis=0) - right.mean(axis=0)) / (left.std(axis=0) + right.std(axis=0) + 1e-3)
    assert apart[0] > 1.0, "luminance: the right half is half as bright"
    assert apart[3] > 1.0, "energy of the finest band: only the left half is rough"
    deep = points[:, 2] < 0.01
    assert features[deep, -2].min() > features[top, -2].max(), "depth behind the surface"


def test_the_normaliser_has_zero_mean_unit_variance_and_leaves_constants_alone():
    rng = np.random.default_rng(0)
    parts = [np.c_[rng.normal(3, 2, (50, 2)), np.full(50, 7.0)].astype(np.float32) for _ in range(3)]
    normalise = Normaliser.of(parts)
    out = np.concatenate([normalise(p) for p in parts])
    np.testing.assert_allclose(out[:, :2].mean(axis=0), 0, atol=1e-5)
    np.testing.assert_allclose(out[:, :2].std(axis=0), 1, rtol=1e-4)
    assert (out[:, 2] == 0.0).all()
    assert normalise(np.full((1, 3), 1e6, np.float32)).max() == 6.0


def test_stripes_of_a_pixel_have_the_energy_that_a_gaussian_of_0_4_pixels_takes_away(view):
    """On pixels of 7.5 mm, of the finest scale of 3 mm: it leaves the share (1 - 2 w) / (1 + 2 w) of columns that
    alternate, with w = exp(-1 / (2 0.4^2)) of a pixel beside."""
    rgb = np.tile(np.uint8([200, 100])[None, :, None], (64, 32, 3))
    depth = np.full_like(view.depth, 0.0075 * view.intrinsics[0, 0])
    striped = dataclasses.replace(view, rgb=rgb, mask=depth > 0.0, depth=depth)
    light, dark, beside = (200 / 255) ** 2.2 + 0.01, (100 / 255) ** 2.2 + 0.01, np.exp(-0.5 / 0.4**2)
    assert LocalDescriptor().image(striped).values[20:40, 20:40, 3] == pytest.approx(
        np.log(2.0 * np.log(light / dark) * beside / (1.0 + 2.0 * beside)), abs=1e-3)
