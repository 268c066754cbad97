"""Plants that a dataset refuses and draws again, and that it says so."""

from __future__ import annotations

import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
from texts import changed

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.streams import Stream
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants import aim
from vsfsim.generate.plants import subject as admit
from vsfsim.generate.recipe import make_recipe


@pytest.fixture
def job(tmp_path):
    path = find_scene("plants-v5-mini")
    loaded = parse_scene(changed(path.read_text(), wood_segments=30, leaf_segments=30, plant='"boxwood"'), path)
    recipe = make_recipe(loaded, seed=3, objects=1, views=2, touches=1)
    return jobs_of(recipe, loaded.path, tmp_path)[1]


def with_limit(scene, limit):
    return dataclasses.replace(scene, arm=dataclasses.replace(scene.arm, reject_below=limit))


def test_the_first_plant_is_taken_where_nothing_is_asked_and_the_third_where_two_are_refused(job, monkeypatch):
    """The second can be touched along a branch in view 0 and not in view 1."""
    scene = job.scene()
    first = admit.admitted(job, with_limit(scene, 0.0))
    assert len(first.notes) == 1 and first.notes[0].startswith("boxwood")
    refused = Mock(side_effect=["too soft", None, None])
    aimed = Mock(side_effect=[[], aim.NothingReached("", "no branch"), [], []])
    monkeypatch.setattr(admit, "refusal", refused)
    monkeypatch.setattr(admit, "aim_arm", aimed)
    taken = admit.admitted(job, with_limit(scene, 2.0))
    seen = [call.args[0] for call in refused.call_args_list]
    assert np.array_equal(seen[0].nodes, first.nodes) and aimed.call_count == 4
    assert not np.array_equal(taken.young_modulus, first.young_modulus)
    assert taken.notes == (*seen[2].notes, "Draw 1 of boxwood was refused: too soft.",
                           "Draw 2 of boxwood was refused: view 1: no branch.")
    # the other view of the object gets the same plant, without asking again
    assert admit.admitted(dataclasses.replace(job, view_index=0), with_limit(scene, 2.0)) is taken
    assert refused.call_count == 3


def test_a_scene_none_of_whose_plants_can_be_used_is_refused_with_the_reason(job, monkeypatch):
    monkeypatch.setattr(admit, "refusal", lambda *_: "the arm reaches 0 of 4 points")
    with pytest.raises(SceneError, match=r"none of 12 plants drawn for object 0.*reaches 0 of 4 points.*reject_below"):
        admit.admitted(job, with_limit(job.scene(), 3.0))


def test_pilot_touches_tell_a_stiff_plant_from_a_soft_one_and_a_far_one(job, monkeypatch):
    monkeypatch.setattr(aim, "DRAWS", 6)
    monkeypatch.setattr(admit, "PILOTS", 2)
    scene = job.scene()
    plant = admit.grow(scene, job.stream(Stream.BODY), number=0)
    arm, seed = admit.load(scene.arm), np.random.SeedSequence(0)
    assert admit.refusal(plant, with_limit(scene, 0.05), arm, 1, seed) is None
    soft = dataclasses.replace(plant, young_modulus=1e-4 * plant.young_modulus, yielding=None)
    assert "below reject_below = 0.05 N m" in admit.refusal(soft, with_limit(scene, 0.05), arm, 1, seed)
    far = dataclasses.replace(plant, nodes=plant.nodes + [3.0, 0.0, 0.0])
    assert "none of 6 targets can be reached" in admit.refusal(far, with_limit(scene, 0.05), arm, 1, seed)
