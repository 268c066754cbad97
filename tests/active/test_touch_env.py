"""The environment of active touch: Gymnasium's own checker, and rewards that add up."""

import numpy as np
import pytest
from mock_dataset import write
from pages import ROOT, blocks

from vsfsim.bench.check import MOCK_TASK
from vsfsim.bench.mock import mock_view
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import TaskError

gymnasium = pytest.importorskip("gymnasium")


class Zero:
    """Predicts zero, and knows least of the touches at the highest x."""

    def meta_fit(self, specimens):
        self.names = {s.name for s in specimens}

    def adapt(self, view, support):
        pass

    def predict(self, touches):
        return [np.zeros((len(a.time), 1)) for a in touches]

    def predict_std(self, touches):
        return [np.full((len(a.time), 1), 1.0 + a.poses[0, 0, 3]) for a in touches]


@pytest.fixture(scope="module")
def env(tmp_path_factory):
    """Of a mock task with four training and two test objects, each with 16 touches."""
    task = parse_task(MOCK_TASK.replace("objects = 3", "objects = 6").replace("touches = 8", "touches = 16"), "mock")
    views = [mock_view(i, split="train" if i < 4 else "test", touches=16, stiffness=4.0 ** (i % 2)) for i in range(6)]
    folder = tmp_path_factory.mktemp("active") / "toy"
    write(folder, views)

    import vsfsim.active  # noqa: F401  registers it

    plain = gymnasium.make

    def make(**given):
        return plain("vsfsim/Touch-v0", task=task, dataset=folder, **given)

    return make


def test_gymnasium_finds_it_and_its_checker_accepts_it(env):
    from gymnasium.utils.env_checker import check_env

    check_env(env(touches=3).unwrapped, skip_render_check=True)


def test_rewards_add_up_to_the_fall_of_the_error_and_a_touch_is_made_once(env):
    made = env(objects="test", touches=4)
    observation, info = made.reset(seed=3)
    start, total = info["error"], 0.0
    assert not observation["readings"].any() and not observation["made"].any()
    for action in (2, 2, 5, 7):
        observation, reward, ended, _, after = made.step(np.int64(action))
        total += reward
    assert ended and total == pytest.approx(start - after["error"]) and after["error"] < 0.9 * start
    for mask in (observation["made"], 1 - after["action_mask"]):
        assert np.flatnonzero(mask).tolist() == [2, 5, 7]
    assert np.flatnonzero(np.abs(observation["readings"]).any(axis=(1, 2))).tolist() == [2, 5, 7]
    assert observation["places"][2, 5] == -1.0, "the mock is pressed from above"


def test_the_objects_of_the_episodes_teach_the_estimator_nothing(env):
    for objects, many in (("train", 2), ("test", 4)):
        one = env(method=Zero(), objects=objects).unwrapped
        _, info = one.reset(seed=0)
        assert info["error"] == pytest.approx(1.0) and len(one.method.names) == many
        assert not one.method.names & {o.specimen.name for o in one._objects}


def test_the_example_of_the_page_makes_the_least_certain_touches_first(env, monkeypatch, capsys):
    (code,) = [b for b in blocks((ROOT / "docs" / "howto.md").read_text(), "py") if "gymnasium.make" in b]
    made = env(method=Zero(), touches=2, objects="test")
    monkeypatch.setattr(gymnasium, "make", lambda name, **given: made)
    exec(code, {})
    order = [int(line.split()[1][:-1]) for line in capsys.readouterr().out.splitlines()]
    x = made.reset(seed=0)[0]["places"][:, 0]
    assert order == np.argsort(-x)[:2].tolist()


@pytest.mark.parametrize(("given", "message"),
                         [({"objects": "all"}, "objects is 'all'"), ({"touches": 0}, "touches 0"),
                          ({"fold": 1}, "fold is 1"),])
def test_wrong_arguments_are_refused(env, given, message):
    with pytest.raises(TaskError, match=message):
        env(**given)
