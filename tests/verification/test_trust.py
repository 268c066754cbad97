"""The trust map: its presses are what users write, at random places, and what it calls wrong is wrong and unmarked."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import trust
from benchmarks.trust import compare
from benchmarks.trust.design import Press, press
from vsfsim.core.errors import VsfsimError


def test_presses_are_scenes_at_random_places_and_the_same_every_time(tmp_path):
    seen, places = set(), []
    for number in range(60):
        cell = press(3, number, tmp_path)
        assert cell == press(3, number, tmp_path)
        scene = cell.scene(tmp_path, times=2).sample(0)
        assert sum(scene.press.frames) == 2 * sum(cell.frames)
        seen |= set(cell.kinds) | {word for kind in cell.kinds for word in kind.split(", ")}
        places.append(scene.press.start[:2])
    assert {"box", "plate", "ball", "cylinder", "scan", "foam", "several", "layer", "skin", "slide", "turn", "back",
            "wall", "coarse", "linear", "fem", "plane", "capsule"} <= seen
    assert (np.abs(places) > 1e-4).all(), "none on a plane of symmetry"


def result(push, *, good=True, resolved=True):
    force = np.zeros((len(push), 3))
    force[:, 2] = push
    every = np.ones(len(push), bool)
    return SimpleNamespace(force=force, converged=every & good, resolved=every & resolved, words=(), notes=(),
                           more={"mesh_error": np.zeros(len(push))})


@pytest.mark.parametrize(("own", "outcome", "error"), [
    (result([1.0, 2.04]), "sound", 0.02), (result([1.0, 2.3]), "wrong", 0.15),
    (result([1.0, 2.3], resolved=False), "marked", None), (result([0.0, 2.0]), "wrong", 1.0),
    (result([1.0, 2.0], good=np.array([True, False])), "sound", 0.0)])
def test_a_frame_that_is_off_and_not_marked_is_wrong_in_silence(own, outcome, error):
    cell = Press(("box",), "fem", "", (2,), 1.0, 0)
    found = compare._compare(0, cell, own, result([0.5, 1.0, 1.5, 2.0]))
    assert found.outcome == outcome and (error is None) == (found.error is None)
    assert error is None or found.error == pytest.approx(error)


def test_the_report_counts_and_a_run_goes_on(tmp_path, monkeypatch):
    rows = [compare.Verdict(0, "sound", ("box",), 0.03), compare.Verdict(1, "wrong", ("ball",), 0.4),
            compare.Verdict(2, "marked", ("box",), None, 1.0), compare.Verdict(3, "no reference", ("box",))]
    asked = []
    monkeypatch.setattr(trust, "judge", lambda seed, number: asked.append(number) or rows[number])
    file = tmp_path / "cells.jsonl"
    trust.measure(2, 5, file)
    found = trust.measure(4, 5, file).record()
    assert asked == [0, 1, 2, 3] and len(file.read_text().splitlines()) == 4
    every = found["shares"][0]
    assert every["number"] == 3 and every["wrong"] == pytest.approx(1 / 3) and every["within_5"] == pytest.approx(1 / 3)
    assert [row["number"] for row in found["wrong"]] == [1]
    with pytest.raises(VsfsimError, match="another seed"):
        trust.measure(1, 6, file)
    file.write_text(json.dumps([1]))
    with pytest.raises(VsfsimError, match="not a file of"):
        trust.measure(1, 5, file)
