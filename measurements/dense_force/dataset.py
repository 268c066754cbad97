"""The comparison of `dense_force` on the touches of a dataset made with a bubble: soft objects instead of rigid balls.

The estimators are calibrated on touches of the train split and scored on the test split, a few frames of each touch.
Where the bubble of the dataset was simulated on the read-out mesh itself, `membrane` shares mesh and law with it, and
its error without noise says nothing; a note says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from measurements.dense_force import NOISE, Contender, Row, compare, contenders, errors_of, report
from measurements.dense_force.calibration import PressRecord
from measurements.measurement import Measurement, Progress
from vsfsim.bench.noise import NOISE_KINDS, Noise, noisy_nodes, noisy_pressure
from vsfsim.core.errors import DatasetError
from vsfsim.core.scene import parse_scene
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, Touch
from vsfsim.sensing.bubble_touch import aligned_nodes, rim_of
from vsfsim.sensing.dense_force import BubbleCalibration

DEEP = (0.0015, 0.0045, 0.0085)  # of the frames taken of a touch, the nearest ones [m]
CALIBRATING = 4  # touches of the train split
IMAGES = ("in time", "late", "aligned")
"""Images without a lag, with the lag of a real Punyo as they come, and with its lag taken out."""
_FELT = 0.05  # force from which a frame counts as contact [N], a third of a real sensor's noise


def measure(dataset: Dataset, *, noise: Sequence[float] = NOISE[:2],
            progress: Progress = lambda _: None) -> Measurement:
    """Calibrate on the first split of ``dataset``, score on the last one.

    Args:
        dataset: its readings; the truth is not opened.
        noise: standard deviations of a node's coordinate [m].
        progress: called with what is going on.

    Raises:
        DatasetError: no touch has a skin, the touches were made with different skins, or too few frames are in contact.
    """
    splits = list(dict.fromkeys(entry.split for entry in dataset.entries))
    views = {split: [dataset.blind().load(name) for name in dataset.names(split)] for split in (splits[0], splits[-1])}
    calibration = calibration_of(dataset, [view for split in views.values() for view in split])
    training, presses = (records(views[split]) for split in (splits[0], splits[-1]))
    notes = []
    if len(splits) == 1:
        training, presses = presses[:CALIBRATING], presses[CALIBRATING:]
        notes.append(f"The dataset has one split, '{splits[0]}': its first {len(training)} touches calibrate, the "
                     f"others are scored.")
    else:
        training = training[:: max(1, len(training) // CALIBRATING)][:CALIBRATING]
        notes.append(f"Calibrated on {len(training)} touches of split '{splits[0]}', scored on split '{splits[-1]}'.")
    if not training or not presses:
        raise DatasetError(f"dense force: {dataset.path} has {len(training)} touches to calibrate on and "
                           f"{len(presses)} to score with a converged frame in contact; both must be at least 1.")
    if _sensor_nodes(dataset) == len(calibration.rest):
        notes.append("The bubble was simulated on the read-out mesh itself: 'membrane' shares mesh and law with it.")
    field = contenders(calibration, training, progress=progress)
    rows = compare(field, presses, noise=noise, progress=progress)
    scored = [(view, number, touch) for view in views[splits[-1]] for number, touch in enumerate(view.touches)
              if len(chosen(touch))][-len(presses):]
    late = recipe(field, scored, presses, progress=progress)
    return report({"dataset": str(dataset.path), "noise": list(noise)}, rows, field, presses, notes, recipe=late)


def recipe(field: Sequence[Contender], touches: Sequence[tuple[ObjectView, int, Touch]], presses: Sequence[PressRecord],
           *, progress: Progress = lambda _: None) -> list[Row]:
    """Every contender on touches with all of a real sensor's noise, for each of `IMAGES`.

    Args:
        field: estimators.
        touches: views, numbers and touches of ``presses``, whose frames are those of `chosen`.
    """
    rows = []
    for images in IMAGES:
        noise = Noise(**{"offset_std": 0.0, "drift_std": 0.0, "tare_frames": 0, "seed": 0,  # type: ignore[arg-type]
                         **NOISE_KINDS["punyo"], **({"image_lag": 0.0} if images == "in time" else {})})
        measured = [_measured(view, number, touch, press, noise, align=images == "aligned")
                    for (view, number, touch), press in zip(touches, presses, strict=True)]
        for one in field:
            progress(f"{one.label}, images {images}")
            rows += errors_of(one, measured, presses, noise.depth_std, images=images)
    return rows


def _measured(view: ObjectView, number: int, touch: Touch, press: PressRecord, noise: Noise, *,
              align: bool) -> PressRecord:
    """What a real sensor shows in the frames of ``press``, in the mount frame."""
    assert touch.node_position is not None and touch.pressure is not None
    which = {"object_index": view.object_index, "view_index": view.view_index, "touch_index": number}
    world = noisy_nodes(touch.node_position, touch.mount_pose, touch.time, noise, **which)
    if align:
        world = aligned_nodes(world, touch.mount_pose, touch.time, noise.image_lag)
    pressure = noisy_pressure(touch.pressure, touch.time, touch.force, noise, **which)
    frames = chosen(touch)
    turn, shift = touch.mount_pose[frames, :3, :3], touch.mount_pose[frames, None, :3, 3]
    return replace(press, position=np.einsum("tni,tij->tnj", world[frames] - shift, turn), pressure=pressure[frames])


def records(views: Sequence[ObjectView]) -> list[PressRecord]:
    """Some frames of every touch that met its object, in the mount frame; see `DEEP`."""
    out = []
    for view in views:
        for number, touch in enumerate(view.touches):
            frames = chosen(touch)
            if not len(frames):
                continue
            turn, shift = touch.mount_pose[frames, :3, :3], touch.mount_pose[frames, None, :3, 3]
            assert touch.node_position is not None and touch.node_force is not None and touch.pressure is not None
            out.append(PressRecord(f"{view.name} {number}", depths(touch)[frames],
                                   np.einsum("tni,tij->tnj", touch.node_position[frames].astype(float) - shift, turn),
                                   touch.pressure[frames],
                                   np.einsum("tni,tij->tnj", touch.node_force[frames].astype(float), turn)))
    return out


def depths(touch: Touch) -> np.ndarray:
    """How far the mount has come since the first frame with a force, and that frame's own step before it (T,) [m]."""
    way = (touch.mount_pose[:, :3, 3] - touch.mount_pose[0, :3, 3]) @ touch.axis
    levels = np.unique(np.round(way, 9))
    # the readings on the way in are as far apart as the first one is past first contact
    step = levels[2] - levels[1] if len(levels) > 2 else 0.0
    return np.maximum(way - (levels[1] - step if len(levels) > 1 else 0.0), 0.0)


def chosen(touch: Touch) -> np.ndarray:
    """Frames of the way in that are taken of a touch, ascending."""
    if touch.node_position is None or touch.node_force is None or touch.pressure is None:
        return np.zeros(0, int)
    good = np.asarray(touch.converged, bool) & (np.linalg.norm(np.nan_to_num(touch.force), axis=1) > _FELT)
    depth = depths(touch)
    good[int(np.argmax(depth)) + 1:] = False
    usable = np.flatnonzero(good)
    return np.unique([usable[np.argmin(np.abs(depth[usable] - d))] for d in DEEP]) if len(usable) else usable


def calibration_of(dataset: Dataset, views: Sequence[ObjectView]) -> BubbleCalibration:
    """What a perfectly informed owner of the dataset's bubble knows.

    Raises:
        DatasetError: no touch has a skin, or the touches were made with different ones.
    """
    touches = [touch for view in views for touch in view.touches]
    first = next((touch for touch in touches if touch.node_rest is not None), None)
    sensor = parse_scene(dataset.recipe.scene_text,
                         dataset.path / "scene").sample(0).sensor if first is not None else None
    if (first is None or first.node_rest is None or first.node_triangles is None or first.rest_pressure is None
        or sensor is None):
        raise DatasetError(f"dense force: none of the {len(touches)} touches in {dataset.path} has a skin; the dataset "
                           f"must be made with a bubble, a [sensor] in the scene.")
    if any(touch.node_rest is None or not np.array_equal(touch.node_rest, first.node_rest)
           or touch.rest_pressure != first.rest_pressure for touch in touches):
        raise DatasetError(f"dense force: the touches in {dataset.path} were made with different bubbles; one "
                           f"calibration does not do. Give a scene whose [sensor] has no distribution.")
    return BubbleCalibration(first.node_rest, first.node_triangles, rim_of(first.node_triangles, len(first.node_rest)),
                             sensor.modulus, first.rest_pressure, reference=first.node_reference)


def _sensor_nodes(dataset: Dataset) -> int:
    sensor = parse_scene(dataset.recipe.scene_text, dataset.path / "scene").sample(0).sensor
    return 0 if sensor is None else sensor.nodes
