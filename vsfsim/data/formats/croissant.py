"""Croissant: a description of the dataset in JSON-LD, valid by `mlcroissant`, and a parquet index of its touches.

Croissant has no records over HDF5, so that the index is a table: one row a touch. The responsible-AI fields are those
that a dataset track asks for. Source: the Croissant 1.0 and RAI 1.0 vocabularies of MLCommons.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import file_sha256
from vsfsim.data.formats.export import arrow, columns_of, write_table
from vsfsim.data.manifest import MANIFEST

INDEX = "touches.parquet"
_COLUMNS = {
    "view": ("sc:Text", "Name of the object view."), "file": ("sc:Text", "Its HDF5 file."),
    "split": ("sc:Text", "Split of its object."), "object_index": ("sc:Integer", "Number of the object."),
    "touch": ("sc:Integer", "Number of the touch in its view."), "frames": ("sc:Integer", "Frames of the touch."),
    "unconverged": ("sc:Integer", "Frames that are marked as not converged."),
    "touched": ("sc:Boolean", "The sensor met the object."),
    "largest_force": ("sc:Float", "Largest norm of the force in a converged frame [N].")}


def export(dataset: Dataset, folder: Path) -> None:
    """Write croissant.json, the index, and the dataset's own files into an empty folder.

    Args:
        dataset: finished. folder: where.

    Raises:
        MissingPackage: pyarrow is not installed.
    """
    arrow()
    rows = []
    for entry, view in zip(dataset.entries, dataset, strict=True):
        for index, touch in enumerate(view.touches):
            force = np.linalg.norm(touch.force[touch.converged], axis=1)
            rows.append((view.name, entry.file, view.split, view.object_index, index, len(touch.time),
                         int((~touch.converged).sum()), bool(touch.touched), float(force.max(initial=0.0))))
    write_table(folder / INDEX, columns_of(_COLUMNS, rows))
    for name in (*(entry.file for entry in dataset.entries), MANIFEST):
        shutil.copyfile(dataset.path / name, folder / name)
    (folder / "croissant.json").write_text(json.dumps(describe(dataset, folder), indent=1) + "\n")


def describe(dataset: Dataset, folder: Path) -> dict[str, Any]:
    """The description, of a folder that holds the index: `croissant.json` beside this file says what all have."""
    r = dataset.recipe
    index = folder / INDEX
    files = [(INDEX, "Index: one row a touch.", "parquet", index.stat().st_size, file_sha256(index)),
             *((e.file, f"Object view {e.name}.", "hdf5", e.bytes, e.sha256) for e in dataset.entries)]
    objects = [{"@type": "cr:FileObject", "@id": name, "name": name, "description": text, "contentUrl": name,
                "encodingFormat": f"application/x-{kind}", "contentSize": f"{size} B", "sha256": digest}
               for name, text, kind, size, digest in files]
    fields = [{"@type": "cr:Field", "@id": f"touches/{name}", "name": name, "description": text, "dataType": kind,
               "source": {"fileObject": {"@id": INDEX}, "extract": {"column": name}}}
              for name, (kind, text) in _COLUMNS.items()]
    table = json.loads(Path(__file__).with_suffix(".json").read_text())
    table |= {
        "name": f"vsfsim-{r.scene}", "url": f"https://example.org/vsfsim-{quote(r.scene)}", "distribution": objects,
        "description": f"Simulated vision and touch of deformable objects with their true stiffness: scene {r.scene}, "
                       f"seed {r.seed}, tier {r.tier}. sha256 of the content: {dataset.sha256}.",
        "citeAs": f"vsfsim {dataset.made_by.get('vsfsim')}, dataset {r.scene}, sha256 {dataset.sha256[:16]}"}
    table["recordSet"][0]["field"] = fields
    return table
