"""Datasets in the formats of others, read back by their own readers where these are installed."""

import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import time

import numpy as np
import pytest
from mock_dataset import written

from vsfsim.bench.mock import mock_view
from vsfsim.core.errors import DatasetError
from vsfsim.data.dataset import Dataset
from vsfsim.data.formats import lerobot
from vsfsim.data.formats.export import export
from vsfsim.data.formats.lerobot import frame_rows
from vsfsim.data.formats.openvsf import TARE
from vsfsim.data.verify import compare
from vsfsim.data.writer import DatasetWriter


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return written(tmp_path_factory.mktemp("data") / "d", train=2, test=1, touches=2)


def test_lerobot_holds_every_frame_to_the_bit(made, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    out = export(made.path, "lerobot", tmp_path / "l")
    info = json.loads((out / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["total_episodes"] == 6
    assert info["splits"] == {"train": "0:4", "test": "4:6"}
    rows = [parquet.read_table(path) for path in sorted((out / "data").rglob("*.parquet"))]
    assert sum(len(table) for table in rows) == info["total_frames"] == sum(e.frames for e in made.entries)
    for table, view in zip(rows, made, strict=True):
        for key in ("observation.force", "observation.state", "observation.time", "action"):
            want = np.concatenate([frame_rows(touch)[key] for touch in view.touches])
            found = np.array(table[key].to_pylist(), np.float32)
            assert found.tobytes() == want.tobytes(), key
    truth = parquet.read_table(out / "sidecar/truth" / f"{made.entries[1].name}.parquet").to_pylist()[0]
    want = made[1].truth
    assert np.array(truth["young_modulus"]).tobytes() == want.young_modulus.tobytes()
    assert truth["points_shape"] == list(want.points.shape)
    assert np.array(truth["points"]).reshape(truth["points_shape"]).tobytes() == want.points.tobytes()


def test_lerobot_names_the_file_of_every_episode_past_a_chunk(made, tmp_path, monkeypatch):
    parquet = pytest.importorskip("pyarrow.parquet")
    monkeypatch.setattr(lerobot, "_CHUNK", 2)
    out = export(made.path, "lerobot", tmp_path / "l")
    for row in parquet.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist():
        place = out / f"data/chunk-{row['data/chunk_index']:03d}/file-{row['data/file_index']:03d}.parquet"
        assert row["episode_index"] in parquet.read_table(place)["episode_index"].to_pylist()
    assert json.loads((out / "meta/info.json").read_text())["chunks_size"] == 2


def test_croissant_is_valid_and_lists_every_touch(made, tmp_path):
    pytest.importorskip("pyarrow")
    out = export(made.path, "croissant", tmp_path / "c")
    table = json.loads((out / "croissant.json").read_text())
    assert {e.sha256 for e in made.entries} < {item["sha256"] for item in table["distribution"]}
    assert sum(key.startswith("rai:") for key in table) >= 7
    croissant = pytest.importorskip("mlcroissant")
    dataset = croissant.Dataset(jsonld=str(out / "croissant.json"))
    assert not dataset.metadata.ctx.issues.errors
    records = list(dataset.records("touches"))
    assert len(records) == 6
    best = max(np.linalg.norm(t.force[t.converged], axis=1).max() for v in made for t in v.touches)
    assert max(r["touches/largest_force"] for r in records) == best


def test_webdataset_holds_every_array(made, tmp_path):
    pytest.importorskip("PIL")
    out = export(made.path, "webdataset", tmp_path / "w")
    assert sorted(p.name for p in out.glob("*.tar")) == ["test-000000.tar", "train-000000.tar"]
    with tarfile.open(out / "train-000000.tar") as tar:
        names = tar.getnames()
        arrays = np.load(io.BytesIO(tar.extractfile(names[1]).read()))
        assert names[1].endswith("-v0-000.npz") and arrays["force"].tobytes() == made[0].touches[0].force.tobytes()
        assert len(names) == 12
    with np.load(out / "truth" / f"{made.entries[0].name}.npz") as truth:
        assert np.array_equal(truth["young_modulus"], made[0].truth.young_modulus)
    wds = pytest.importorskip("webdataset")
    samples = list(wds.WebDataset(str(out / "train-000000.tar"), shardshuffle=False))
    assert len(samples) == 4 and {"json", "npz", "png"} <= set(samples[0])


@pytest.fixture(scope="module")
def dotted(made, tmp_path_factory):
    """Names with dots, and views whose splits alternate, of one touch or two by an arm."""
    views = [dataclasses.replace(mock_view(k, split=("train", "test", "train")[k], touches=1 + k % 2), name=name)
             for k, name in enumerate(("shoe.v2-0000", "shoe.v2-0001", "shoe%2Ev2".replace("%", "+")))]
    with DatasetWriter(tmp_path_factory.mktemp("dotted") / "d", made.recipe, [v.name for v in views]) as writer:
        for view in views:
            arm = [dataclasses.replace(t, q=np.outer(t.time, np.ones(7)), torque=np.zeros((len(t.time), 7)))
                   for t in view.touches]
            writer.add(dataclasses.replace(view, touches=tuple(arm)))
        return writer.finish()


def test_a_sample_of_webdataset_is_one_touch_whatever_its_view_is_called(dotted, tmp_path):
    pytest.importorskip("PIL")
    out, keys = export(dotted.path, "webdataset", tmp_path / "w"), set()
    for path in out.glob("*.tar"):
        with tarfile.open(path) as tar:
            for member in tar.getmembers():
                key, _, ending = member.name.partition(".")  # as webdataset has it
                assert ending in ("json", "npz", "png") and (key, ending) not in keys
                keys.add((key, ending))
                if ending == "json":
                    about = json.load(tar.extractfile(member))
                    assert key == f"{about['view'].replace('.', '%2E')}-{about['touch']:03d}"
    assert len(keys) == 3 * 4


def test_a_split_of_lerobot_is_the_range_of_its_episodes(dotted, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet")
    out = export(dotted.path, "lerobot", tmp_path / "l")
    info = json.loads((out / "meta/info.json").read_text())
    assert info["features"]["observation.q"]["names"] == [f"joint_{k}" for k in range(7)]
    rows = parquet.read_table(out / "sidecar/touches.parquet").to_pylist()
    for name, text in info["splits"].items():
        first, last = map(int, text.split(":"))
        assert [r["episode_index"] for r in rows if r["split"] == name] == list(range(first, last))


def test_a_sequence_of_openvsf_begins_with_copies_of_its_first_frame(dotted, tmp_path):
    pytest.importorskip("yaml")
    out, view = export(dotted.path, "openvsf", tmp_path / "o"), dotted[0]
    q = np.load(out / view.name / "seq_000" / "kinova_state.npy")
    assert (q[:TARE] == view.touches[0].q[0]).all() and np.array_equal(q[TARE:], view.touches[0].q)


def test_openvsf_wants_an_arm_and_bad_words_are_told(made, tmp_path):
    with pytest.raises(DatasetError, match="was not touched by an arm"):
        export(made.path, "openvsf", tmp_path / "o")
    assert list(tmp_path.iterdir()) == []


SLOW = """
import sys, time
from vsfsim.data.formats import webdataset
from vsfsim.data.formats.export import export
real = webdataset.packed
webdataset.packed = lambda arrays: (print("writing", flush=True), time.sleep(0.2), real(arrays))[-1]
export(sys.argv[1], "webdataset", sys.argv[2])
"""


def test_a_killed_export_leaves_no_folder_and_the_next_one_is_whole(made, tmp_path):
    pytest.importorskip("PIL")
    process = subprocess.Popen([sys.executable, "-c", SLOW, str(made.path), str(tmp_path / "w")],
                               stdout=subprocess.PIPE)
    process.stdout.readline()
    time.sleep(0.1)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "w").exists() and len(list(tmp_path.iterdir())) == 1
    export(made.path, "webdataset", tmp_path / "w")
    assert [p.name for p in tmp_path.iterdir()] == ["w"]


def test_datasets_are_compared_touch_by_touch(made, tmp_path):
    assert compare(made.path, made.path).equal == 6
    views = list(made)
    def changed(view, factor):
        touches = [dataclasses.replace(t, force=t.force * factor) for t in view.touches]
        return dataclasses.replace(view, touches=tuple(touches))

    with DatasetWriter(tmp_path / "d", made.recipe, [v.name for v in views]) as writer:
        for view, factor in zip(views, (1.0 + 1e-5, 1.0 + 1e-5, 1.5), strict=True):
            writer.add(changed(view, factor), "another CPU")
        writer.finish()
    found = compare(made.path, tmp_path / "d")
    met = [sum(bool(t.force.any()) for t in view.touches) for view in views]
    assert (found.close, found.other) == (met[0] + met[1], met[2]) and 0 < met[2] < met[0] + met[1]
    assert found.equal + found.close + found.other == 6 and "another CPU" in found.kinds
    assert Dataset.open(tmp_path / "d").entries[0].made_on == "another CPU"
