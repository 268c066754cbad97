"""Measurement of blind localisation: its objects, its methods, its report."""

import numpy as np
import pytest

from measurements.blind import COVER, OUTLINES, SOFT, STIFF, BlindRow, Buried, compare, prism, report
from vsfsim.core.rotation import pose_errors
from vsfsim.vsf.pose.localise import KnownObject, stiffness_pose


@pytest.mark.parametrize("which", range(len(OUTLINES)))
def test_an_object_is_closed_and_lies_where_it_is_said_to(which):
    vertices, triangles = prism(*OUTLINES[which])
    known = KnownObject.of(vertices, triangles)  # refuses a mesh that is not closed
    corners = vertices[triangles]
    volume = np.einsum("ki,ki->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume == pytest.approx(known.inside.sum() * known.cell**3, rel=0.06) and volume > 0.0
    buried = Buried.of(which, scale=0.04)
    assert (vertices @ buried.pose[:3, :3].T + buried.pose[:3, 3])[:, 2].max() == pytest.approx(-COVER)
    assert len(buried.touches) == 2


def test_three_starts_tell_an_object_from_itself_turned_over(trial_seed):
    """From a stiffness as it is, the search ends at the truth although a turned over object covers the sheet of stiff
    points nearly as well."""
    buried = Buried.of(len(OUTLINES) * trial_seed, scale=0.04)
    axes = [np.arange(-0.08, 0.08, 0.004), np.arange(-0.08, 0.08, 0.004), np.arange(-0.0115, 0.0, 0.002)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    inside = buried.known.contains((points - buried.pose[:3, 3]) @ buried.pose[:3, :3])
    stiffness = np.where(inside, STIFF, SOFT)
    found = stiffness_pose(buried.known, points, stiffness, threshold=4.0 * SOFT, tries=12, seed=trial_seed)
    shift, turn = pose_errors(found.transform, buried.pose)
    print(f"errors: {1000 * shift:.2f} mm, {np.degrees(turn):.2f} degrees")
    assert shift < 0.004 and np.degrees(turn) < 10.0


def test_the_report_has_the_mean_over_objects_and_no_search_for_contact_points():
    none = np.full((2, 2), np.nan)
    found = report({}, [BlindRow("contact points", np.array([0.01, 0.03]), np.radians([10.0, 30.0]), none, 0.0),
                        BlindRow("point VSF", np.array([0.002, 0.004]), np.radians([1.0, 3.0]),
                                 np.array([[0.001, np.radians(1.0)]] * 2), 5.0)])
    first, second = found.record()["methods"]
    assert first["shift"] == pytest.approx(0.02) and first["refined_shift"] is None
    assert second["refined_turn"] == pytest.approx(np.radians(1.0))
    lines = [line.split() for line in found.text().splitlines()]
    assert ["contact", "points", "20.0", "20", "-", "-", "0.0"] in lines
    assert ["point", "VSF", "3.0", "2", "1.0", "1", "5.0"] in lines


@pytest.mark.slow
def test_forces_on_the_skin_find_what_contact_points_do_not():
    rows = {row.name: row for row in compare(objects=2, iterations=100)}
    assert set(rows) == {"contact points", "point VSF, pressure only", "point VSF", "neural VSF", "grid VSF (ours)"}
    for name in ("point VSF", "grid VSF (ours)"):
        assert rows[name].refined[:, 0].mean() < 0.5 * rows["contact points"].shift.mean()
