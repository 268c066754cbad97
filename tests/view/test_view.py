"""The page of `vsfsim show` holds what the dataset holds, needs nothing from outside, and bad input is refused."""

import base64
import dataclasses
import io
import json
import os
import re
import shutil
import subprocess
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from mock_dataset import written
from scipy.spatial import cKDTree
from texts import text

from vsfsim.core.errors import MethodError, TaskError
from vsfsim.data.dataset import Dataset
from vsfsim.sensing.cut import Elements
from vsfsim.view import growth, subject
from vsfsim.view.command import page, view


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return written(tmp_path_factory.mktemp("view") / "toy", train=0, test=2, touches=3).path


def data_of(content):
    """The title and objects that a page holds."""
    return json.loads(re.search(r'id="data">(.*?)</script>', content.decode(), re.S)[1])


def values(table):
    """What the page's script reads: value = low + data / 65535 * span."""
    raw = np.frombuffer(base64.b64decode(table["data"]), "<u2").reshape(-1, len(table["low"]))
    return np.array(table["low"]) + raw / 65535 * np.array(table["span"])


def cells_of(table):
    return np.frombuffer(base64.b64decode(table["cells"]), "<u4").reshape(-1, table["corners"])


def half_step(table):
    return 0.5001 * np.array(table["span"]) / 65535


def test_the_page_holds_what_the_dataset_holds(folder, vsfsim, tmp_path):
    Image = pytest.importorskip("PIL.Image")
    out = vsfsim("show", folder, "--out", "page.html", "--json", "numbers.json", cwd=tmp_path)
    assert out.returncode == 0 and "2 object views" in out.stdout, out.stderr
    content = (tmp_path / "page.html").read_bytes()
    assert json.loads((tmp_path / "numbers.json").read_text())["bytes"] == len(content)
    table = data_of(content)
    dataset = Dataset.open(folder)
    assert [o["name"] for o in table["objects"]] == list(dataset.names())
    for shown, given in zip(table["objects"], dataset, strict=True):
        # a mock has no object that could be built again: its visible surface is shown, in grey
        assert (abs(values(shown["points"]) - given.view.points()) <= half_step(shown["points"])).all()
        assert shown["log_modulus"] is None and shown["corners"] == 3 and "its inside is not known" in shown["about"]
        assert 0.8 * len(given.view.points()) < len(cells_of(shown)) < 2 * len(given.view.points())
        assert {touch["probe_radius"] for touch in shown["touches"]} == {given.probe.radius}
        for told, touch in zip(shown["touches"], given.touches, strict=True):
            assert np.allclose(told["force"], touch.force, rtol=0, atol=5.1e-5)
            assert np.allclose(told["normal_force"], touch.normal_force(), rtol=0, atol=5.1e-5)
            assert np.allclose(told["place"], touch.probe_pose()[:, :3, 3], rtol=0, atol=5.1e-6)
            assert np.allclose(told["target"], touch.target, rtol=0, atol=5.1e-6)
            assert told["touched"] == touch.touched and told["converged"] == touch.converged.tolist()
        picture = {name: np.asarray(Image.open(io.BytesIO(
            base64.b64decode(shown["picture"][name].split(",")[1])))) for name in ("rgb", "depth")}
        assert np.array_equal(picture["rgb"], given.view.rgb)
        assert np.array_equal(picture["depth"][..., 1] > 0, given.view.mask)


def test_the_page_finds_each_node_of_a_skin_in_each_frame(folder):
    touch, probe = next((view.touches[0], view.probe) for view in Dataset.open(folder))
    where = np.random.default_rng(0).random((len(touch.time), 7, 3))
    skin = subject.touch_table(dataclasses.replace(touch, node_position=where, node_force=-where), probe)["skin"]
    for name, given in (("position", where), ("force", -where)):
        assert values(skin[name]).reshape(-1, skin["nodes"], 3) == pytest.approx(given, abs=1e-4)


def test_the_page_needs_nothing_from_outside_and_names_cannot_end_its_data():
    name = "</script><img src=x onerror=alert(1)>@SCRIPT@"
    made = page(name, [{"name": name}]).decode()
    assert data_of(made.encode()) == {"title": name, "objects": [{"name": name}]}
    assert made.count("</script>") == 2 and "<img" not in made
    assert not re.search(r"https?://|\bsrc=[\"']|\bhref=|import\s|fetch\(", made)


def test_the_object_of_a_scene(vsfsim, tmp_path):
    ball = "{ base = 1e5, inclusions = [{ sphere = [0.0, 0.0, 0.01, 0.006], value = 1e7 }] }"
    (tmp_path / "block.toml").write_text(text("block", shape="{ box = [0.06, 0.04, 0.02] }",
                                              resolution=None, press=None, young_modulus=ball))
    out = vsfsim("show", "block.toml", "--out", "block.html", cwd=tmp_path)
    assert out.returncode == 0, out.stderr
    (shown,) = data_of((tmp_path / "block.html").read_bytes())["objects"]
    where, modulus = values(shown["points"])[cells_of(shown)].mean(axis=1), 10 ** values(shown["log_modulus"])[:, 0]
    assert (abs(where) <= [0.03, 0.02, 0.02]).all() and where[:, 2].min() > 0.0 and shown["corners"] == 4
    assert shown["open"]["at"] == pytest.approx(0.0, abs=2e-3), "it opens through the ball"
    middle = where[modulus > 3e5]
    assert len(middle) and (np.linalg.norm(middle - [0, 0, 0.01], axis=1) < 0.012).all()
    assert modulus.min() == pytest.approx(1e5, rel=1e-3)


@pytest.mark.parametrize(("words", "found"), [
    (("data/none",), "there is no folder"),
    (("empty", "--out", "x.html"), "dataset.json"),
    (("nonsense", "--out", "x.html"), "nonsense"),
    (("bad.toml", "--out", "x.html"), "objekt"),
    (("result.json", "--out", "x.png"), "a result is drawn on a page"),
    (("toy", "--out", "x.htm"), "it must end in"),
    (("toy", "--out", "nowhere/x.html"), "there is no folder 'nowhere'"),
])
def test_bad_input_is_refused_and_nothing_is_written(words, found, folder, vsfsim, tmp_path):
    shutil.copytree(folder, tmp_path / "toy")
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.toml").write_text("[objekt]\n")
    before = sorted(tmp_path.rglob("*"))
    out = vsfsim("show", *words, cwd=tmp_path)
    assert out.returncode == 2 and found in out.stderr and "Traceback" not in out.stderr
    assert sorted(tmp_path.rglob("*")) == before


def drawn(Image, page, where):
    """The page in a browser, of 900 by 700 pixels: (H, W, 3)."""
    picture = page.with_suffix(".png")
    subprocess.run(["chromium", "--headless", "--no-sandbox", "--use-gl=angle",
                    "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
                    "--window-size=900,700", "--virtual-time-budget=2000",
                    f"--screenshot={picture}", f"file://{page}#{where}"], check=True,
                   capture_output=True, timeout=120)
    return np.asarray(Image.open(picture).convert("RGB")).astype(int)


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_a_browser_draws_the_object_and_the_cut_takes_part_of_it_away(folder, vsfsim, tmp_path):
    Image = pytest.importorskip("PIL.Image")
    assert vsfsim("show", folder, "--out", "page.html", cwd=tmp_path).returncode == 0

    def coloured(cut):
        image = drawn(Image, tmp_path / "page.html", f"axis=x&cut={cut}")[120:600, 110:500]
        return int((image.max(axis=2) < 200).sum())  # the surface of the mock is grey

    whole, half = coloured(1), coloured(0.3)
    assert whole > 5000 and 0.2 * whole < half < 0.8 * whole


METHOD = """
import numpy as np

class Steep:
    def meta_fit(self, specimens):
        pass
    def adapt(self, view, support):
        self.steepness = 100.0 * (1 + len(support))
    def predict(self, touches):
        return [self.steepness * np.arange(len(t.time))[:, None] for t in touches]
    def stiffness(self, points):
        from vsfsim.bench.method import Estimate
        return Estimate(3.0 + points[:, 0], np.ones(len(points)))
"""


def test_a_gif_shows_what_a_method_makes_of_an_object_touch_by_touch(tmp_path, monkeypatch):
    Image = pytest.importorskip("PIL.Image")
    given = written(tmp_path / "toy", train=1, test=1, touches=3)
    points = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (0.0, 0.1)]) * [1, 0.5, 1]
    tets = np.array([[0, 1, 3, 5], [0, 3, 2, 6], [0, 5, 4, 6], [3, 5, 6, 7], [0, 3, 5, 6]])
    body = Elements(points, tets, np.array([1e5, 1e5, 1e5, 1e5, 1e6]), np.arange(5))
    monkeypatch.setattr(growth, "draw_view", lambda data, shown: SimpleNamespace(body=body))
    (tmp_path / "steep.py").write_text(METHOD)
    monkeypatch.chdir(tmp_path)
    _, numbers = growth.growth(str(given.path), tmp_path / "x.gif", method="steep:Steep", settings={})
    places = 3.0 + points[tets].mean(axis=1)[:, 0]
    off = np.log(np.median(np.exp(np.log(body.young_modulus / places))) * places / body.young_modulus)
    assert np.allclose(numbers["off_by"], np.exp(abs(off).mean()), rtol=1e-6) and len(numbers["off_by"]) == 4
    assert Image.open(tmp_path / "x.gif").n_frames == 4, "of 0, 1, 2 and 3 touches"
    (tmp_path / "flat.py").write_text(METHOD.replace("def stiffness", "def softness"))
    for words, why in (({"method": "flat:Steep"}, "has no function stiffness"),
                       ({"method": "steep:Steep", "settings": {"reach": 1}}, "has no parameter 'reach'")):
        with pytest.raises(MethodError, match=why):
            growth.growth(str(given.path), tmp_path / "y.gif", **{"settings": {}, **words})


@pytest.fixture(scope="module")
def result(folder, tmp_path_factory):
    """A result file with its maps, and its dataset."""
    from vsfsim.bench.evaluate import evaluate
    from vsfsim.bench.task import parse_task

    where, dataset = tmp_path_factory.mktemp("result"), Dataset.open(folder)
    (where / "steep.py").write_text(METHOD)
    folds = text("folded-v1", ("objects = 4", "objects = 2"), ("touches = 12", "touches = 3"),
                 ("query = 4", "query = 2"), ("draws = 2, trainings = 2", "draws = 1, trainings = 1"),
                 ("[0, 1, 5]", "[0, 1]"), ("ranking_shot = 5", "ranking_shot = 1"))
    before = os.getcwd()
    os.chdir(where)  # where the method is
    evaluate("steep:Steep", parse_task(folds, "toy-v1.toml"), dataset, check=False,
             sandbox="process", out=where / "steep.json")
    os.chdir(before)
    return where / "steep.json", dataset


def test_a_result_shows_both_maps_and_the_touches(result, tmp_path, monkeypatch):
    from vsfsim.bench.result import Result
    from vsfsim.bench.result_file import MAP_ORIGIN, MAP_STEP
    from vsfsim.view import scored

    path, dataset = result
    monkeypatch.setattr(scored, "_dataset", lambda result: dataset)
    view(str(path), tmp_path / "page.html")
    table = data_of((tmp_path / "page.html").read_bytes())
    assert table["map"][1] == "N/m"
    m = Result.load(path).maps
    assert m["object"], "the mock has probed points"
    for shown, of in zip(table["objects"], dataset, strict=True):
        mine = [k for k, name in enumerate(m["object"]) if name == of.name and m["truth"][k] > 0]
        where = (np.array([[m[axis][k] for axis in "xyz"] for k in mine]) - MAP_ORIGIN) * MAP_STEP
        truth, mean = (np.array([m[key][k] for k in mine]) for key in ("truth", "mean"))
        near = cKDTree(where).query(values(shown["points"])[cells_of(shown)].mean(axis=1))
        sure = np.diff(cKDTree(where).query(values(shown["points"])[cells_of(shown)].mean(axis=1), k=2)[0])[:, 0] > 1e-4
        assert sure.mean() > 0.5
        told = values(shown["log_modulus"])[:, 0]
        assert np.allclose(told[sure], np.log10(truth)[near[1]][sure], atol=1e-3), "of the nearest probed place"
        off = values(shown["estimate"])[:, 0] - np.log10(mean)[near[1]]
        assert np.ptp(off[sure]) < 1e-3
        assert np.median(off) == pytest.approx(np.median(np.log10(truth / mean)), abs=1e-3)
        assert len(shown["touches"]) == len(of.touches)


def test_a_result_without_its_dataset_says_what_to_do(result, monkeypatch):
    from vsfsim.view import scored

    monkeypatch.setattr(scored, "_dataset", lambda result: None)
    with pytest.raises(TaskError, match=r"is not on this machine. Set \$VSFSIM_DATASETS"):
        scored.of_result(result[0], 12)


@pytest.mark.parametrize("shift", [0.0, 1e-3])
def test_elements_of_a_dataset_are_those_of_its_truth_or_not_shown(shift, folder, monkeypatch):
    given = Dataset.open(folder)[0]
    tips = given.truth.points[:, None] + 1e-3 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, -1]])
    body = Elements(tips.reshape(-1, 3) + shift, np.arange(4 * len(tips)).reshape(-1, 4), given.truth.young_modulus,
                    np.arange(len(tips)))
    monkeypatch.setattr(subject, "draw_view", lambda data, shown: SimpleNamespace(body=body))
    shown = subject.of_view(Dataset.open(folder), given)
    if shift:
        assert shown["log_modulus"] is None and "its inside is not known" in shown["about"]
    else:
        assert np.array_equal(cells_of(shown), body.tets) and shown["open"]["at"] is not None
        assert np.allclose(values(shown["log_modulus"])[:, 0], np.log10(given.truth.young_modulus), atol=1e-3)


def test_a_press_is_a_page_that_deforms(tmp_path, vsfsim):
    (tmp_path / "block.toml").write_text(text("block", shape="{ box = [0.06, 0.04, 0.02] }", press=None))
    out = vsfsim("press", "block.toml", "--picture", "press.html", cwd=tmp_path)
    assert out.returncode == 0, out.stderr
    (shown,) = data_of((tmp_path / "press.html").read_bytes())["objects"]
    rest, (touch,) = values(shown["points"]), shown["touches"]
    assert len(shown["frames"]) == len(touch["force"]) > 1 and shown["corners"] == 4
    down = [float((values(frame) - rest)[:, 2].min()) for frame in shown["frames"]]
    assert all(b < a for a, b in pairwise(down)) and down[-1] < -1e-4
