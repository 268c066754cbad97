"""Dataset files that point outside, announce more than they hold, or are there twice."""

import dataclasses
import json
import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from mock_dataset import written

from vsfsim.bench.mock import mock_view
from vsfsim.core.errors import DatasetError
from vsfsim.core.plain_text import file_stem, markdown, plain
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import file_sha256, write_atomic
from vsfsim.data.hdf5 import read_view
from vsfsim.data.manifest import manifest_bytes
from vsfsim.data.writer import DatasetWriter


@pytest.fixture
def folder(tmp_path):
    return written(tmp_path / "toy", test=1, touches=2).path


def rewrite(folder, change):
    """Change the table of dataset.json and make its digest fit again, as somebody would who means to."""
    table = json.loads((folder / "dataset.json").read_text())
    change(table)
    (folder / "dataset.json").write_bytes(manifest_bytes(table))


def load_all(folder):
    return [dataset.load(name) for dataset in [Dataset.open(folder)] for name in dataset.names()]


@pytest.mark.parametrize(("change", "message"), [
    (lambda f: f[0].update(file="../secret.h5"), "must be a name: letters"),
    (lambda f: f[0].update(file="/etc/passwd"), "must be a name: letters"),
    (lambda f: f[0].update(name="a\x1b[2Jb"), "must be a name: letters"),
    (lambda f: f[0].update(split="<b>"), "must be a name: letters"),
    (lambda f: f[0].update(frames="many"), "frames is 'many'; it must be a whole number"),
    (lambda f: f[0].update(object_index=-1), "object_index is -1; it must be"),
    (lambda f: f.append(dict(f[0])), "the name mock-0000-v0 is there twice"),
    (lambda f: f.append({**f[0], "name": "x", "object_index": 7}), "the file mock-0000-v0.h5 is there twice"),
    (lambda f: f.append({**f[0], "name": "x", "file": "x.h5", "object_index": 7}), "the content .* is there twice"),
    (lambda f: f[1].update(object_index=0, view_index=1), "object 0 is in the splits train and test"),
    (lambda f: f[1].update(split="train"), "says split = 'test', and dataset.json says 'train'"),
    (lambda f: f.clear(), "files is "),
])
def test_entries_that_point_outside_or_are_there_twice_are_refused(folder, change, message):
    rewrite(folder, lambda table: change(table["files"]))
    with pytest.raises(DatasetError, match=message):
        load_all(folder)


def test_a_symbolic_link_is_refused(folder):
    file = folder / "mock-0001-v0.h5"
    os.rename(file, folder.parent / "elsewhere.h5")
    file.symlink_to(folder.parent / "elsewhere.h5")
    with pytest.raises(DatasetError, match=r"mock-0001-v0\.h5 is a link"):
        load_all(folder)


def put(name, *shape, **more):
    """A change that puts a dataset in the place of another one."""
    def change(file, folder):
        del file[name]
        file.create_dataset(name, *shape, **more)

    return change


def link(to):
    def change(file, folder):
        del file["view/depth"]
        file["view/depth"] = to

    return change


def external_storage(file, folder):
    (folder / "raw").write_bytes(bytes(72))
    put("view/intrinsics", (3, 3), "float64", external=[(str(folder / "raw"), 0, 72)])(file, folder)


def virtual(file, folder):
    del file["view/intrinsics"]
    layout = h5py.VirtualLayout((3, 3), "float64")
    layout[:] = h5py.VirtualSource(str(folder / "mock-0000-v0.h5"), "view/intrinsics", (3, 3))
    file.create_virtual_dataset("view/intrinsics", layout)


def many(file, folder):
    for k in range(8):
        file.create_dataset(f"view/more{k}", (10_000, 10_000), "float32", chunks=(100, 100), compression="gzip")


def a_group(file, folder):
    del file["view/depth"]
    file.create_group("view/depth")


@pytest.mark.parametrize(("change", "message"), [
    (link(h5py.ExternalLink("other.h5", "/x")), "view/depth is a link to another place"),
    (link(h5py.SoftLink("/truth/young_modulus")), "view/depth is a link to another place"),
    (external_storage, "keeps its data in another file"), (virtual, "keeps its data in another file"),
    (put("view/depth", (30_000, 30_000), "float32", chunks=(100, 100), compression="gzip"),
     r"view/depth has shape \(30000, 30000\), 3600 MB"),
    (put("view/intrinsics", (3, 3), "float64", chunks=(20_000, 20_000), maxshape=(None, None)), "and a chunk 67 MB"),
    (many, "announces more than"),
    (put("view/depth", data=np.zeros((48, 64), np.float32), compression="lzf"), "is packed with filter 32000"),
    (put("truth/region_names", data=["soft", "stiff"], dtype=h5py.string_dtype()), "has dtype object"),
    (a_group, "view/depth is a group"),
])
def test_object_files_that_point_outside_or_are_too_large_are_refused(folder, change, message):
    path = folder / "mock-0001-v0.h5"
    with h5py.File(path, "a") as file:
        change(file, folder)
    rewrite(folder, lambda table: table["files"][1].update(sha256=file_sha256(path)))
    with pytest.raises(DatasetError, match=message):
        load_all(folder)
    with pytest.raises(DatasetError, match=message):
        read_view(path, blind=False)


def test_text_is_made_plain():
    assert plain("a\x1b[31mb\u202ec\nd\x00") == "a?[31mb?c d?" and plain("x" * 9, longest=3) == "xxx..."
    assert markdown("<b>|a|*") == "&#60;b&#62;&#124;a&#124;&#42;"
    assert file_stem("../../x") == "x" and file_stem("mine:One Spring") == "mine.One.Spring"
    assert file_stem("..") == "unnamed" and "/" not in file_stem("/etc/passwd")


def test_a_view_whose_name_is_a_path_is_not_written(folder):
    view = dataclasses.replace(mock_view(1, touches=2), name="../x")
    recipe = Dataset.open(folder).recipe
    with pytest.raises(DatasetError), DatasetWriter(folder.parent / "new", recipe, [view.name]) as writer:
        writer.add(view)
        writer.finish()
    assert not (folder.parent / "x.h5").exists()


def test_a_pipe_is_written_into_and_not_replaced(tmp_path: Path) -> None:
    """As a device is: `--json /dev/null` by root put a file in its place."""
    os.mkfifo(tmp_path / "pipe")
    with open(os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK), "rb") as reader:
        write_atomic(tmp_path / "pipe", b"numbers")
        assert reader.read() == b"numbers" and (tmp_path / "pipe").is_fifo()
    for name in ("", "."):
        with pytest.raises(DatasetError, match="Is a directory"):
            write_atomic(Path(name), b"numbers")
