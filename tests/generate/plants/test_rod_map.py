"""The ceiling `rod-map`: a plant's true skeleton with moduli fitted to touches."""

from __future__ import annotations

from types import SimpleNamespace as Of

import numpy as np
import pytest
from texts import changed

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants import rod_map
from vsfsim.generate.plants.rod_map import class_means, fitted, held, with_classes
from vsfsim.generate.plants.skeleton import displaced
from vsfsim.generate.plants.subject import outline
from vsfsim.generate.plants.touches import make_view
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.resim import named_job


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The recipe of two small plants of one kind, and the first of them, touched six times."""
    folder = tmp_path_factory.mktemp("plants")
    scene = folder / "small.toml"
    scene.write_text(changed(find_scene("plants-v5-mini").read_text(), plant='"orange-tree"', wood_segments=40,
                             leaf_segments=40, frames="{ free = 1, in = 8, hold = 0, out = 0 }", reject_below=0.0))
    recipe = make_recipe(load_scene(scene), objects=2, touches=6, seed=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield recipe, make_view(jobs_of(recipe, scene, folder)[0], device="cpu")


def asked(view):
    """Plans of the touches of a view, as a task asks for them, and readings of joint torques."""
    return [Of(q=t.planned_q, axis=t.axis) for t in view.touches], [
        Of(action=Of(q=t.q, axis=t.axis), value=np.asarray(t.torque), valid=t.converged) for t in view.touches]


def error(found, view):
    """RMSE of the torques over that of predicting zero."""
    true = np.concatenate([np.asarray(touch.torque) for touch in view.touches])
    told = np.concatenate([held(one, len(touch.time)) for one, touch in zip(found, view.touches, strict=True)])
    return float(np.sqrt(((told - true)**2).sum() / (true**2).sum()))


def test_the_true_plant_leaves_nothing_and_a_displaced_one_does(made):
    recipe, view = made
    plans, _ = asked(view)
    errors = [error(fitted(recipe, view.name, plans, moduli="true", jitter=jitter), view)
              for jitter in (0.0, 0.02)]
    assert errors[0] < 1e-6 and errors[1] > 0.02


def test_touches_correct_moduli_that_are_twice_as_high_in_other_plants(made, monkeypatch):
    recipe, view = made
    plans, readings = asked(view)
    monkeypatch.setattr(rod_map, "class_means", lambda of: {k: v + np.log(2.0) for k, v in class_means(of).items()})
    before, after = (error(fitted(recipe, view.name, plans, support=some), view) for some in ([], readings[:3]))
    assert after < 0.2 * before  # .07 of .87


def test_cores_change_with_their_segments_and_blades_stay_across_them(made):
    recipe, view = made
    plant = outline(named_job(recipe, view.name)).plant
    double = with_classes(plant, np.log(2.0 * np.array([plant.young_modulus[1:][plant.region[1:] == k].mean()
                                                        if (plant.region[1:] == k).any() else 1.0
                                                        for k in range(len(plant.region_names))])))
    share = double.young_modulus[1:] / plant.young_modulus[1:]
    np.testing.assert_allclose(double.yielding[1:], plant.yielding[1:] * share[:, None], rtol=1e-12)
    moved = displaced(plant, 0.005, np.random.default_rng(0))
    assert np.sqrt(((moved.nodes - plant.nodes)**2).sum(axis=1).mean()) == pytest.approx(0.005)
    assert displaced(plant, 0.0, np.random.default_rng(0)) is plant


def test_what_it_cannot_do_is_refused(made, loaded):
    recipe, view = made
    with pytest.raises(SceneError, match="rod-map bends plants"):
        fitted(make_recipe(loaded("sprung")), "sprung-0000-v0", [])
    with pytest.raises(SceneError, match="moduli"):
        fitted(recipe, view.name, [], moduli="known")
