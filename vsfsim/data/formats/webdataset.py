"""WebDataset: tar files, in which a touch is a sample of files with one stem.

    VIEW-TOUCH.json    (a dot in VIEW is %2E) view, number, split, axis, target, names of the arrays
    VIEW-TOUCH.npz     every recorded array of the touch, by the names of the schema
    VIEW-TOUCH.png     the picture of its object
"""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import numpy as np

from vsfsim.data.dataset import Dataset
from vsfsim.data.formats.export import png
from vsfsim.data.records import Touch, Truth, values_of

SIZE = 256 << 20
"""Of a tar file, from which the next one is begun [byte]."""


def export(dataset: Dataset, folder: Path) -> None:
    """Write the dataset into an empty folder, each split in tar files of its own; the truth of a view lies beside them
    in `truth/VIEW.npz`, so that no reader meets it by chance."""
    (folder / "truth").mkdir()
    for split in dataset.splits:
        number, out = 0, None
        for view in dataset.split(split):
            picture = png(view.view.rgb)
            for index, touch in enumerate(view.touches):
                if out is None or out.offset > SIZE:
                    if out is not None:
                        out.close()
                    out = tarfile.open(folder / f"{split}-{number:06d}.tar", "w")
                    number += 1
                arrays = arrays_of(touch)
                del arrays["reason_names"]  # texts
                about = {"view": view.name, "touch": index, "split": view.split, "arrays": sorted(arrays),
                         "reason_names": list(touch.reason_names)}
                # readers take all before the first dot for the key; no name of a view has a %
                stem = f"{view.name.replace('.', '%2E')}-{index:03d}"
                for name, content in ((f"{stem}.json", json.dumps(about).encode()), (f"{stem}.npz", packed(arrays)),
                                      (f"{stem}.png", picture)):
                    item = tarfile.TarInfo(name)
                    item.size = len(content)
                    out.addfile(item, io.BytesIO(content))
            if view.truth is not None:
                (folder / "truth" / f"{view.name}.npz").write_bytes(packed(arrays_of(view.truth)))
        if out is not None:
            out.close()


def arrays_of(record: Touch | Truth) -> dict[str, np.ndarray]:
    """Every array of a record by its name in the schema, with a dot for the slash."""
    return {name.replace("/", "."): np.asarray(value) for name, value in values_of(record).items()}


def packed(arrays: dict[str, np.ndarray]) -> bytes:
    """Arrays as the content of an .npz file; the same arrays give the same bytes."""
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]
    return out.getvalue()
