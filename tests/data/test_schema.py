"""The schema, the files and the docs page say the same thing, units and all."""

import dataclasses
import inspect
import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from mock_dataset import recipe_of

from vsfsim.bench.mock import mock_view
from vsfsim.data.hdf5 import encode_view
from vsfsim.data.manifest import make_manifest
from vsfsim.data.records import AUDIT_COLUMNS, CONTACT_COLUMNS, MESH_COLUMNS, Touch, Truth, View
from vsfsim.data.schema import ATTRIBUTES, FIELDS, TABLES, TEXT, fields_of

PAGE = (Path(__file__).parents[2] / "docs" / "dataset.md").read_text()


def test_every_field_has_dims_and_a_unit_from_the_si_list():
    for field in FIELDS:
        assert field.unit in {"1", "m", "s", "N", "J", "Pa", "N/m", "N m", "rad", "px"}, field.path
        assert all(re.fullmatch(r"\d+|[A-Za-z]", dim) for dim in field.dims), field.path
        assert field.doc.endswith("."), field.path
        if field.dtype != TEXT:
            np.dtype(field.dtype)
        if field.masked:
            assert field.dims[0] == "T", field.path
    assert len({f.path for f in FIELDS}) == len(FIELDS)


def test_file_carries_units_and_dims_on_every_dataset(tmp_path):
    path = tmp_path / "a.h5"
    path.write_bytes(encode_view(mock_view(0)))
    by_path = {f.path: f for f in FIELDS}
    seen = set()

    def look(name, item):
        if isinstance(item, h5py.Dataset):
            field = by_path[re.sub(r"^touches/\d{3}", "touches/*", name)]
            assert item.attrs["units"] == field.unit, name
            assert item.attrs["dims"] == field.dims_text, name
            seen.add(field.path)

    with h5py.File(path, "r") as file:
        file.visititems(look)
        assert list(file) == ["view", "touches", "truth"], "truth must be the last group"
    # a solid has the smallest det F, a rigid probe the resolution of its contact; plants and bubbles have neither
    assert seen == {f.path for f in FIELDS if f.required} | {
        f"touches/*/audit/{name}" for name in ("min_det_f", "contact_points", "contact_radius")}


def test_the_docs_page_ends_with_the_tables_of_all_fields():
    # a | in a sentence would cut its row in two
    assert {line.count("|") for line in TABLES.splitlines() if line.startswith("| `")} == {7}
    assert PAGE.endswith('--8<-- "schema.md"\n'), "docs/dataset.md includes vsfsim/data/schema.md"


@pytest.mark.parametrize(("record", "group"), [(View, "view"), (Touch, "touches/*"), (Truth, "truth")])
def test_the_fields_of_a_record_are_the_rows_of_its_group(record, group):
    """By name, by what may be None, and by shape and unit in the comment beside each."""
    rows = {row.name: row for row in fields_of(group) if "/" not in row.name}
    fields = {field.name: field for field in dataclasses.fields(record) if field.name not in ("audit", "channels")}
    assert [*fields] == [*rows] and all((fields[name].default is None) != row.required for name, row in rows.items())
    said = dict(re.findall(r"^    (\w+): .*  # (.*)$", inspect.getsource(record), re.MULTILINE))
    for name, row in rows.items():
        shape = f"({', '.join(row.dims)}{',' * (len(row.dims) == 1)}) " if row.dims else ""
        assert said[name] == f"{shape}[{'-' if row.unit == '1' else row.unit}]", name


def test_the_columns_of_the_audit_are_rows():
    columns = {row.name.removeprefix("audit/"): row for row in FIELDS if row.name.startswith("audit/")}
    assert {name for name, row in columns.items() if row.required} == {*AUDIT_COLUMNS} - {"min_det_f"}
    assert {*AUDIT_COLUMNS, *CONTACT_COLUMNS, *MESH_COLUMNS} < columns.keys()


def test_docs_page_lists_every_attribute_and_every_key_of_the_manifest():
    recipe = recipe_of([mock_view(0)], options={"accuracy": {"asked": 0.05, "factor": 1.0, "expected": 0.02}})
    listed = re.findall(r"^\| `(\w+)` \|", PAGE, re.MULTILINE)
    assert listed == [*json.loads(make_manifest(recipe, {}, (), {"a": "why"})), *ATTRIBUTES]
