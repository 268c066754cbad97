"""One object view to one HDF5 file and back; the same input gives the same bytes."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from vsfsim.core.errors import DatasetError, SceneError
from vsfsim.core.plain_text import from_json, plain
from vsfsim.core.shape import ProbeShape, parse_probe_shapes, probe_tables
from vsfsim.data.disk import write_atomic
from vsfsim.data.records import ObjectView, Touch, Truth, View
from vsfsim.data.safety import check_name, check_tree, whole_number
from vsfsim.data.schema import (
    ATTRIBUTES,
    CHANNELS,
    FIELDS,
    FORMAT,
    SCHEMA_VERSION,
    TEXT,
    Field,
    check_array,
    check_shape,
    fields_of,
    first_bad,
)

_COMPRESS_FROM = 4096  # bytes; below this a chunk's own bookkeeping costs more than it saves


def write_view(path: str | Path, object_view: ObjectView) -> None:
    """Store ``object_view``, truth and all, as ``path``; the file appears whole or not at all.

    May be called from worker processes, each with files of its own.

    Raises:
        DatasetError: a field does not fit the schema, a number is not finite in a frame marked converged, or the
            disk refuses.
    """
    write_atomic(Path(path), encode_view(object_view))


def encode_view(object_view: ObjectView) -> bytes:
    """The bytes of an object file; see `write_view`. Nothing in them depends on the clock or the machine."""
    if object_view.truth is None:
        raise DatasetError(f"object view '{object_view.name}' has no truth (it is blind); a dataset stores "
                           f"the truth too.")
    # In memory first: then every way a disk can fail is a plain OSError of one write.
    with h5py.File("object-view", "w", driver="core", backing_store=False, libver="v108", track_order=True) as file:
        values = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "name": object_view.name,
                  "object_index": int(object_view.object_index), "view_index": int(object_view.view_index),
                  "split": object_view.split, "probe": json.dumps(probe_tables(object_view.probes))}
        for key in ATTRIBUTES:
            file.attrs[key] = values[key]
        recorded = not len(object_view.truth.points)
        _write_group(file, "view", "view", object_view.view, object_view.name, None)
        touches = file.create_group("touches", track_order=True)
        if len(object_view.touches) > 1000:
            raise DatasetError(f"object view '{object_view.name}' has {len(object_view.touches)} touches; a file holds "
                               f"at most 1000. Use more views.")
        for index, touch in enumerate(object_view.touches):
            _write_group(touches, f"{index:03d}", "touches/*", touch, f"{object_view.name} touches/{index:03d}",
                         touch.converged, recorded=recorded)
        _write_group(file, "truth", "truth", object_view.truth, object_view.name, None)
        file.flush()
        return file.id.get_file_image()


def _write_group(parent: h5py.Group, name: str, kind: str, record: View | Touch | Truth, where: str,
                 converged: np.ndarray | None, *, recorded: bool = False) -> None:
    group = parent.create_group(name, track_order=True)
    lengths: dict[str, int] = {}
    if isinstance(record, Touch):
        known = {f.name for f in fields_of(kind)}
        for name in (*(f"audit/{column}" for column in record.audit), *(f"channels/{key}" for key in record.channels)):
            if name not in known:
                raise DatasetError(f"{where}: '{name}' is not in the schema; add a row to vsfsim/data/schema.py or "
                                   f"leave it out.")
    for field in fields_of(kind):
        value = _value(record, field)
        spot = f"{where} {field.name}"
        if value is None:
            if field.required:
                raise DatasetError(f"{spot} is missing; the schema requires it.")
            continue
        array = check_array(field, value, spot, lengths)
        bad = first_bad(field, array, converged, recorded=recorded)
        if bad is not None:
            frame = f" in frame {bad[0]}, which is marked converged" if field.masked else f" at index {bad}"
            raise DatasetError(f"{spot} is not finite{frame}. Mark the frame as not converged, or mend the simulation; "
                               f"it is never stored as data.")
        _write_array(group, field, array)


def _value(record: Any, field: Field) -> Any:
    table, _, name = field.name.rpartition("/")
    return getattr(record, table).get(name) if table else getattr(record, name)


def _write_array(group: h5py.Group, field: Field, array: np.ndarray) -> None:
    if field.dtype == TEXT:
        encoded = [str(text).encode() for text in array]
        longest = max((len(text) for text in encoded), default=1)
        array = np.array(encoded, dtype=h5py.string_dtype("utf-8", max(longest, 1)))
    options = {"compression": "gzip", "compression_opts": 4, "shuffle": True} if array.nbytes >= _COMPRESS_FROM else {}
    dataset = group.create_dataset(field.name, data=array, track_times=False, **options)
    for key, text in field.attributes.items():
        dataset.attrs[key] = text


def read_view(path: str | Path, *, blind: bool = False) -> ObjectView:
    """Read an object file.

    Args:
        path: the file.
        blind: leave the truth alone; no number of it is read, and `ObjectView.truth` is None.

    Raises:
        DatasetError: not an object file, another schema version, or a dataset that does not fit the schema.
    """
    return _read(Path(path), blind=blind)[0]


def read_shown(path: Path) -> tuple[ObjectView, np.ndarray]:
    """An object file without its truth, but for the places where the small cone was pressed, world (P, 3) [m].

    Raises:
        DatasetError: as `read_view`.
    """
    view, places = _read(path, blind=True, places=True)
    assert places is not None
    return view, places


def read_picture(path: Path) -> np.ndarray:
    """The colour image of an object file (H, W, 3) uint8; no other number of it is read.

    Raises:
        DatasetError: as `read_view`.
    """
    with _opened(path) as (_, items):
        return _field(items, "view/rgb", path)


def _read(path: Path, *, blind: bool, places: bool = False) -> tuple[ObjectView, np.ndarray | None]:
    with _opened(path) as (file, items):
        found = _field(items, "truth/probe_points", path) if places else None
        view = View(**_read_group(items, "view", "view", f"{path} view"))
        touches = tuple(_read_touch(items, f"touches/{name}", f"{path} touches/{name}")
                        for name in sorted(items["touches"]))
        truth = None if blind else Truth(**_read_group(items, "truth", "truth", f"{path} truth"))
        attrs, probes = file.attrs, _probes(file.attrs["probe"], path)
        odd = next((k for k, touch in enumerate(touches) if not 0 <= (touch.press or 0) < len(probes)), None)
        if odd is not None:
            raise DatasetError(f"{path} touches/{odd:03d}/press is {touches[odd].press}, but attribute 'probe' has "
                               f"{len(probes)} shapes. The file is damaged; delete it and generate it again.")
        return ObjectView(check_name(attrs["name"], f"{path} @name"),
                          whole_number(attrs["object_index"], f"{path} @object_index"),
                          whole_number(attrs["view_index"], f"{path} @view_index"),
                          check_name(attrs["split"], f"{path} @split"),
                          probes[0], view, touches, truth, probes[1:]), found


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[h5py.File, Mapping[str, h5py.Group | h5py.Dataset]]]:
    """An object file and every object of it by its path, after all of them were checked; what h5py raises in the block
    means that the file is damaged."""
    if not path.is_file():
        raise DatasetError(f"{path} does not exist.")
    try:
        with h5py.File(path, "r") as file:
            items = check_tree(file, path)
            check_attributes(file, path)
            yield file, items
    except _DAMAGE as error:
        raise _damaged(path, error) from error


def _field(items: Mapping[str, h5py.Group | h5py.Dataset], name: str, path: Path) -> np.ndarray:
    """One field of the view or the truth, e.g. "truth/probe_points"; no other is read."""
    (field,) = (f for f in FIELDS if f.path == name)
    return check_array(field, read_array(items[name], field), f"{path} {name}", {})


_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)
"""What h5py raises on damaged files, by what is damaged."""


IN_USE = (BlockingIOError, PermissionError)
"""What h5py raises on a file that is open for writing elsewhere, which HDF5 locks, or that may not be read."""
CLOSE_IT = "Close it in the program that has it open, or allow yourself to read it; nothing says that it is damaged."


def in_use(path: Path) -> str:
    """Why a file cannot be opened although it may be whole, or "". HDF5 marks a file that is open for writing in its
    bytes, so this comes before a comparison of their sha256."""
    try:
        h5py.File(path, "r").close()
    except IN_USE as error:
        return f"cannot be opened: {os.strerror(error.errno or 0)}."
    except _DAMAGE:
        pass
    return ""


def _damaged(path: Path, error: BaseException) -> DatasetError:
    return DatasetError(f"{path} cannot be read: {plain(error)}. It is damaged; delete it and run the same `vsfsim "
                        f"generate` again, which makes only what is missing.")


def check_attributes(file: h5py.File, path: Path) -> None:
    """Refuse a file that is not an object view of this schema version.

    Raises:
        DatasetError: with what it is instead.
    """
    kind = file.attrs.get("format")
    if not isinstance(kind, str) or kind != FORMAT:
        raise DatasetError(f"{path} is not an object view of vsfsim (its @format is {plain(repr(kind), longest=60)}, "
                           f"not {FORMAT!r}).")
    version = file.attrs.get("schema_version")
    if np.ndim(version) or version != SCHEMA_VERSION:
        raise DatasetError(f"{path} has schema version {plain(version, longest=60)}; this vsfsim reads "
                           f"{SCHEMA_VERSION}. Use the vsfsim version that dataset.json names, or generate it again.")
    for name in ATTRIBUTES:
        if name not in file.attrs:
            raise DatasetError(f"{path} has no attribute '{name}'; it is damaged.")


def _probes(text: str, path: Path) -> tuple[ProbeShape, ...]:
    try:
        return parse_probe_shapes(from_json(text), str(path))
    except (ValueError, TypeError, SceneError) as error:
        raise DatasetError(f"{path}: attribute 'probe' is {plain(text, longest=200)}, not a probe's shape: "
                           f"{plain(error)}") from error


def _read_touch(items: Mapping[str, h5py.Group | h5py.Dataset], name: str, where: str) -> Touch:
    values = _read_group(items, name, "touches/*", where)
    values["touched"] = bool(values["touched"])
    values["press"] = None if values["press"] is None else int(values["press"])
    for table in ("audit", "channels"):
        names = [name for name in values if name.startswith(f"{table}/")]
        columns = {name.partition("/")[2]: values.pop(name) for name in names}
        values[table] = {name: value for name, value in columns.items() if value is not None}
    return Touch(**values)


def _read_group(items: Mapping[str, h5py.Group | h5py.Dataset], name: str, kind: str, where: str) -> dict[str, Any]:
    if name not in items:
        raise KeyError(f"there is no group '{name}'")
    values: dict[str, Any] = {}
    lengths: dict[str, int] = {}
    for field in (*fields_of(kind), *further_fields(items[name], kind, where)):
        item = items.get(f"{name}/{field.name}")
        if item is None:
            if field.required:
                raise DatasetError(f"{where}/{field.name} is missing; the file is damaged or was not "
                                   f"written by vsfsim.")
            values[field.name] = None
            continue
        if not isinstance(item, h5py.Dataset):
            raise DatasetError(f"{where}/{field.name} is a group; the schema has a dataset there.")
        check_shape(field, item.shape, f"{where}/{field.name}", lengths)
        array = read_array(item, field)
        values[field.name] = check_array(field, array, f"{where}/{field.name}", lengths)
        if field.dtype == TEXT:
            values[field.name] = tuple(array)
    return values


def further_fields(group: h5py.Group, kind: str, where: str) -> list[Field]:
    """The channels of a touch that are not in the schema, by their own description.

    Raises:
        DatasetError: one does not describe itself.
    """
    inside = group.get(CHANNELS[:-1]) if kind == "touches/*" else None
    if not isinstance(inside, h5py.Group):
        return []
    known = {field.name for field in fields_of(kind)}
    return [Field.of_channel(CHANNELS + name, str(getattr(item, "dtype", "")), item.attrs, f"{where}/{CHANNELS}{name}")
            for name, item in inside.items() if CHANNELS + name not in known]


def read_array(dataset: h5py.Dataset, field: Field) -> np.ndarray:
    """The values of an HDF5 dataset; text rows decoded to str."""
    array = dataset[()]
    if field.dtype == TEXT:
        if array.dtype.kind != "S" or array.ndim != 1:
            raise DatasetError(f"{dataset.name} has dtype {array.dtype} and shape {array.shape}; it must be a list of "
                               f"texts.")
        return np.array([text.decode() for text in array], dtype=object)
    return np.asarray(array)
