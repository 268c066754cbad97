"""The schema table, the records and the files say the same thing, units and all."""

import dataclasses
import json
import re
from pathlib import Path

import h5py
import numpy as np
import pytest
from field_docs import docs_of

from vsfsim.bench.mock import mock_view
from vsfsim.data import records
from vsfsim.data.hdf5 import write_view
from vsfsim.data.manifest import make_manifest
from vsfsim.data.recipe import Recipe
from vsfsim.data.schema import FIELDS, MANIFEST_KEYS, TEXT, fields_of, schema_markdown

UNITLESS = {"1"}


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
    write_view(path, mock_view(0))
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


@pytest.mark.parametrize(("record", "group"), [(records.View, "view"), (records.Touch, "touches/*"),
                                               (records.Truth, "truth")])
def test_records_and_schema_have_the_same_fields(record, group):
    names = {f.name.split("/")[0] for f in fields_of(group)}
    tables = {"channels"} if record is records.Touch else set()  # rows of sensors without a field of their own
    assert {f.name for f in dataclasses.fields(record)} == names | tables


@pytest.mark.parametrize(("record", "group"), [(records.View, "view"), (records.Touch, "touches/*"),
                                               (records.Truth, "truth")])
def test_records_document_shape_and_unit_of_each_field(record, group):
    docs = docs_of(record)
    for field in fields_of(group):
        name, _, column = field.name.partition("/")
        text = docs[name]
        assert text, f"{record.__name__}.{name} is not documented"
        if column:
            entry = re.search(rf"{column} = [^;]*", text)
            assert entry, field.path
            text = entry[0]
        if column or field.unit not in UNITLESS:
            assert f"[{'-' if field.unit == '1' else field.unit}]" in text, f"{field.path}: {text}"
        if field.dims and field.dtype != TEXT and not column:
            shape = f"({', '.join(field.dims)}{',' if len(field.dims) == 1 else ''})"
            assert shape in text, f"{field.path}: {text}"


def test_docs_page_lists_every_field():
    page = schema_markdown()
    for field in FIELDS:
        assert f"| `{field.path}` | {field.dtype} | {field.dims_text} | {field.unit} |" in page


def test_the_docs_page_in_the_repository_is_up_to_date():
    page = Path(__file__).parents[2] / "docs" / "dataset.md"
    renew = ("python -c 'from vsfsim.data.schema import schema_markdown; print(schema_markdown(), end=\"\")' > "
             "docs/dataset.md")
    assert page.read_text() == schema_markdown(), f"renew it: {renew}"


def test_docs_page_lists_every_key_of_the_manifest():
    recipe = Recipe(scene="mock", scene_text="", seed=0, objects=1, views=1, touches=1, splits={"test": 1},
                    device="cpu", tier="vsf",
                    precision="float64", renderer="warp", options={"accuracy": {"asked": 0.05, "expected": 0.02}})
    assert set(json.loads(make_manifest(recipe, {}, (), {"a": "why"}))) == set(MANIFEST_KEYS)


def test_docs_page_tables_have_whole_rows():
    """A | in a sentence would cut its row in two."""
    rows = [line for line in schema_markdown().splitlines() if line.startswith("| `")]
    assert {line.count("|") for line in rows} == {3, 4, 7}
