"""LeRobot v3.0: a touch is an episode, and every frame a row of parquet with the picture of its object.

Numbers of a frame are float32, as training code wants them; the truth, whose length differs from object to object, is
`sidecar/truth.parquet`, and `sidecar/touches.parquet` says which touch of which view an episode is. Written with
pyarrow alone. Source: the loader of the package lerobot (0.4, `codebase_version` v3.0).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.data.dataset import Dataset
from vsfsim.data.formats.export import arrow, columns_of, fixed, png, truth_columns, write_table
from vsfsim.data.records import Touch

FPS = 10
"""Nominal rate: touches are quasi-static, and `observation.time` holds their own time."""
_AXES = {"observation.force": ["fx", "fy", "fz"], "observation.torque": [f"joint_{k}" for k in range(7)],
         "observation.q": [f"joint_{k}" for k in range(7)],
         "observation.state": ["x", "y", "z", *(f"r{i}{j}" for i in range(3) for j in range(3))]}
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODE = ("episode_index", "tasks", "length", "data/chunk_index", "data/file_index", "dataset_from_index",
            "dataset_to_index", "meta/episodes/chunk_index", "meta/episodes/file_index")
_CHUNK = 1000  # object views a folder


def export(dataset: Dataset, folder: Path) -> None:
    """Write the dataset into an empty folder.

    Args:
        dataset: finished. folder: where.

    Raises:
        MissingPackage: pyarrow or Pillow is not installed.
    """
    arrow()
    names = [f"touch {dataset.recipe.scene}"]
    features: dict[str, Any] = {}
    episodes: list[tuple[Any, ...]] = []
    which: list[tuple[Any, ...]] = []
    tables: list[dict[str, np.ndarray]] = []
    splits: dict[str, list[int]] = {}
    total = 0
    # a split is a range of episodes, so that the views of one follow one another
    for number, view in enumerate(view for split in dataset.splits for view in dataset.split(split)):
        columns = []
        chunk, file = divmod(number, _CHUNK)
        for index, touch in enumerate(view.touches):
            episode, frames = len(which), len(touch.time)
            columns.append({**frame_rows(touch), "timestamp": (np.arange(frames) / FPS).astype(np.float32),
                            "frame_index": np.arange(frames), "episode_index": np.full(frames, episode),
                            "index": total + np.arange(frames), "task_index": np.zeros(frames, np.int64)})
            episodes.append((episode, names, frames, chunk, file, total, total + frames, 0, 0))
            which.append((episode, view.name, index, view.split))
            splits.setdefault(view.split, []).append(episode)
            total += frames
        table = {key: np.concatenate([c[key] for c in columns]) for key in columns[0]}
        tables.append(table)
        features = {key: _feature(key, value) for key, value in table.items()}
        features["observation.images.rgb"] = {"dtype": "image", "shape": list(view.view.rgb.shape),
                                              "names": ["height", "width", "channels"]}
        image = [{"bytes": png(view.view.rgb), "path": f"{view.name}.png"}] * len(table["index"])
        write_table(folder / _DATA.format(chunk_index=chunk, file_index=file),
                    {**{key: fixed(value) for key, value in table.items()},
                     "observation.images.rgb": arrow().array(image)})
        write_table(folder / "sidecar" / "truth" / f"{view.name}.parquet", truth_columns([view]))
    write_table(folder / "meta/episodes/chunk-000/file-000.parquet", columns_of(_EPISODE, episodes))
    write_table(folder / "meta/tasks.parquet", {"task_index": np.arange(1), "task": names}, index="task")
    write_table(folder / "sidecar/touches.parquet", columns_of(("episode_index", "view", "touch", "split"), which))
    (folder / "meta/stats.json").write_text(json.dumps(_statistics(tables), indent=1))
    (folder / "meta/info.json").write_text(json.dumps({
        "codebase_version": "v3.0", "robot_type": "vsfsim", "total_episodes": len(which), "total_frames": total,
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


def _statistics(tables: Sequence[dict[str, np.ndarray]]) -> dict[str, dict[str, list[float]]]:
    """Of the columns over their finite rows."""
    out = {}
    for key in tables[0]:
        rows = np.concatenate([np.asarray(table[key], float).reshape(len(table[key]), -1) for table in tables])
        rows = rows[np.isfinite(rows).all(axis=1)]
        if len(rows):
            out[key] = {name: value.tolist() for name, value in (
                ("min", rows.min(axis=0)), ("max", rows.max(axis=0)), ("mean", rows.mean(axis=0)),
                ("std", rows.std(axis=0)), ("count", np.array([len(rows)])))}
    return out
