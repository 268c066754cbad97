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
from vsfsim.data.formats.tables import arrow, write_table
from vsfsim.data.manifest import MANIFEST

INDEX = "touches.parquet"
_CONTEXT = {
    "@language": "en", "@vocab": "https://schema.org/", "citeAs": "cr:citeAs", "column": "cr:column",
    "conformsTo": "dct:conformsTo", "cr": "http://mlcommons.org/croissant/", "rai": "http://mlcommons.org/croissant/RAI/",
    "data": {"@id": "cr:data", "@type": "@json"}, "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/", "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract",
    "field": "cr:field", "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject", "fileSet": "cr:fileSet",
    "format": "cr:format", "includes": "cr:includes", "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath",
    "key": "cr:key", "md5": "cr:md5", "parentField": "cr:parentField", "path": "cr:path", "recordSet": "cr:recordSet",
    "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated", "replace": "cr:replace",
    "sc": "https://schema.org/", "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField",
    "transform": "cr:transform"}
_COLUMNS = {
    "view": ("sc:Text", "Name of the object view."), "file": ("sc:Text", "Its HDF5 file."),
    "split": ("sc:Text", "Split of its object."), "object_index": ("sc:Integer", "Number of the object."),
    "touch": ("sc:Integer", "Number of the touch in its view."), "frames": ("sc:Integer", "Frames of the touch."),
    "unconverged": ("sc:Integer", "Frames that are marked as not converged."),
    "touched": ("sc:Boolean", "The sensor met the object."),
    "largest_force": ("sc:Float", "Largest norm of the force in a converged frame [N].")}


def export(dataset: Dataset, folder: Path, *, files: bool = True) -> None:
    """Write croissant.json, the index, and the dataset's own files into an empty folder.

    Args:
        dataset: finished. folder: where. files: whether its files are copied there, too.

    Raises:
        MissingPackage: pyarrow is not installed.
    """
    arrow()
    columns: dict[str, list[Any]] = {name: [] for name in _COLUMNS}
    for entry, view in zip(dataset.entries, dataset, strict=True):
        for index, touch in enumerate(view.touches):
            force = np.linalg.norm(touch.force[touch.converged], axis=1)
            row = (view.name, entry.file, view.split, view.object_index, index, len(touch.time),
                   int((~touch.converged).sum()), bool(touch.touched), float(force.max(initial=0.0)))
            for name, value in zip(_COLUMNS, row, strict=True):
                columns[name].append(value)
    write_table(folder / INDEX, columns)
    if files:
        for name in (*(entry.file for entry in dataset.entries), MANIFEST):
            shutil.copyfile(dataset.path / name, folder / name)
    (folder / "croissant.json").write_text(json.dumps(describe(dataset, folder), indent=1) + "\n")


def describe(dataset: Dataset, folder: Path) -> dict[str, Any]:
    """The description, of a folder that holds the index."""
    r = dataset.recipe
    index = folder / INDEX
    objects: list[dict[str, Any]] = [
        {"@type": "cr:FileObject", "@id": INDEX, "name": INDEX, "description": "Index: one row a touch.",
         "contentUrl": INDEX, "encodingFormat": "application/x-parquet", "contentSize": f"{index.stat().st_size} B",
         "sha256": file_sha256(index)}]
    objects += [{"@type": "cr:FileObject", "@id": e.file, "name": e.file, "description": f"Object view {e.name}.",
                 "contentUrl": e.file, "encodingFormat": "application/x-hdf5", "contentSize": f"{e.bytes} B",
                 "sha256": e.sha256} for e in dataset.entries]
    fields = [{"@type": "cr:Field", "@id": f"touches/{name}", "name": name, "description": text, "dataType": kind,
               "source": {"fileObject": {"@id": INDEX}, "extract": {"column": name}}}
              for name, (kind, text) in _COLUMNS.items()]
    return {
        "@context": _CONTEXT, "@type": "sc:Dataset",
        "conformsTo": ["http://mlcommons.org/croissant/1.0", "http://mlcommons.org/croissant/RAI/1.0"],
        "name": f"vsfsim-{r.scene}", "version": "1.0.0", "license": "https://www.apache.org/licenses/LICENSE-2.0",
        "description": f"Simulated vision and touch of deformable objects with their true stiffness: scene {r.scene}, "
                       f"seed {r.seed}, tier {r.tier}. sha256 of the content: {dataset.sha256}.",
        "url": f"https://example.org/vsfsim-{quote(r.scene)}", "datePublished": "2026-01-01",
        "creator": {"@type": "sc:Organization", "name": "vsfsim"},
        "citeAs": f"vsfsim {dataset.made_by.get('vsfsim')}, dataset {r.scene}, sha256 {dataset.sha256[:16]}",
        "rai:dataCollection": "Generated by a quasi-static finite-element or beam simulation from a published scene "
                              "file; no person and no place was recorded.",
        "rai:dataCollectionType": "Software Collection",
        "rai:dataLimitations": "Touches are quasi-static, materials come from the literature and not from the objects "
                               "that a scene imitates; frames that did not converge are marked and not to be used.",
        "rai:dataBiases": "Shapes and moduli follow the distributions of the scene file, not those of a population of "
                          "real objects.",
        "rai:personalSensitiveInformation": "None.",
        "rai:dataUseCases": "Training and testing of estimators of stiffness from vision and touch.",
        "rai:dataSocialImpact": "None is known; a policy that was trained on simulated forces alone must be tested "
                                "before it touches people.",
        "rai:hasSyntheticData": True, "distribution": objects,
        "recordSet": [{"@type": "cr:RecordSet", "@id": "touches", "name": "touches",
                       "description": "One record a touch.", "field": fields}]}
