"""The ceiling `resim`: the true object asked again, its row, and scores as a share of what is possible."""

import dataclasses
import json

import numpy as np
import pytest
from texts import changed, text

from vsfsim.bench import leaderboard
from vsfsim.bench.board.compare import interval
from vsfsim.bench.board.rows import CLAIMED, is_ceiling
from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import record
from vsfsim.bench.task import parse_task
from vsfsim.bench.trials.answers import load, save
from vsfsim.core.errors import SceneError
from vsfsim.generate.resim import again


@pytest.fixture(scope="module")
def made(generated):
    return generated("sprung")


@pytest.fixture(scope="module")
def task():
    return parse_task(text("sprung-v1"), "sprung-v1.toml")


@pytest.fixture(scope="module")
def board(made, task, tmp_path_factory):
    """Of near-springs and the ceiling, whose files are in a folder."""
    folder = tmp_path_factory.mktemp("board")
    evaluate("near-springs", task, made, out=folder / "springs.json", sandbox="process")
    evaluate("resim", task, made, out=folder / "resim.json")
    return leaderboard.collect(task, [folder]), folder


def test_a_plan_made_again_is_the_touch(made, task):
    view = made.load(made.entries[1].name)
    plans = [query.action for query in record(view, task).queries]
    short = dataclasses.replace(plans[0], poses=plans[0].poses[:3], time=plans[0].time[:3])
    found = again(made.recipe, view.name, [plans[3], short, plans[1]])
    for touch, known in zip(found, (view.touches[3], view.touches[0], view.touches[1])):
        frames = len(touch.force)
        # what is solved together decides the steps of the way in: 5e-5 on these
        np.testing.assert_allclose(touch.force, known.force[:frames], rtol=2e-4, atol=1e-7)
        assert touch.mount_stiffness == 500.0 and touch.converged.all()
    assert [len(touch.force) for touch in found] == [4, 3, 4]


def test_the_ceiling_errs_by_nothing_and_is_not_ranked(board):
    found, _ = board
    springs, ceiling = found.rows
    assert springs.rank == 1 and ceiling.rank is None and ceiling.mark == leaderboard.CEILING
    assert all(score.mean < 1e-4 for score in ceiling.scores["rmse_ratio"].values())
    assert set(ceiling.values["1"]) == set(springs.values["1"])


def test_scores_are_a_share_of_the_possible(board):
    found, _ = board
    springs = interval(found.rows[0].values["area"]).mean
    rows = leaderboard.table(found)["rows"]
    assert [row["share_of_possible"] for row in rows] == pytest.approx([1.0 - springs, 1.0], abs=1e-4)
    head, first, second = (leaderboard.text(found).splitlines()[k] for k in (2, 4, 5))
    assert "gap closed" in head and f"{1.0 - springs:.2f}" in first and "1.00" in second and "resim *" in second
    # a ceiling that errs itself: (1 - e) / (1 - c)
    assert leaderboard.share_of_possible(found.rows[0], 0.5) == pytest.approx((1.0 - springs) / 0.5)
    assert leaderboard.possible(found) == pytest.approx(0.0, abs=1e-4)
    assert leaderboard.possible(dataclasses.replace(found, rows=found.rows[:1])) is None
    assert all(f">{cell}</" in leaderboard.page([found]) for cell in ("gap closed", f"{1.0 - springs:.2f}", "1.00"))


def test_the_command_finds_the_data_by_the_environment(made, tmp_path, monkeypatch, vsfsim):
    (tmp_path / "sprung-v1.toml").write_text(text("sprung-v1"))
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "sprung").symlink_to(made.path)
    monkeypatch.setenv("VSFSIM_DATASETS", str(tmp_path / "data"))
    said = vsfsim("evaluate", "--method", "resim", "--task", "sprung-v1.toml", cwd=tmp_path)
    assert said.returncode == 0, said.stderr
    assert "rmse_ratio" in said.stdout and "  0.000" in said.stdout
    assert "\npredict " in said.stdout and "meta-fit" not in said.stdout


def test_another_tier_and_a_name_alone_are_no_ceiling_of_the_data(board, made, task, tmp_path):
    _, folder = board
    evaluate("resim", task, made, parameters={"tier": "fem-coarse"}, out=tmp_path / "finer.json")
    (row,) = leaderboard.collect(task, [tmp_path / "finer.json"]).rows
    assert row.mark == leaderboard.CEILING and 1e-4 < row.scores["rmse_ratio"]["1"].mean < 0.5
    assert leaderboard.possible(leaderboard.collect(task, [tmp_path / "finer.json"])) is None
    table = json.loads((folder / "resim.json").read_text())
    (tmp_path / "claimed.json").write_text(json.dumps({**table, "entry": "predictions file"}))
    (row,) = leaderboard.collect(task, [tmp_path / "claimed.json"]).rows
    assert row.mark == CLAIMED and not is_ceiling(row.result)


def test_a_tier_below_the_scenes_needs_can_be_asked(made, task):
    recipe = dataclasses.replace(made.recipe, tier="fem-coarse", scene_text=made.recipe.scene_text.replace(
        'needs = ["normal-force"]', 'needs = ["bulging"]').replace('tier = "linear"\n', ""))
    view = made.load(made.entries[0].name)
    plan = record(view, task).queries[0].action
    (touch,) = again(recipe, view.name, [plan], tier="linear")
    np.testing.assert_allclose(touch.force, view.touches[0].force, rtol=2e-4, atol=1e-7)


def test_what_cannot_be_asked_again_is_refused(made):
    probe = "[probe]\nshape = { sphere = 0.01 }\nmount_stiffness = 500.0"
    arm = changed(made.recipe.scene_text, (probe, '[arm]\nmodel = "gen3"'))
    with pytest.raises(SceneError, match="its effector takes no paths"):
        again(dataclasses.replace(made.recipe, scene_text=arm), made.entries[0].name, [])


def test_a_stopped_ceiling_goes_on_where_it_was(made, task, tmp_path):
    out = tmp_path / "resim.json"
    asked = []

    def stop(done, of, name):
        asked.append(name)
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate("resim", task, made, out=out, progress=stop)
    kept = {path: path.read_bytes() for path in (tmp_path / "resim.part").iterdir()}
    assert len(kept) == 2 and not out.exists()
    for path in kept:  # an answer that is taken up, and not made again
        save(path, (0, [0.0 * reading for reading in load(path, tuple[int, list[np.ndarray]])[1]]))
    evaluate("resim", task, made, out=out)
    (row,) = leaderboard.collect(task, [out]).rows
    error = sorted(np.mean(one) for one in row.values["1"].values())
    assert error[0] < 1e-3 and error[1:] == pytest.approx([1.0, 1.0]) and not (tmp_path / "resim.part").exists()
