"""What a page shows as a recording for the Rerun viewer (rerun.io), where the package ``rerun-sdk`` is installed."""

from __future__ import annotations

import base64
import os
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.board.charts import colour_of
from vsfsim.core.errors import DatasetError
from vsfsim.view.subject import values_of

ARROW = 0.01
"""Length of an arrow for one newton [m]."""
BARE = (150, 150, 155)


def write_rerun(path: Path, title: str, objects: Sequence[dict[str, Any]], about: dict[str, Any]) -> None:
    """Write objects as `vsfsim.view.command.page` takes them; the file appears whole or not at all.

    Each object is an entity of its name: ``true`` (and ``estimated`` beside it) as balls, ``picture``, and along the
    timeline "frame", touch after touch, ``probe``, ``force`` and the scalars of its touches.

    Raises:
        DatasetError: the file cannot be written.
    """
    import rerun as rr

    part = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
    recording = rr.RecordingStream("vsfsim", recording_id=title)
    try:
        recording.save(part)
        logs = [m for one in objects for m in (one["log_modulus"], one.get("estimate")) if m]
        low, high = (f(m["low"][0] + k * m["span"][0] for m in logs) if logs else float(k)
                     for f, k in ((min, 0), (max, 1)))
        for one in objects:
            _log(recording, one, about, low, high)
        recording.flush()
        recording.disconnect()
        os.replace(part, path)
    except (OSError, RuntimeError) as error:
        raise DatasetError(f"{path} cannot be written: {error}. Choose another --rerun.") from error
    finally:
        part.unlink(missing_ok=True)


def _log(recording: Any, one: dict[str, Any], about: dict[str, Any], low: float, high: float) -> None:
    import rerun as rr

    name, points, radii = one["name"], values_of(one["points"]), values_of(one["radius"])[:, 0]
    beside = np.array([1.2 * np.ptp(points[:, 0]), 0.0, 0.0])
    for key, what, shift in (("log_modulus", "true", 0.0), ("estimate", "estimated", 1.0)):
        if key == "log_modulus" or one.get(key):
            colours = _colours(values_of(one[key])[:, 0], low, high) if one.get(key) else BARE
            recording.log(f"{name}/{what}", rr.Points3D(points + shift * beside, radii=radii,
                                                        colors=colours), static=True)
    if one["picture"]:
        content = base64.b64decode(one["picture"]["rgb"].partition(",")[2])
        recording.log(f"{name}/picture", rr.EncodedImage(contents=content, media_type="image/png"), static=True)
    frame = 0
    for number, touch in enumerate(one["touches"]):
        for k, place in enumerate(touch["place"]):
            recording.set_time("frame", sequence=frame)
            frame += 1
            label, force = f"touch {touch.get('number', number)}", touch["force"][k]
            recording.log(f"{name}/probe", rr.Points3D([place], radii=touch["probe_radius"] or 0.002, labels=label))
            if None not in force:
                recording.log(f"{name}/force", rr.Arrows3D(origins=[place], vectors=[ARROW * np.array(force)]))
            scalars = {"normal_force": touch["normal_force"][k],
                       "pressure": touch["pressure"] and touch["pressure"][k],
                       "reading": touch["reading"][k] if "reading" in touch else None,
                       **{f"predicted/{shot}-shot": told[k] for shot, told in zip(
                           about.get("shots", ()), touch.get("predicted", ()))}}
            for what, value in scalars.items():
                if value is not None:
                    recording.log(f"{name}/{what}", rr.Scalars(value))


def _colours(log: np.ndarray, low: float, high: float) -> np.ndarray:
    share = (log - low) / max(high - low, 1e-6)
    return np.array([list(bytes.fromhex(colour_of(at)[1:])) for at in share.tolist()], np.uint8)
