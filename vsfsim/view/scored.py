"""What the page shows of a result: true and estimated stiffness side by side."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.result import Result
from vsfsim.bench.result_file import MAP_ORIGIN, MAP_STEP
from vsfsim.bench.task import load_task
from vsfsim.core.errors import DatasetError, TaskError
from vsfsim.data.dataset import Dataset
from vsfsim.view.subject import of_view, of_visible, picture_table, touch_table

_FLOOR = 1e-2  # an estimate is shown down to this share of the smallest true stiffness of its object


def of_result(path: Path, objects: int, progress: Callable[[int, int, str], None] = lambda *_: None
              ) -> tuple[str, str, list[dict[str, Any]], dict]:
    """The objects of a result file, the first ``objects`` of them.

    Returns:
        Title, a line that says what is shown, the objects, and what the page says of all of them.

    Raises:
        TaskError: the file is no result, or neither its dataset nor an estimate of the stiffness is there to show.
    """
    result = Result.load(path)
    dataset, maps = _dataset(result), _maps(result)
    if dataset is None:
        raise TaskError(f"{path}: the dataset of {result.task}, whose objects are shown, is not on this machine. Set "
                        "$VSFSIM_DATASETS to the folder that has it.")
    names = sorted({*result.queries.get("object", ()), *maps})
    shown = []
    for number, name in enumerate(names[:objects]):
        shown.append(_object(name, dataset, maps.get(name)))
        progress(number + 1, min(len(names), objects), "object views")
    told = "true and estimated stiffness" if maps else "no estimate of the stiffness"
    about: dict[str, Any] = {"map": ["stiffness under a small cone", "N/m"]} if maps else {}
    return (f"{result.method} on {result.task}",
            f"{len(shown)} of {len(names)} object views: {told}", shown, about)


def _dataset(result: Result) -> Dataset | None:
    """The dataset that was asked, where it is on this machine."""
    try:
        found = Dataset.open(load_task(result.task).dataset.path())
    except (DatasetError, TaskError):
        return None
    return found if found.sha256 == result.dataset_sha256 else None


def _maps(result: Result) -> dict[str, np.ndarray]:
    """Place [m], true stiffness [N/m] and estimate in the same unit (k, 5), by object view."""
    if not result.maps:
        return {}
    m = result.maps
    rows = np.column_stack([*((np.array(m[axis], float) - MAP_ORIGIN) * MAP_STEP for axis in "xyz"),
                            np.array(m["truth"], float), np.array(m["mean"], float)])
    out = {}
    for name in dict.fromkeys(m["object"]):
        mine = rows[[one == name for one in m["object"]]]
        mine = mine[mine[:, 3] > 0.0]  # a cone that met nothing has no stiffness
        if len(mine):
            ratio = mine[:, 3] / np.where(mine[:, 4] > 0.0, mine[:, 4], np.nan)
            mine[:, 4] = np.maximum(mine[:, 4] * 10.0 ** np.nanmedian(np.log10(ratio)), _FLOOR * mine[:, 3].min())
            out[name] = mine
    return out


def _object(name: str, dataset: Dataset, found: np.ndarray | None) -> dict[str, Any]:
    shown = dataset.load(name)
    if found is None:
        return of_view(dataset, shown)
    truth, estimate = (of_visible(shown.view, found[:, k], found[:, :3]) for k in (3, 4))
    return {"name": name, "touches": [touch_table(touch, shown.probe_of(touch)) for touch in shown.touches],
            "picture": picture_table(shown.view), **truth, "estimate": estimate["log_modulus"],
            "about": f"the visible surface by the nearest of {len(found)} probed places; estimate scaled by one factor"}
