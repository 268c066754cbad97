"""The ceiling `fem-map`: the true mesh with moduli fitted to the support."""

import dataclasses

import numpy as np
import pytest
from texts import text

from vsfsim.bench import leaderboard
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import SceneError
from vsfsim.generate.fem_map import fitted
from vsfsim.generate.run import generate

TRIED = parse_task(text("sprung-v1"), "sprung-v1.toml")
@pytest.fixture(scope="module")
def made(generated):
    """Three objects at the tier linear."""
    return generated("sprung")


@pytest.mark.slow
def test_a_touch_tells_the_modulus(loaded, tmp_path):
    coarse = ('"linear"', '"fem-coarse"'), ("sprung", "sprung-coarse")
    data = generate(loaded("sprung", coarse[0], ('"sprung"', '"sprung-coarse"')), tmp_path / "data", workers=1)
    asked = parse_task(text("sprung-v1", *coarse), "sprung-coarse-v1.toml")
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
