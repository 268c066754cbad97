"""The ceiling `fem-map`: the true mesh with moduli fitted to the support."""

import dataclasses

import numpy as np
import pytest

from tests.generate.test_resim import SCENE, TASK
from vsfsim.bench import leaderboard
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene
from vsfsim.generate.fem_map import fitted
from vsfsim.generate.run import generate

TRIED = parse_task(TASK, "sprung-v1.toml")
COARSE = [text.replace('"linear"', '"fem-coarse"').replace("sprung", "sprung-coarse") for text in (SCENE, TASK)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Three objects at the tier linear."""
    folder = tmp_path_factory.mktemp("sprung")
    (folder / "sprung.toml").write_text(SCENE)
    return generate(load_scene(folder / "sprung.toml"), folder / "data", workers=1)


@pytest.mark.slow
def test_a_touch_tells_the_modulus(tmp_path):
    (tmp_path / "sprung-coarse.toml").write_text(COARSE[0])
    data = generate(load_scene(tmp_path / "sprung-coarse.toml"), tmp_path / "data", workers=1)
    asked = parse_task(COARSE[1], "sprung-coarse-v1.toml")
    result = evaluate("fem-map", asked, data, out=tmp_path / "fem-map.json")
    (row,) = leaderboard.collect(asked, [tmp_path / "fem-map.json"]).rows
    error = {shot: score.mean for shot, score in row.scores["rmse_ratio"].items()}
    # the sensor's noise is a tenth of these forces
    assert max(error["1"], error["all"]) < min(0.2, error["0"]) and row.mark == leaderboard.CEILING
    assert result.parameters == {"tier": "", "device": "cpu", "field": "parts"}


def test_a_fit_to_one_touch_predicts_another(made):
    recording, view = record(made.load(made.entries[1].name), TRIED), made.load(made.entries[1].name)
    known = dataclasses.replace(recording.readings[0], value=recording.clean[0])
    true = view.touches[3].normal_force()
    for field in ("parts", "smooth"):
        (touch,) = fitted(made.recipe, view.name, [recording.queries[3].action], support=[known],
                          tier="fem-coarse", field=field)
        # the data are of the tier linear
        assert np.abs(touch.normal_force() - true).max() < 0.1 * true.max()


def test_what_it_cannot_fit_is_refused(made):
    name = made.entries[0].name
    with pytest.raises(SceneError, match="needs a tier of large strain"):
        fitted(made.recipe, name, [])
    rubs = made.recipe.scene_text.replace("young_modulus", "friction = 0.3\nyoung_modulus")
    with pytest.raises(SceneError, match=r"friction = 0\.3"):
        fitted(dataclasses.replace(made.recipe, scene_text=rubs), name, [])
