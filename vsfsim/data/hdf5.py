"""One object view to one HDF5 file and back; the same input gives the same bytes."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import h5py
import numpy as np

from vsfsim.core.errors import DatasetError, SceneError
from vsfsim.core.plain_text import from_json, plain
from vsfsim.core.shape import ProbeShape, parse_probe_shapes, probe_tables
from vsfsim.data.disk import file_sha256
from vsfsim.data.records import ObjectView, Touch, Truth, View, values_of
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

Items: TypeAlias = Mapping[str, h5py.Group | h5py.Dataset]
_COMPRESS_FROM = 4096  # bytes; below this a chunk's own bookkeeping costs more than it saves


def encode_view(object_view: ObjectView) -> bytes:
    """The bytes of the file of ``object_view``, truth and all. Nothing in them depends on the clock or the machine.

    Raises:
        DatasetError: a field does not fit the schema, or a number is not finite in a frame marked converged.
    """
    if object_view.truth is None:
        raise DatasetError(f"object view '{object_view.name}' has no truth (it is blind); a dataset stores "
                           f"the truth too.")
    if len(object_view.touches) > 1000:
        raise DatasetError(f"object view '{object_view.name}' has {len(object_view.touches)} touches; a file holds "
                           f"at most 1000. Use more views.")
    # In memory first: then every way a disk can fail is a plain OSError of one write.
    with h5py.File("object-view", "w", driver="core", backing_store=False, libver="v108", track_order=True) as file:
        values = {"format": FORMAT, "schema_version": SCHEMA_VERSION, "name": object_view.name,
                  "object_index": int(object_view.object_index), "view_index": int(object_view.view_index),
                  "split": object_view.split, "probe": json.dumps(probe_tables(object_view.probes))}
        for key in ATTRIBUTES:
            file.attrs[key] = values[key]
        recorded = not len(object_view.truth.points)
        for place, kind, record in _records(object_view):
            if place != "view" and "touches" not in file:
                file.create_group("touches", track_order=True)
            group = file.create_group(place, track_order=True)
            for field, array in _checked(record, fields_of(kind), f"{object_view.name} {place}", recorded):
                _write_array(group, field, array)
        file.flush()
        return file.id.get_file_image()


def _records(object_view: ObjectView) -> Iterator[tuple[str, str, View | Touch | Truth]]:
    """Path, group of the schema and record of every group of fields, in the order of the file."""
    yield "view", "view", object_view.view
    for index, touch in enumerate(object_view.touches):
        yield f"touches/{index:03d}", "touches/*", touch
    if object_view.truth is not None:
        yield "truth", "truth", object_view.truth


def _checked(record: View | Touch | Truth, rows: Sequence[Field], where: str,
             recorded: bool) -> Iterator[tuple[Field, np.ndarray]]:
    """The arrays of a record that a file holds, by their rows.

    Args:
        record: what is stored. rows: what it may hold. where: for messages. recorded: see `first_bad`.

    Raises:
        DatasetError: one is missing, has no row or does not fit it, or is not finite where it must be.
    """
    lengths: dict[str, int] = {}
    values = values_of(record)
    for odd in sorted(values.keys() - {field.name for field in rows}):
        raise DatasetError(f"{where}: '{odd}' is not in the schema; add a row to vsfsim/data/schema.md or leave it "
                           f"out.")
    for field in rows:
        spot = f"{where}/{field.name}"
        if field.name not in values:
            if field.required:
                raise DatasetError(f"{spot} is missing; the schema requires it.")
            continue
        array = check_array(field, values[field.name], spot, lengths)
        bad = first_bad(field, array, getattr(record, "converged", None), recorded=recorded)
        if bad is not None:
            frame = f" in frame {bad[0]}, which is marked converged" if field.masked else ""
            raise DatasetError(f"{spot}{list(bad)} is not finite{frame}. Mark the frame as not converged, or mend the "
                               f"simulation; it is never stored as data.")
        yield field, array


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
    with _opened(Path(path)) as (items, attributes):
        return _view(items, attributes, Path(path), blind=blind)


def read_shown(path: Path) -> tuple[ObjectView, np.ndarray]:
    """An object file without its truth, but for the places where the small cone was pressed, world (P, 3) [m].

    Raises:
        DatasetError: as `read_view`.
    """
    (field,) = (f for f in FIELDS if f.path == "truth/probe_points")
    with _opened(path) as (items, attributes):
        places = check_array(field, _array(items[field.path], field), f"{path} {field.path}", {})
        return _view(items, attributes, path, blind=True), places


def examine(path: Path) -> tuple[ObjectView | None, list[str]]:
    """Read an object file and compare all that `read_view` takes on trust with what is stored of its view: units, exact
    dtypes, fields that are not in the schema, numbers that are not finite.

    Returns:
        The object view, and what is wrong; None with anything that is.
    """
    faults: list[str] = []
    try:
        with _opened(path) as (items, attributes):
            view = _view(items, attributes, path)
            assert view.truth is not None
            known = {"touches"}
            for place, kind, record in _records(view):
                rows = _rows_of(items[place], kind, f"{path} {place}")
                for field, _ in _checked(record, rows, place, not len(view.truth.points)):
                    spot = f"{place}/{field.name}"
                    item = items[spot]
                    known |= {place, spot.rpartition("/")[0], spot}
                    for key, want in field.attributes.items():
                        if item.attrs.get(key) != want:
                            faults.append(f"{spot} has @{key} {item.attrs.get(key)!r}; the schema says {want!r}.")
                    if field.dtype != TEXT and item.dtype != np.dtype(field.dtype):
                        faults.append(f"{spot} has dtype {item.dtype}; the schema says {field.dtype}.")
            faults += [f"{spot} is not in the schema." for spot in items if spot not in known]
    except DatasetError as error:
        faults.append(str(error))
    return (None if faults else view), faults


def _view(items: Items, attributes: h5py.AttributeManager, path: Path, *, blind: bool = False) -> ObjectView:
    """The object view of an open file; the truth of a blind one is not read."""
    shown = View(**_fields(items, "view", "view", path))
    touches = []
    for name in sorted(items["touches"]):
        values = _fields(items, f"touches/{name}", "touches/*", path)
        press = None if values["press"] is None else int(values["press"])
        touches.append(Touch(**{**values, "touched": bool(values["touched"]), "press": press}))
    truth = None if blind else Truth(**_fields(items, "truth", "truth", path))
    probes = _probes(attributes["probe"], path)
    for k, touch in enumerate(touches):
        if not 0 <= (touch.press or 0) < len(probes):
            raise DatasetError(f"{path} touches/{k:03d}/press is {touch.press}, but attribute 'probe' has "
                               f"{len(probes)} shapes. The file is damaged; delete it and generate it again.")
    return ObjectView(check_name(attributes["name"], f"{path} @name"),
                      whole_number(attributes["object_index"], f"{path} @object_index"),
                      whole_number(attributes["view_index"], f"{path} @view_index"),
                      check_name(attributes["split"], f"{path} @split"), probes[0], shown, tuple(touches), truth,
                      probes[1:])


def _fields(items: Items, place: str, kind: str, path: Path) -> dict[str, Any]:
    """The fields of a record, None where there is none; columns of the audit and channels in tables of their own."""
    values: dict[str, Any] = {}
    lengths: dict[str, int] = {}
    if place not in items:
        raise KeyError(f"there is no group '{place}'")
    for field in _rows_of(items[place], kind, f"{path} {place}"):
        item, where = items.get(f"{place}/{field.name}"), f"{path} {place}/{field.name}"
        if item is None and field.required:
            raise DatasetError(f"{where} is missing; the file is damaged or was not written by vsfsim.")
        if isinstance(item, h5py.Group):
            raise DatasetError(f"{where} is a group; the schema has a dataset there.")
        if item is not None:
            check_shape(field, item.shape, where, lengths)
        array = None if item is None else check_array(field, _array(item, field), where, lengths)
        if "/" not in field.name:
            values[field.name] = tuple(array) if array is not None and field.dtype == TEXT else array
        elif array is not None:
            table, column = field.name.split("/")
            values.setdefault(table, {})[column] = array
    return values


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[tuple[Items, h5py.AttributeManager]]:
    """Every object of an object file by its path, after all of it was checked, and the file's attributes; what h5py
    raises in the block means that the file is damaged."""
    if not path.is_file():
        raise DatasetError(f"{path} does not exist.")
    try:
        with h5py.File(path, "r") as file:
            items = check_tree(file, path)
            _check_attributes(file, path)
            yield items, file.attrs
    except _DAMAGE as error:
        raise DatasetError(f"{path} cannot be read: {plain(error)}. It is damaged; delete it and run the same `vsfsim "
                           f"generate` again, which makes only what is missing.") from error


_DAMAGE = (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, OverflowError, MemoryError)
"""What h5py raises on damaged files, by what is damaged."""


def fault_of(path: Path, sha256: str) -> tuple[str, str] | None:
    """Why a file of a dataset, which should have this ``sha256``, is not to be read, and what to do; None if it is."""
    if path.is_symlink():
        return "is a link; a dataset is one folder with plain files.", "Copy the file into it."
    if not path.is_file():
        return "is missing.", "Run the same `vsfsim generate` again; it makes only what is missing."
    # HDF5 marks a file that is open for writing in its bytes, so this comes before a comparison of their sha256.
    try:
        h5py.File(path, "r").close()
    except (BlockingIOError, PermissionError) as error:  # it is open for writing elsewhere, or may not be read
        return f"cannot be opened: {os.strerror(error.errno or 0)}.", _CLOSE_IT
    except _DAMAGE:
        pass
    if file_sha256(path) != sha256:
        return "was changed after it was written (its sha256 does not fit).", MAKE_AGAIN
    return None


MAKE_AGAIN = "Delete this file and run the same `vsfsim generate` again; it makes only what is missing."
_CLOSE_IT = "Close it in the program that has it open, or allow yourself to read it; nothing says that it is damaged."


def _check_attributes(file: h5py.File, path: Path) -> None:
    """Refuse a file that is not an object view of this schema version."""
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


def _rows_of(group: h5py.Group, kind: str, where: str) -> list[Field]:
    """The rows of a group of a file: those of the schema, and its channels that are not in the schema, by their own
    description.

    Raises:
        DatasetError: a channel does not describe itself.
    """
    rows = list(fields_of(kind))
    inside = group.get(CHANNELS[:-1]) if kind == "touches/*" else None
    known = {field.name for field in rows}
    for name, item in inside.items() if isinstance(inside, h5py.Group) else ():
        if CHANNELS + name not in known:
            rows.append(Field.of_channel(CHANNELS + name, str(getattr(item, "dtype", "")), item.attrs,
                                         f"{where}/{CHANNELS}{name}"))
    return rows


def _array(dataset: h5py.Dataset, field: Field) -> np.ndarray:
    """The values of an HDF5 dataset; text rows decoded to str."""
    array = dataset[()]
    if field.dtype == TEXT:
        if array.dtype.kind != "S" or array.ndim != 1:
            raise DatasetError(f"{dataset.name} has dtype {array.dtype} and shape {array.shape}; it must be a list of "
                               f"texts.")
        return np.array([text.decode() for text in array], dtype=object)
    return np.asarray(array)
