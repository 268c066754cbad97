"""One object file: round trip, blindness, refusal of NaN passed off as data."""

import dataclasses

import h5py
import numpy as np
import pytest

from vsfsim.bench.mock import mock_view
from vsfsim.core.errors import DatasetError
from vsfsim.data.hdf5 import encode_view, read_view


def with_touch(view, index, **changes):
    touches = list(view.touches)
    touches[index] = dataclasses.replace(touches[index], **changes)
    return dataclasses.replace(view, touches=tuple(touches))


def full_view():
    """Every optional field, an unconverged frame with NaN, reasons, and an unusual letter."""
    view = mock_view(3, split="train", touches=3)
    touch = view.touches[0]
    frames = len(touch.time)
    converged, force = touch.converged.copy(), touch.force.copy()
    converged[5], force[5] = False, np.nan
    rng = np.random.default_rng(1)
    return with_touch(view, 0, converged=converged, force=force, reason=np.where(converged, 0, 2),
                      reason_names=("a", "Schrittweite zu groß"),
                      q=rng.normal(size=(frames, 7)), torque=rng.normal(size=(frames, 7)),
                      pressure=rng.normal(size=frames),
                      node_position=rng.normal(size=(frames, 4, 3)).astype(np.float32),
                      node_force=rng.normal(size=(frames, 4, 3)).astype(np.float32))


def test_round_trip_keeps_every_bit(tmp_path):
    view = full_view()
    (tmp_path / "a.h5").write_bytes(encode_view(view))
    back = read_view(tmp_path / "a.h5")
    assert encode_view(back) == encode_view(view)
    assert np.isnan(back.touches[0].force[5]).all() and not back.touches[0].converged[5]
    assert [p.name for p in tmp_path.iterdir()] == ["a.h5"], "a .part was left"


def test_blind_reader_never_opens_truth(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(encode_view(mock_view(0)))
    with h5py.File(path, "r+") as file:
        del file["truth"]  # if blind reading touched it, this would fail
    assert read_view(path, blind=True).truth is None
    with pytest.raises(DatasetError, match="cannot be read"):
        read_view(path)


@pytest.mark.parametrize(("changes", "message"), [
    *(({name: np.full(shape, np.nan)}, rf"touches/000/{name}\[0.*\] is not finite in frame 0, which is marked conv")
      for name, shape in (("force", (12, 3)), ("reaction", (12, 3)), ("residual", 12))),
    # even if no frame converged
    ({"mount_pose": np.full((12, 4, 4), np.inf), "converged": np.zeros(12, bool)}, r"pose\[0, 0, 0\] is not finite"),
    ({"force": np.zeros((3, 3))}, r"shape \(3, 3\).*T = 12"),
    ({"axis": np.zeros((1, 3))}, r"shape \(1, 3\); the schema wants \(3\)"),
    ({"reason": np.zeros(12)}, "dtype float64; the schema wants int64"),
    ({"audit": {}}, "audit/force_balance is missing"),
    ({"audit": {"heat": np.zeros(12)}}, "'audit/heat' is not in the schema"),
    ({"channels": {"heat": np.zeros(12)}}, "'channels/heat' is not in the schema"),
])
def test_misfits_are_refused(changes, message):
    with pytest.raises(DatasetError, match=message):
        encode_view(with_touch(mock_view(0), 0, **changes))


def test_a_blind_view_cannot_be_stored():
    with pytest.raises(DatasetError, match="no truth"):
        encode_view(dataclasses.replace(mock_view(0), truth=None))


def test_not_an_object_file(tmp_path):
    (tmp_path / "a.h5").write_bytes(b"no")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_view(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.attrs["format"] = "other"
    with pytest.raises(DatasetError, match="not an object view"):
        read_view(tmp_path / "b.h5")
