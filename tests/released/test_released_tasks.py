"""Every released task, against what ships for it: one object view of its dataset is made again, and a row of its
leaderboard is scored again on that view."""

import dataclasses
import functools
import math
from pathlib import Path

import numpy as np
import pytest
from frame_checks import some_slow

from vsfsim.bench.admission.admit import differences
from vsfsim.bench.admission.fingerprint import make_record, shipped_record
from vsfsim.bench.board.compare import by_object
from vsfsim.bench.evaluate import data_of, evaluate
from vsfsim.bench.protocol import divide, record
from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task
from vsfsim.bench.trials.score import readings_of
from vsfsim.core import shelf
from vsfsim.core.scene import load_scene
from vsfsim.data.formats.archive import archive_name
from vsfsim.data.writer import DatasetWriter
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe

METHODS = ("point-vsf", "contact-points")
"""Whose row is scored again, the first of them that ships: they learn nothing from training objects, so one test object
is all that they need."""

TOLERANCE = 1e-3
"""Relative to the readings. Rounding of another machine alone changes them by 1e-8 (leaderboard.SAME_READINGS)."""

SLOW = {"inclusion-mini-v3", "localization-mini-v3"}
"""Tasks without cross-validation whose view takes more than ten seconds of a core with all of its touches."""

CURRENT = list(shelf.tasks())


@functools.cache
def shipped_row(name, *, of=METHODS):
    """The result of the first of some methods that ships for a task, of any if ``of`` is empty; None if none does."""
    found = map(Result.load, sorted((shelf.folder("leaderboard") / name).glob("*.json")))
    rows = [row for row in found if row.method not in shelf.ceilings()]
    return next((row for method in of or [None] for row in rows if method in (None, row.method)), None)


RELEASED = [name for name in CURRENT if shipped_row(name)]


def view_made_again(task, name, touches):
    """The object view ``name`` of the task's dataset with its first ``touches`` touches, and the recipe."""
    wanted = task.dataset
    path = shelf.find_scene(wanted.scene)
    recipe = make_recipe(load_scene(path), seed=wanted.seed, objects=wanted.objects,
                         views=wanted.views, touches=touches, tier=wanted.tier)
    (job,) = (job for job in jobs_of(recipe, path, Path()) if job.name == name)
    return effector_of(job.scene()).make_view(job, device="cpu"), recipe


@pytest.fixture(scope="module", params=some_slow(RELEASED, *SLOW, *(
    name for name in RELEASED if load_task(name).protocol.folds)))
def released(request, tmp_path_factory):
    """A released task, the shipped row, and a dataset of the row's first test object alone, made again."""
    task = load_task(request.param)
    shipped = shipped_row(task.name)
    view, recipe = view_made_again(task, shipped.readings["object"][0], task.dataset.touches)
    with DatasetWriter(tmp_path_factory.mktemp("released") / "data", recipe, [view.name]) as writer:
        writer.add(view)
        return task, shipped, writer.finish()


@pytest.mark.parametrize("name", [pytest.param(name, marks=() if name.startswith("fewshot-shoes-v3-mini") else
                                               pytest.mark.slow) for name in CURRENT if shipped_row(name, of=())])
def test_the_earliest_query_touch_is_made_again(name, tmp_path, monkeypatch):
    """The short form for views that take longer, and for the archive that ships. When this was written the relative
    difference was 8e-7 on shoes and 2e-13 on the linear slabs."""
    task = load_task(name)
    readings = shipped_row(name, of=()).readings
    touch, view_name, n, ss = min(zip(*(readings[key] for key in ("touch", "object", "n", "ss")), strict=True))
    view, _ = view_made_again(task, view_name, touch + 1)
    if (shelf.folder("tasks") / "archives" / archive_name(task.dataset)).is_file():
        monkeypatch.setenv("VSFSIM_DATASETS", str(tmp_path))
        archived = data_of(task)
        assert not differences(make_record(task, archived), shipped_record(task))
        one, other = (which.touches[0].force for which in (view, archived[view_name]))
        assert np.abs(one - other).max() < TOLERANCE * np.abs(one).max()
    ((_, _, found_n, found_ss),) = zip(*readings_of(record(view, task), [touch]).values(), strict=True)
    print(f"{name}: {view_name}, touch {touch}: {math.sqrt(found_ss / ss) - 1.0:.1e} of the shipped reading's norm")
    assert found_n == n and math.sqrt(found_ss) == pytest.approx(math.sqrt(ss), rel=TOLERANCE)


def test_the_dataset_is_made_again(released):
    task, shipped, dataset = released
    view = dataset.load(shipped.readings["object"][0])
    found = readings_of(record(view, task), divide(view, task.protocol).query)
    rows = [row for row in zip(*shipped.readings.values(), strict=True) if row[0] == view.name]
    assert len(rows) == task.protocol.query
    for (name, touch, n, ss), (_, stored_touch, stored_n, stored_ss) in zip(
            zip(*found.values(), strict=True), rows, strict=True):
        assert (touch, n) == (stored_touch, stored_n)
        assert math.sqrt(ss) == pytest.approx(math.sqrt(stored_ss), rel=TOLERANCE), (name, touch)


def test_a_shipped_row_is_scored_again(released):
    task, shipped, dataset = released
    split = next(iter(dataset.entries)).split
    protocol = dataclasses.replace(task.protocol, folds=0, draws=0, trainings=0, seeds=1,
                                   train=split, test=split)  # the method learns nothing
    alone = dataclasses.replace(task, protocol=protocol)
    again = evaluate(shipped.method, alone, dataset, parameters=shipped.parameters, seeds=1)
    readings = zip(*(again.readings[key] for key in ("n", "ss")), strict=True)
    norm = max(math.sqrt(ss / n) for n, ss in readings)
    for shot in ("0", "all"):  # between them a row holds the mean over several draws of the support
        for name, found in by_object(again, "rmse", shot).items():
            assert found == pytest.approx(shipped.values["rmse"][shot][name], abs=TOLERANCE * norm), (name, shot)
