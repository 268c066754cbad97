"""The trust map: its presses are those of the references, and what it calls wrong is wrong and unmarked."""

import numpy as np
import pytest
from frame_checks import some_slow

import references
from measurements.trust import Ask, ask, judge
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


@pytest.mark.parametrize("number", some_slow((0, 42), 42), ids=["block", "soft layer"])
def test_a_press_of_a_known_force_is_judged_frame_by_frame(number):
    """A soft layer on a body ten times as hard lacks less than a half-space does, and is off by 6 to 9 %."""
    rows = judge(Ask(0, number, "fem-coarse", "press", 1, 1.0), limit=120.0)
    assert len(rows) == FRAMES and all(np.isfinite(row["error"]) for row in rows)
    assert all(row["marked"] or row["error"] - row["unsure"] < row["told"] for row in rows)


def test_every_reference_is_asked_before_any_is_asked_again():
    assert sorted(ask(0, k, KNOWN).reference for k in range(len(KNOWN))) == list(range(len(KNOWN)))


@pytest.mark.parametrize("number", some_slow((13, 5, 3, 42), 5, 3, 42), ids=["nu 0.49", "nu 0.3", "nu 0", "soft layer"])
def test_what_small_strain_errs_is_told_and_nothing_else_is_marked_for_it(number):
    """5 mm deep at nu 0.49 `linear` is off by 10.4 %, where the mesh alone says 5.5 and det F, 0.87 at least, shows
    nothing. At nu 0.3 and 0 it is off by 3.2 and 1.3 % in the deepest frame, although det F falls to 0.74 and 0.61."""
    rows = judge(Ask(0, number, "linear", "press", 1, 1.0), limit=120.0)
    assert {row["frame"] for row in rows if row["marked"]} == {
        13: {0, 3, 4}, 5: {0}, 3: {0, 1, 2}, 42: set(range(FRAMES))}[number]
    assert all(row["error"] - row["unsure"] < row["told"] for row in rows if not row["marked"])
