"""Choosing the settings of the fields on objects that a task does not ask."""

import numpy as np
import pytest

from measurements.choices.field_settings import FEW, VARIANTS, measure
from vsfsim.baselines.field_vsf import GridVsf
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.bench.task import load_task
from vsfsim.core.errors import MethodError
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

GRID = "grid-vsf, pressure"


def made(folder, task, seed, touches=12):
    views = [mock_view(i, touches=touches) for i in range(2)]
    recipe = Recipe(scene=task.dataset.scene, scene_text="mock", seed=seed, objects=2, views=1, touches=touches,
                    splits={"test": 2}, device="cpu", tier="vsf", precision="float64", renderer="warp")
    with DatasetWriter(folder, recipe, [v.name for v in views]) as writer:
        for view in views:
            writer.add(view)
        return writer.finish()


@pytest.mark.slow
def test_each_object_is_fitted_to_some_touches_and_asked_about_others(tmp_path, monkeypatch):
    task = load_task("fewshot-shoes-v3-mini-v1")
    dataset = made(tmp_path / "other", task, seed=task.dataset.seed + 1)
    fitted = []
    adapt = GridVsf.adapt
    monkeypatch.setattr(GridVsf, "adapt", lambda self, view, support: (fitted.append(len(support)),
                                                                       adapt(self, view, support))[1])
    found = measure(task, dataset, variants=(GRID,), query=4, trainings=1)
    assert fitted == [FEW, 8, FEW, 8]
    row = found.record()["settings"][0]
    assert row["few"]["mean"] == pytest.approx(np.mean(list(row["few"]["of_each_view"].values())))
    # by hand, the second object after all its other touches
    view = dataset.load(dataset.names()[1])
    touches = record(view, task)
    order = np.random.default_rng(0).permutation(12)
    method = GridVsf(skin=False, iterations=500, batch=4000, samples=8, rate=0.3, cell=0.008)
    method.adapt(view.view, [touches.readings[i] for i in order[4:]])
    # as the leaderboard has it: the mean over touches of their root mean squares, over that of predicting zero
    errors = [(method.predict([touches.queries[i].action])[0] - touches.clean[i])[touches.queries[i].scored]
              for i in order[:4]]
    clean = [touches.clean[i][touches.queries[i].scored] for i in order[:4]]
    by_hand = sum(np.sqrt((e**2).mean()) for e in errors) / sum(np.sqrt((c**2).mean()) for c in clean)
    assert row["all"]["of_each_view"][view.name] == pytest.approx(by_hand)
    assert GRID in found.text()


def test_a_tasks_own_objects_are_refused(tmp_path):
    task = load_task("fewshot-shoes-v3-mini-v1")
    with pytest.raises(MethodError, match=r"on which no setting may be chosen\. Make others: `vsfsim generate"):
        measure(task, made(tmp_path / "own", task, seed=task.dataset.seed), variants=(GRID,))
    few = made(tmp_path / "few", task, seed=task.dataset.seed + 1, touches=6)
    with pytest.raises(MethodError, match="has 6 touches; 8 to predict and 5 to fit need 13"):
        measure(task, few, variants=tuple(VARIANTS)[:1])
