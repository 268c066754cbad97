"""The pressure law study on touches whose law is known."""

import dataclasses
import json

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from measurements.pressure_law import BASE_AREA, draw, judge, law, readings, report
from vsfsim.bench.mock import mock_view
from vsfsim.cli.main import app
from vsfsim.core.errors import DatasetError
from vsfsim.data.recipe import Recipe
from vsfsim.data.writer import DatasetWriter

TURN = np.diag([1.0, -1.0, -1.0])  # the dome looks down, as the press goes


def bubble_view(index, *, nodes=True, per_newton=165.0):
    """A mock view whose sensor reads ``per_newton`` Pa for each N of all its nodes' forces added up: two nodes of 0.8
    and 0.2 of the force, one slanted."""
    touches = []
    for touch in mock_view(index, split="test", touches=5).touches:
        pose = touch.mount_pose.copy()
        pose[:, :3, :3] = TURN
        force = np.stack([0.8 * touch.force, 0.2 * touch.force], axis=1)
        slant = 0.5 * np.linalg.norm(force[:, 0], axis=1)
        force[:, 0, 0] += slant
        force[:, 1, 0] -= slant  # the net force stays
        position = np.stack([pose[:, :3, 3] + [0.01, 0.0, 0.02], pose[:, :3, 3] + [0.02, 0.0, 0.02]], axis=1)
        change = per_newton * np.linalg.norm(force, axis=2).sum(axis=1)
        more = {"node_force": force.astype(np.float32), "node_position": position.astype(np.float32)} if nodes else {}
        touches.append(dataclasses.replace(touch, mount_pose=pose, pressure=7000.0 + change, rest_pressure=7000.0,
                                           **more))
    return dataclasses.replace(mock_view(index, split="test", touches=5), touches=tuple(touches))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    recipe = Recipe(scene="mock", scene_text="mock", seed=0, objects=2, views=1, touches=5, splits={"test": 2},
                    device="cpu", tier="vsf", precision="float64", renderer="warp")
    views = [bubble_view(i) for i in range(2)]
    with DatasetWriter(tmp_path_factory.mktemp("law") / "bubble", recipe, [v.name for v in views]) as writer:
        for view in views:
            writer.add(view)
        return writer.finish()


def test_a_law_by_hand():
    force, change = np.array([1.0, 2.0, 3.0]), np.array([110.0, 190.0, 320.0])
    x = law("x", force, change, scale=100.0)
    best = (110 + 380 + 960) / 14.0
    assert x.best_scale == pytest.approx(best)
    assert x.bias == pytest.approx((600 - 620) / 620)
    assert x.rms == pytest.approx(np.sqrt((100 + 100 + 400) / 3))
    left = best * force - change
    assert x.scatter == pytest.approx(left.std())
    assert x.relative == pytest.approx(left.std() / np.sqrt((110**2 + 190**2 + 320**2) / 3))


def test_the_true_law_has_no_scatter_and_the_other_is_told_apart(dataset, tmp_path):
    found = readings(dataset)
    result = judge(found)
    laws = {x["name"]: x for x in result["laws"]}
    mine = laws["sum|f|, scale fitted"]
    assert mine["best_scale"] == pytest.approx(165.0, rel=1e-6)  # float32 of the nodes' forces
    assert mine["relative"] < 1e-6 and abs(mine["bias"]) < 1e-6
    # F_n is 1 / 1.39 of the sum, if no frame slants: sqrt(1 + 1/4) 0.8 + sqrt(0.2^2 + 0.4^2)
    assert laws["F_n / A_base"]["scale"] == pytest.approx(1 / BASE_AREA) == pytest.approx(139.2, abs=0.1)
    assert laws["F_n / A_base"]["bias"] < -0.2
    assert laws["F_n / A fitted"]["scatter"] >= mine["scatter"] and abs(laws["F_n / A fitted"]["bias"]) < 0.05
    assert result["frames"] == len(found.change) > 20 and result["touches"] > 5
    # the centre of the contact is 0.01 to 0.02 m off the axis: the second ring of three, 11.45 to 22.9 mm, holds all
    assert [r["frames"] for r in result["rings"]] == [result["frames"]]
    text = report({}, result).text()
    assert "F_n / A_base" in text and "165.0" in text
    draw(found, result, tmp_path / "law.png")
    image = np.asarray(Image.open(tmp_path / "law.png").convert("L"))
    assert image.shape[1] > 1000 and (image < 128).mean() > 0.002


def test_without_forces_on_the_nodes_the_sum_is_left_out():
    found = readings([bubble_view(0, nodes=False)])
    result = judge(found)
    assert [x["name"] for x in result["laws"]] == ["F_n / A_base", "F_n / A fitted"] and result["rings"] == []
    assert "keeps no forces" in report({}, result).text()


def test_frames_without_contact_or_equilibrium_do_not_count():
    view = bubble_view(0)
    touch = view.touches[0]
    converged = touch.converged.copy()
    used = np.flatnonzero(np.linalg.norm(touch.force, axis=1) > 0.05)
    before = len(readings([dataclasses.replace(view, touches=(touch,))]).change)
    assert before == len(used) < len(converged)
    converged[used[0]] = False
    assert len(readings([dataclasses.replace(view, touches=(dataclasses.replace(touch, converged=converged),
                                                            ))]).change) == before - 1


def test_a_rigid_probe_is_refused():
    with pytest.raises(DatasetError, match="none of 5 touches has a pressure"):
        readings([mock_view(0, split="test", touches=5)])


def test_the_command(dataset, tmp_path):
    done = CliRunner().invoke(app, ["measure", "pressure-law", str(dataset.path), "--plot", str(tmp_path / "x.png"),
                                    "--json", str(tmp_path / "x.json")])
    assert done.exit_code == 0, done.output
    assert "F_n / A_base" in done.output and (tmp_path / "x.png").stat().st_size > 1000
    found = json.loads((tmp_path / "x.json").read_text())
    assert found["touches"] > 5 and found["command"] == "vsfsim measure pressure-law"
    assert found["units"]["laws"]["scatter"] == "Pa" and found["settings"]["area"] == found["area"]
