"""LeRobot v3.0: a touch is an episode, and every frame a row of parquet with the picture of its object.

Numbers of a frame are float32, as training code wants them; the truth, whose length differs from object to object, is
`sidecar/truth.parquet`, and `sidecar/touches.parquet` says which touch of which view an episode is. Written with
pyarrow alone. Source: the loader of the package lerobot (0.4, `codebase_version` v3.0).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.data.dataset import Dataset
from vsfsim.data.formats.tables import arrow, fixed, png, truth_columns, write_table
from vsfsim.data.records import Touch

FPS = 10
"""Nominal rate: touches are quasi-static, and `observation.time` holds their own time."""
_AXES = {"observation.force": ["fx", "fy", "fz"], "observation.torque": [f"joint_{k}" for k in range(7)],
         "observation.q": [f"joint_{k}" for k in range(7)],
         "observation.state": ["x", "y", "z", *(f"r{i}{j}" for i in range(3) for j in range(3))]}
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_CHUNK = 1000  # object views a folder


def export(dataset: Dataset, folder: Path) -> None:
    """Write the dataset into an empty folder.

    Args:
        dataset: finished. folder: where.

    Raises:
        MissingPackage: pyarrow or Pillow is not installed.
    """
    arrow()
    episodes: dict[str, list[Any]] = {key: [] for key in (
        "episode_index", "tasks", "length", "data/chunk_index", "data/file_index", "dataset_from_index",
        "dataset_to_index", "meta/episodes/chunk_index", "meta/episodes/file_index")}
    which: dict[str, list[Any]] = {"episode_index": [], "view": [], "touch": [], "split": []}
    features: dict[str, Any] = {}
    total, sums = 0, _Sums()
    truths: list[Path] = []
    names = [f"touch {dataset.recipe.scene}"]
    splits: dict[str, list[int]] = {}
    # a split is a range of episodes, so that the views of one follow one another
    for number, view in enumerate(view for split in dataset.splits for view in dataset.split(split)):
        picture, columns = png(view.view.rgb), []
        chunk, file = divmod(number, _CHUNK)
        for index, touch in enumerate(view.touches):
            episode, frames = len(which["view"]), len(touch.time)
            rows = frame_rows(touch)
            columns.append({**rows, "timestamp": (np.arange(frames) / FPS).astype(np.float32),
                            "frame_index": np.arange(frames), "episode_index": np.full(frames, episode),
                            "index": total + np.arange(frames), "task_index": np.zeros(frames, np.int64)})
            for key, value in zip(episodes, (episode, names, frames, chunk, file, total, total + frames, 0, 0),
                                  strict=True):
                episodes[key].append(value)
            for key, value in zip(which, (episode, view.name, index, view.split), strict=True):
                which[key].append(value)
            splits.setdefault(view.split, []).append(episode)
            total += frames
        table = {key: np.concatenate([c[key] for c in columns]) for key in columns[0]}
        sums.add(table)
        features = {key: _feature(key, value) for key, value in table.items()}
        size = view.view.rgb.shape
        features["observation.images.rgb"] = {"dtype": "image", "shape": list(size),
                                              "names": ["height", "width", "channels"]}
        count = len(table["index"])
        image = [{"bytes": picture, "path": f"{view.name}.png"}] * count
        write_table(folder / _DATA.format(chunk_index=chunk, file_index=file),
                    {**{key: fixed(value) for key, value in table.items()},
                     "observation.images.rgb": arrow().array(image)})
        truths.append(folder / "sidecar" / "truth" / f"{view.name}.parquet")
        write_table(truths[-1], truth_columns([view]))
    write_table(folder / "meta/episodes/chunk-000/file-000.parquet", episodes)
    write_table(folder / "meta/tasks.parquet", {"task_index": np.arange(1), "task": names}, index="task")
    write_table(folder / "sidecar/touches.parquet", which)
    (folder / "meta/stats.json").write_text(json.dumps(sums.table(), indent=1))
    (folder / "meta/info.json").write_text(json.dumps({
        "codebase_version": "v3.0", "robot_type": "vsfsim", "total_episodes": len(which["view"]), "total_frames": total,
        "total_tasks": 1, "chunks_size": _CHUNK, "data_files_size_in_mb": 100, "video_files_size_in_mb": 200,
        "fps": FPS,
        "splits": {name: f"{min(e)}:{max(e) + 1}" for name, e in splits.items()}, "data_path": _DATA,
        "video_path": None, "features": features}, indent=1))
    (folder / "sidecar/README.md").write_text(
        "truth/VIEW.parquet: every field of the truth as a flat list, and its shape. touches.parquet: view and number "
        f"of the touch of each episode. Made from dataset sha256 {dataset.sha256}.\n")


def frame_rows(touch: Touch) -> dict[str, np.ndarray]:
    """What a frame of an episode holds, by the key of its feature; floating numbers are float32, those of a frame that
    did not converge are NaN or unusable, and `observation.converged` says so."""
    pose = touch.mount_pose.astype(np.float32)
    state = np.concatenate([pose[:, :3, 3], pose[:, :3, :3].reshape(len(pose), 9)], axis=1)
    out = {"observation.state": state, "action": np.concatenate([state[1:], state[-1:]]),
           "observation.force": touch.force.astype(np.float32),
           "observation.time": touch.time.astype(np.float32),
           "observation.converged": np.asarray(touch.converged, bool)}
    for key, value in (("q", touch.q), ("torque", touch.torque), ("pressure", touch.pressure),
                       ("moment", touch.moment)):
        if value is not None:
            out[f"observation.{key}"] = np.asarray(value, np.float32)
    return out


def _feature(key: str, value: np.ndarray) -> dict[str, Any]:
    size = value.shape[1] if value.ndim > 1 else 1
    names = _AXES.get(key, _AXES["observation.state"] if key == "action" else None)
    return {"dtype": str(value.dtype), "shape": [size], "names": names if value.ndim > 1 else None}


class _Sums:
    """Statistics of the columns over finite rows, added up view by view."""

    def __init__(self) -> None:
        self._of: dict[str, list[np.ndarray]] = {}

    def add(self, table: dict[str, np.ndarray]) -> None:
        """Add the rows of a view."""
        for key, value in table.items():
            rows = np.asarray(value, float).reshape(len(value), -1)
            rows = rows[np.isfinite(rows).all(axis=1)]
            found = [np.full(rows.shape[1], np.inf), np.full(rows.shape[1], -np.inf), np.zeros(rows.shape[1]),
                     np.zeros(rows.shape[1]), np.zeros(1)]
            low, high, total, square, count = self._of.setdefault(key, found)
            if len(rows):
                self._of[key] = [np.minimum(low, rows.min(axis=0)), np.maximum(high, rows.max(axis=0)),
                                 total + rows.sum(axis=0), square + (rows**2).sum(axis=0), count + len(rows)]

    def table(self) -> dict[str, dict[str, list[float]]]:
        """As `meta/stats.json` holds it."""
        out = {}
        for key, (low, high, total, square, count) in self._of.items():
            if count[0]:
                mean = total / count
                std = np.sqrt(np.maximum(square / count - mean**2, 0.0))
                out[key] = {"min": low.tolist(), "max": high.tolist(), "mean": mean.tolist(), "std": std.tolist(),
                            "count": [int(count[0])]}
        return out
