"""The trust map: its presses are those of the references, and what it calls wrong is wrong and unmarked."""

import numpy as np
import pytest

import references
from measurements.trust import Ask, ask, cell_of, judge
from references.cells import CELLS, FRAMES
from vsfsim.core.scene import parse_scene
from vsfsim.physics.contact import sdf
from vsfsim.robot.path import body_poses, press_path

KNOWN = references.load("presses")["presses"]


def test_every_press_is_a_scene_that_touches_first_where_its_reference_does(tmp_path):
    for cell in CELLS:
        for slide in (False, True):
            scene = parse_scene(cell.scene(slide=slide), tmp_path / "scene.toml").sample(0)
            poses = body_poses(scene, press_path(scene.press, scene.probe))
            low = poses[-1, 0, 2, 3] - float(sdf.support(scene.probe, poses[-1, 0, :3, :3].T @ [0.0, 0.0, -1.0]))
            assert low == pytest.approx(cell.high - cell.depth, abs=1e-9), cell
            assert poses[-1, 0, 0, 3] == pytest.approx(cell.at) and len(poses) == (3 if slide else FRAMES)


def test_a_press_of_a_known_force_is_judged_frame_by_frame():
    """The thickest reference of one material under a ball, at `fem-coarse`."""
    number = next(k for k, one in enumerate(KNOWN) if cell_of(one).body[0] != "sphere" and not one["press"]["parts"]
                  and one["press"]["probe"][0] == "sphere" and not one["press"]["foam"])
    rows = judge(Ask(0, number, "fem-coarse", "press", 1, 1.0), limit=120.0)
    assert len(rows) == FRAMES and all(np.isfinite(row["error"]) for row in rows)
    assert rows[-1]["error"] < 0.1 or rows[-1]["marked"]


def test_every_reference_is_asked_before_any_is_asked_again():
    assert sorted(ask(0, k, KNOWN).reference for k in range(len(KNOWN))) == list(range(len(KNOWN)))
