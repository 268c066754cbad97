"""Masks and poses of hidden inclusions: the ruler scores an oracle perfectly and knows an empty answer."""

import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
import texts

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.inclusions import Columns, Inclusions, mesh_of, reached_in
from vsfsim.bench.leaderboard import collect, text
from vsfsim.bench.method import Estimate
from vsfsim.bench.metrics import Answer, record_scores
from vsfsim.bench.mock import BLOCK, mock_view
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import MethodError, TaskError
from vsfsim.core.material import Inclusion


@pytest.fixture(scope="module")
def dataset(write_dataset):
    views = [mock_view(i, split="train" if i < 1 else "test", touches=12) for i in range(3)]
    return write_dataset(views, scene_text=texts.text("hidden"), seed=3)


def of(task_text, primary):
    text = task_text.replace("seed = 0, objects", "seed = 3, objects").replace("[0, 1, 5]", "[0, 5]")
    return parse_task(text.replace('primary = "rmse"', f'primary = "{primary}"'), "toy-v1.toml")


class Answers:
    """Knows where the inclusions are, from the file ``known``; ``blur`` makes it wrong."""

    def __init__(self, *, blur=0.0, known=""):
        self.blur = blur
        self.known, self.pose = pickle.loads(Path(known).read_bytes()) if known else ([], np.eye(4))

    def meta_fit(self, specimens):
        pass

    def adapt(self, view, support):
        for reading in support:
            if not np.isfinite(reading.value[reading.valid]).all():
                raise ValueError("a reading is not finite")

    def predict(self, touches):
        return [np.zeros((len(t.time), 1)) for t in touches]

    def stiffness(self, points):
        return Estimate(np.max([h.inside(points) for h in self.known], axis=0) * 1.0 + 1.0
                        if self.known and not self.blur else np.ones(len(points)), np.zeros(len(points)))

    def locate(self, vertices, triangles):
        assert len(vertices) > 20 and triangles.max() == len(vertices) - 1
        return self.pose if not self.blur else self.pose @ np.diag([-1.0, -1.0, 1.0, 1.0])


def pose_scores(estimate, truth):
    return record_scores(Answer.POSE, [{"estimate": estimate, "truth": truth}])


def test_the_mask_is_that_of_the_scene_drawn_again(dataset):
    view = dataset.load(dataset.names("test")[0])
    found = Inclusions.of(dataset.recipe, view)
    angle = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(0, 1))).uniform(-3.0, 3.0)
    np.testing.assert_allclose(found.rotation[0], [np.cos(angle), -np.sin(angle), 0.0])
    assert found.inside(np.array([[0.01, 0.0, 0.022], [0.01, 0.0, 0.010]])).tolist() == [True, False]
    columns = Columns.of(view.truth.probe_points, view)
    stiff = columns.covers(found)
    share = stiff.mean()
    assert 0.02 < share < 0.9 and (columns.points[:, 2] <= BLOCK[2]).all()
    right, flat = (record_scores(Answer.MASK, [{"value": columns.largest(given), "stiff": stiff}])
                   for given in (stiff[columns.pixel].astype(float), np.ones(len(columns.points))))
    assert right == {"mask_f1": 1.0, "mask_recall": 1.0}
    assert flat["mask_recall"] == 1.0 and flat["mask_f1"] == pytest.approx(2 * share / (1 + share))


def test_a_mask_is_scored_ranked_and_shown(dataset, task_text, tmp_path):
    task = of(task_text, "mask_f1")
    assert task.metric.answer is Answer.MASK and task.metric.higher_is_better
    inclusions = [Inclusions.of(dataset.recipe, dataset.load(name)) for name in dataset.names("test")[:1]]
    (tmp_path / "known").write_bytes(pickle.dumps((inclusions, np.eye(4))))
    (tmp_path / "results").mkdir()
    paths = []
    for blur in (0.0, 1.0):
        result = evaluate(f"{__name__}:Answers", task, dataset, seeds=3, check=False,
                          parameters={"blur": blur, "known": str(tmp_path / "known")})
        paths.append(tmp_path / "results" / f"{blur}.json")
        result.save(paths[-1])
        assert "mask_f1" in result.table("mask_f1")[1][0][0]
    board = collect(task, paths)
    assert [(row.rank, row.result.parameters["blur"]) for row in board.rows] == [
        (1, 0.0), (1, 1.0)]  # two objects: a tie
    assert "mask_f1 from normal-force [-]" in text(board) and "higher is better" in text(board)


def test_a_pose_is_scored(dataset, task_text, tmp_path):
    task = of(task_text, "rotation_error")
    views = [dataset.load(name) for name in dataset.names("test")]
    first, second = (Inclusions.of(dataset.recipe, view).known_object()[2] for view in views)
    known = tmp_path / "known"
    known.write_bytes(pickle.dumps(([], first)))
    right, wrong = (evaluate(f"{__name__}:Answers", task, dataset, parameters={"blur": blur, "known": str(known)},
                             seeds=1, check=False).scores for blur in (0.0, 1.0))
    between = pose_scores(first, second)
    assert right["rotation_error"]["all"].mean == pytest.approx(between["rotation_error"] / 2)
    assert right["translation_error"]["all"].mean == pytest.approx(between["translation_error"] / 2)
    assert wrong["rotation_error"]["all"].mean == pytest.approx((180.0 + abs(180.0 - between["rotation_error"])) / 2)
    with pytest.raises(MethodError, match="must be a rigid"):
        evaluate(f"{__name__}:Crooked", task, dataset, seeds=1, check=False)
    assert "rotation_error" not in evaluate("toy_methods:Constant", task, dataset,
                                            parameters={"value": 1.0}, seeds=1, check=False).scores


class Crooked(Answers):
    def locate(self, vertices, triangles):
        return 2.0 * np.eye(4)


def test_pose_errors_by_hand():
    turned = np.eye(4)
    turned[:3, :3], turned[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.003, 0.004, 0.0]
    assert pose_scores(np.eye(4), turned) == {"translation_error": pytest.approx(5.0),
                                              "rotation_error": pytest.approx(90.0)}


@pytest.mark.parametrize("kind, numbers, volume", [
    ("sphere", (0.0, 0.1, 0.0, 0.01), 4 / 3 * np.pi * 1e-6), ("box", (0.0, 0.0, 0.0, 0.01, -0.02, 0.03), 6e-6),
    ("capsule", (0.0, 0.0, 0.0, 0.03, 0.0, 0.04, 0.01), np.pi * 1e-4 * 0.05 + 4 / 3 * np.pi * 1e-6)])
def test_meshes_of_the_parts_are_closed_and_wound_outwards(kind, numbers, volume):
    vertices, triangles = mesh_of(Inclusion(kind, numbers, 1e6))
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    np.testing.assert_allclose(np.cross(b - a, c - a).sum(axis=0), 0.0, atol=1e-12)
    # Inscribed in the round parts: a 12-gon has 95 % of its circle's area.
    assert 0.88 * volume < np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 <= volume * (1 + 1e-9)
    edges = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    assert {tuple(e) for e in edges.tolist()} == {(b, a) for a, b in edges.tolist()}


def test_a_scene_without_inclusions_is_refused(dataset):
    plain = dataclasses.replace(dataset.recipe, scene_text=texts.text("block"))
    with pytest.raises(TaskError, match="no inclusions"):
        Inclusions.of(plain, dataset.load(dataset.names("test")[0]))


def sprung(view, stiffness):
    """The same touches, led by a spring of this stiffness [N/m] to where a rigid mount brought them."""
    def led(touch):
        give = (touch.normal_force() / stiffness)[:, None, None] * np.outer(np.r_[touch.axis, 0.0], np.eye(4)[3])
        return dataclasses.replace(touch, mount_stiffness=stiffness, mount_pose=touch.mount_pose + give)
    return dataclasses.replace(view, touches=tuple(map(led, view.touches)))


def test_what_was_touched_is_where_the_probe_was_and_not_its_mount():
    """A soft spring's mount goes past the body; points, columns of a mask, and frames without a force."""
    view = mock_view(0, split="test", touches=12)
    soft = sprung(view, 50.0)
    places = view.truth.probe_points
    mounts = [dataclasses.replace(t, mount_stiffness=None) for t in soft.touches]
    assert reached_in(dataclasses.replace(soft, touches=mounts), places).sum() > reached_in(view, places).sum()
    assert np.array_equal(reached_in(soft, places), reached_in(view, places))
    assert np.array_equal(Columns.of(places, soft).every, Columns.of(places, view).every)
    unknown = dataclasses.replace(soft, touches=tuple(
        dataclasses.replace(t, force=np.full_like(t.force, np.nan)) for t in soft.touches))
    assert not reached_in(unknown, places).any() and reached_in(view, places).any()
