"""`vsfsim measure render`: the rays that renderers are compared with."""

import numpy as np
import pytest

from measurements.render import compared, exact, found_of


def test_the_nearest_triangle_is_seen_at_its_own_depth():
    # a tilted plane z = 1 + 0.2 x over the whole picture, and a triangle before it in the middle
    far = np.array([[x, y, 1.0 + 0.2 * x] for x, y in ((-3.0, -3.0), (3.0, -3.0), (3.0, 3.0), (-3.0, 3.0))])
    near = np.array([[-0.02, -0.02, 0.5], [0.02, -0.02, 0.5], [0.0, 0.03, 0.5]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6]])
    depth = exact(np.concatenate([far, near]), triangles, 50.0, (41, 31))
    column, _ = np.meshgrid(np.arange(41) - 20.0, np.arange(31) - 15.0)
    plane = 1.0 / (1.0 - 0.2 * column / 50.0)
    hit = np.isclose(depth, 0.5)
    assert np.allclose(depth[~hit], plane[~hit], rtol=1e-12) and hit[15, 20] and 8 <= hit.sum() <= 16
    found = compared(np.where(column > 0, depth + 1e-3, 0.0), depth)
    assert found["missed"] == pytest.approx(21 / 41) and found["rms"] == pytest.approx(found["worst"])
    empty = compared(np.zeros(depth.shape), depth)
    assert empty["missed"] == 1.0 and np.isnan(empty["rms"])
    printed = found_of([{"scene": "a", **empty}], {"settings": {}}).text()
    assert "nan" not in printed and "1e+02" in printed
    assert not np.isfinite(exact(near, np.array([[0, 1, 2]]), 50.0, (41, 31))[0, 0])
