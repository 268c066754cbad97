"""`import vsfsim`: six functions, imported at their first use, which do what the commands do."""

import dataclasses
import inspect
import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from mock_dataset import TASK, written
from texts import text

import vsfsim as api
from vsfsim.core.errors import DatasetError, MethodError
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.dataset import Dataset

FILES = {"json", "plot", "picture", "gif", "save", "every"}
@pytest.fixture(scope="module")
def toy(tmp_path_factory):
    """The folder of a dataset of three mock objects, the first for training."""
    return written(tmp_path_factory.mktemp("data") / "toy").path


@pytest.fixture(scope="module")
def dataset(toy):
    return api.load(toy)


def test_import_needs_no_package_and_names_are_there():
    code = """
import sys, vsfsim
heavy = [name for name in ("numpy", "scipy", "h5py", "typer", "rich", "warp", "torch") if name in sys.modules]
assert heavy == [], heavy
assert set(vsfsim.__all__) <= set(dir(vsfsim))
import vsfsim.press.figures              # importing a package's module must not take the function's place
assert callable(vsfsim.press) and callable(vsfsim.generate) and callable(vsfsim.tasks)
from vsfsim import evaluate, generate, load, methods, press, tasks
assert "fewshot-shoes-v3-mini-v1" in tasks() and "gaussian" in methods()
try:
    vsfsim.nothing
except AttributeError as error:
    assert "no attribute 'nothing'" in str(error)
else:
    raise SystemExit("an unknown name was found")
"""
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert out.returncode == 0, out.stderr


def test_python_takes_every_option_of_the_command():
    """`vsfsim press`, `generate` and `evaluate` have no option that the functions or their request lack. Files of
    pictures are methods, and --all is a loop over `vsfsim.methods()`."""
    from vsfsim.cli import bench, simulate

    for command, function in ((simulate.press, api.press), (simulate.generate, api.generate),
                              (bench.evaluate, api.evaluate)):
        options = set(inspect.signature(command).parameters) - FILES
        fields = {field.name for field in dataclasses.fields(Request)} if command is not bench.evaluate else set()
        assert options <= set(inspect.signature(function).parameters) | fields, command.__name__


def test_tasks_and_methods_are_those_of_the_commands(vsfsim, tmp_path):
    for name, found in (("tasks", api.tasks()), ("methods", api.methods())):
        out = vsfsim("list", name, "--json", "-", cwd=tmp_path)
        assert json.loads(out.stdout) == found.table()
        assert all(key in repr(found) and key in found._repr_html_() for key in found)
    assert api.tasks()["fewshot-shoes-v3-mini-v1"].protocol.shots == (0, 1, 5)


def test_a_dataset_is_a_sequence_of_object_views(dataset):
    names = dataset.names()
    assert len(dataset) == 3 and [view.name for view in dataset] == list(names)
    assert dataset[1].name == dataset[-2].name == dataset[np.int64(1)].name == dataset[names[1]].name == names[1]
    part = dataset[1:]
    assert isinstance(part, Dataset) and part.names() == names[1:] and len(dataset[::-1]) == 3
    assert dataset[::-1].names() == names[::-1]
    assert dataset.splits == ("train", "test") and dataset.split("test").names() == dataset.names("test") == names[1:]
    assert dataset.blind()[1:][0].truth is None and dataset[1:][0].truth is not None
    with pytest.raises(IndexError, match="3 object views; there is no number 3"):
        dataset[3]
    with pytest.raises(DatasetError, match="is 'tset'"):
        dataset.split("tset")


def test_representations_are_one_line_and_escaped_html(dataset):
    view = dataset[0]
    for thing in (dataset, view, view.view, view.touches[0], view.truth, dataset.torch()):
        assert "\n" not in repr(thing) and len(repr(thing)) < 250, repr(thing)
    assert "3 object views (1 train, 2 test), 36 touches" in repr(dataset)
    for thing in (dataset, view):
        assert thing._repr_html_().count("<tr>") == (4 if thing is dataset else 13)
    from vsfsim.core.system.interactive import html_table

    assert "<b>" not in html_table("<b>", ["<b>"], [["<b>"]]) and "and 2 more" in html_table("t", ["h"], [["r"]] * 62)


def test_a_torch_view_gives_the_readings_and_no_truth(dataset):
    torch = pytest.importorskip("torch")
    touches = dataset.split("test").torch(images=True)
    assert isinstance(touches, torch.utils.data.Dataset) and len(touches) == 24
    item, touch = touches[13], dataset["mock-0002-v0"].touches[1]
    assert item["name"] == "mock-0002-v0" and item["touch"] == 1
    good = touch.converged
    np.testing.assert_allclose(item["normal_force"][good], touch.normal_force()[good], rtol=1e-6)
    assert torch.isnan(item["force"][~good]).all() and item["valid"].tolist() == list(good)
    assert item["rgb"].shape[0] == 3 and item["rgb"].dtype == torch.uint8
    assert not {"truth", "young_modulus"} & set(item)
    views = dataset.torch("view", transform=lambda item: item["mask"].float().mean())
    assert len(views) == 3 and 0.0 < float(views[0]) < 1.0
    objects = dataset.torch("object")
    whole, touch = objects[2]["touches"], dataset[2].touches[5]
    good = touch.converged
    assert len(objects) == 3 and objects[2]["rgb"].shape[0] == 3 and whole["force"].shape[:1] == (12,)
    np.testing.assert_allclose(whole["normal_force"][5][good], touch.normal_force()[good], rtol=1e-6)
    assert [len(one["force"]) for one in objects.collate([objects[0], objects[1]])["touches"]] == [12, 12]
    with pytest.raises(DatasetError, match="is 'pressure'"):
        dataset.torch(fields=("pressure",))


def test_touches_of_other_lengths_are_filled_up(dataset):
    torch = pytest.importorskip("torch")
    touches = dataset.torch()
    long = touches[0]
    short = {key: value[:3] if key in ("time", "pose", "force", "normal_force", "valid") else value
             for key, value in touches[1].items()}
    batch = touches.collate([long, short])
    frames = len(long["time"])
    assert batch["force"].shape == (2, frames, 3) and batch["valid"][1].sum() == short["valid"].sum()
    assert torch.isnan(batch["normal_force"][1, 3:]).all() and not batch["valid"][1, 3:].any()
    assert (batch["time"][1, 3:] == short["time"][-1]).all() and batch["touch"].tolist() == [0, 1]
    assert batch["name"] == ["mock-0000-v0"] * 2


@pytest.mark.parametrize(("start", "workers"), [("fork", 2), pytest.param("spawn", 1, marks=pytest.mark.slow)])
def test_a_torch_view_works_with_workers(dataset, start, workers):
    torch = pytest.importorskip("torch")
    touches = dataset.torch()
    touches[0]  # what this process has read is not sent along
    assert len(pickle.dumps(touches)) < 20_000
    alone, shared = ([batch["normal_force"] for batch in torch.utils.data.DataLoader(
        touches, batch_size=9, collate_fn=touches.collate, num_workers=number,
        multiprocessing_context=start if number else None)] for number in (0, workers))
    assert len(alone) == len(shared) == 4
    for one, other in zip(alone, shared):
        torch.testing.assert_close(one, other, rtol=0.0, atol=0.0, equal_nan=True)


def test_evaluate_is_the_command(toy, tmp_path, vsfsim):
    (tmp_path / "toy-v1.toml").write_text(TASK)
    here = api.evaluate("vsfsim.baselines.near_springs:NearSprings", tmp_path / "toy-v1.toml", toy,
                           out=tmp_path / "here.json", seeds=1, check=False)
    assert here.method == "vsfsim.baselines.near_springs:NearSprings" and here.seeds == (0,)
    out = vsfsim("evaluate", "--method", "near-springs", "--task", "toy-v1.toml",
                         "--dataset", toy, "--json", "-", "--seeds", 1, cwd=tmp_path)
    told = json.loads(out.stdout)
    assert {metric: {shot: score.mean for shot, score in by_shot.items()} for metric, by_shot in here.scores.items()} \
        == {metric: {shot: score["mean"] for shot, score in by_shot.items()}
            for metric, by_shot in told["scores"].items()}
    assert (tmp_path / told["written"]).is_file() and (tmp_path / "here.json").is_file()
    assert "\n" not in repr(here) and "rmse" in repr(here) and "rmse" in here._repr_html_()
    assert here.plot(path=tmp_path / "p.png")._repr_png_()[:4] == b"\x89PNG"


def test_a_class_is_refused(toy, tmp_path):
    class Mine:
        pass

    (tmp_path / "toy-v1.toml").write_text(TASK)
    with pytest.raises(MethodError, match="%%writefile mine"):
        api.evaluate(Mine, tmp_path / "toy-v1.toml", toy)


def test_a_press_gives_what_the_command_prints(tmp_path, vsfsim):
    path = "{ path = [[0.005, 0.0, 0.041], [0.005, 0.0, 0.039]], frames = 2 }"
    (tmp_path / "small.toml").write_text(text("block", press=path, young_modulus=1e4))
    made = api.press(tmp_path / "small.toml", tier="linear", progress=lambda *_: None)
    out = vsfsim("press", "small.toml", "--tier", "linear", "--json", "-", cwd=tmp_path)
    told = json.loads(out.stdout)
    assert told["normal_force"] == made.normal_force.tolist() and told["force"] == made.force.tolist()
    assert made.normal_force == pytest.approx(-(made.force @ np.array(told["axis"]))) and made.converged
    assert "normal N" in made.text().splitlines()[0] and "\n" not in repr(made) and "<table>" in made._repr_html_()
    assert made.plot()._repr_png_()[:4] == made.picture(tmp_path / "q.png")._repr_png_()[:4] == b"\x89PNG"
    made.save(tmp_path / "s.npz")
    assert np.load(tmp_path / "s.npz")["force"].tolist() == made.force.tolist()
