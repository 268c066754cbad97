"""A task whose support is chosen: a method with `choose` names its touches one after the other; others are given the
drawn ones."""

import json

import numpy as np
import pytest
import toy_methods

from vsfsim.baselines.choosing_touches import FarthestTouches, UncertainTouches
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.method import Action, Reading, checked_choice
from vsfsim.bench.protocol import divide, support
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import MethodError
from vsfsim.core.shape import parse_probe_shape


@pytest.fixture(scope="module")
def chosen(task_text):
    return parse_task(task_text.replace("shots = [0, 1, 5]", "support = 'chosen', shots = [0, 2]").replace(
        "ranking_shot = 5", "ranking_shot = 2"), "toy-v1.toml")


@pytest.fixture
def folder(tmp_path):
    """Makes a folder for the log of a toy."""
    def make(name):
        (tmp_path / name).mkdir()
        np.savez(tmp_path / name / "answers.npz")
        return tmp_path / name

    return make


def test_a_method_chooses_among_the_touches_that_are_left_and_is_given_these(chosen, toy_dataset, toy_views, folder):
    where = folder("choosy")
    evaluate("toy_methods:Choosy", chosen, toy_dataset, parameters={"folder": str(where)}, seeds=1, check=False)
    log = [json.loads(line) for line in (where / "log.jsonl").read_text().splitlines()]
    of = {view.name: [toy_methods.name_of(touch.mount_pose) for touch in view.touches] for view in toy_views}
    trials = iter(log)
    for view in toy_views[1:]:
        draw = divide(view, chosen.protocol)
        order = [of[view.name][k] for k in support(view, draw, "8", 0, chosen.protocol)]
        assert len(order) == len(draw.pool) == 8
        query = [of[view.name][k] for k in draw.query]
        assert [next(trials), next(trials)] == [[], query], "no touch at 0-shot"
        assert [next(trials), next(trials)] == [[], [0, *order]], "nothing made, and all of the pool offered"
        assert [next(trials), next(trials)] == [[order[7]], [1, *order[:7]]]
        assert [next(trials), next(trials)] == [[order[7], order[6]], query]
        assert [next(trials), next(trials)] == [[of[view.name][k] for k in draw.pool], query], "all of them"


def test_a_method_that_does_not_choose_is_given_the_drawn_touches(chosen, task, toy_dataset, folder):
    given = []
    for name, one in (("chosen", chosen), ("drawn", task)):
        where = folder(name)
        evaluate("toy_methods:Oracle", one, toy_dataset, parameters={"folder": str(where)}, seeds=1, check=False)
        given.append({tuple(json.loads(line)) for line in (where / "log.jsonl").read_text().splitlines()})
    pairs, fives = ({names for names in some if len(names) == size} for some, size in zip(given, (2, 5), strict=True))
    assert len(pairs) == 2 and pairs == {names[:2] for names in fives}


@pytest.mark.parametrize("answer", ["first", 8, -1, 0.5, True])
def test_a_choice_that_was_not_offered_is_refused(chosen, toy_dataset, answer):
    with pytest.raises(MethodError, match=r"choose returned .* one of the 8 offered touches, 0 to 7"):
        checked_choice(answer, 8)
    if answer == 8:
        with pytest.raises(MethodError, match="choose returned 8"):
            evaluate("toy_methods:Choosy", chosen, toy_dataset, parameters={"answer": 8}, check=False)
        with pytest.raises(MethodError, match="choose returned"):
            evaluate("toy_methods:Choosy", chosen, toy_dataset, parameters={"answer": 8})


def at(x):
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3], poses[:, 2, 3] = x, (0.01, 0.0, 0.005)  # it goes up again in the last frame
    return Action(np.arange(3.0), poses, np.array([0.0, 0.0, -1.0]), parse_probe_shape({"sphere": 0.01}, "test"),
                  "normal-force", 1)


def test_the_farthest_touch_is_chosen_and_so_is_the_least_certain():
    made = [Reading(at(x), np.zeros((3, 1)), np.ones(3, bool)) for x in (0.0, 0.1)]
    offered = [at(0.02), at(0.06), at(0.09), at(-0.03)]
    assert FarthestTouches().choose(None, made, offered) == 1
    assert FarthestTouches().choose(None, made[:1], offered) == 2
    assert FarthestTouches().choose(None, [], offered) == 0

    class Known(UncertainTouches):
        def predict_std(self, touches):
            return [np.array([[0.1], [0.1], [abs(touch.poses[0, 0, 3])]]) for touch in touches]

    assert Known().choose(None, made, offered) == 2
