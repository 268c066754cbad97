"""The trust map: its presses are what users write, at random places, and what it calls wrong is wrong and unmarked."""

from types import SimpleNamespace

import numpy as np
import pytest

from measurements import trust
from measurements.stability.team import Ended, Late
from measurements.trust import compare
from measurements.trust.design import Press, press
from vsfsim.core.errors import VsfsimError


def test_presses_are_scenes_at_random_places_and_the_same_every_time(tmp_path):
    seen, places = set(), []
    for number in range(60):
        cell = press(3, number, tmp_path)
        assert cell == press(3, number, tmp_path)
        scene = cell.scene(tmp_path, times=[2, 3][:len(cell.frames)]).sample(0)
        assert sum(scene.press.frames) == 2 * cell.frames[0] + 3 * sum(cell.frames[1:])
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


def one_after_the_other(jobs, work, *, workers, most, budget):
    """In place of `answers`: verdicts by number, and a process that dies at 3."""
    known = [compare.Verdict(0, "sound", ("box",), 0.03), compare.Verdict(1, "wrong", ("ball", "slide, wall"), 0.4),
             compare.Verdict(2, "marked", ("box",), None, 1.0), Ended(False, "it died", 1.0),
             compare.Verdict(4, "no reference", ("box",), words="it took too long")]
    return [(job, known[job[1]]) for job in jobs]


def test_the_report_counts_and_a_run_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(trust, "answers", one_after_the_other)
    monkeypatch.setattr(trust, "_compile", lambda: None)
    file = tmp_path / "cells.jsonl"
    trust.measure(2, 5, file)
    with file.open("a") as out:
        out.write('{"number": 2, "outc')  # a run that was killed
    found = trust.measure(5, 5, file).record()
    assert [row["number"] for row in found["every_cell"]] == [0, 1, 2, 3, 4]
    every = found["shares"][0]
    assert (every["cells"], every["judged"]) == (5, 3) and every["without"] == pytest.approx(0.4)
    assert every["wrong"] == pytest.approx(1 / 3) and every["within_5"] == every["marked"] == every["wrong"]
    assert [row["number"] for row in found["wrong"]] == [1] and "wall" in [row["kind"] for row in found["shares"]]
    assert {row["why"] for row in found["others"]} == {"crashed: it died", "no reference: it took too long"}
    assert trust.stored(file).record()["shares"] == found["shares"]
    with pytest.raises(VsfsimError, match="made with seed 5"):
        trust.measure(1, 6, file)


def test_what_came_to_its_limit_is_pressed_again_under_a_longer_one(tmp_path, monkeypatch):
    pressed = []

    def sound(jobs, work, **_):
        pressed.append([number for _, number in jobs])
        return [(job, compare.Verdict(job[1], "sound", ("box",), 0.01)) for job in jobs]

    monkeypatch.setattr(trust, "answers", one_after_the_other)
    monkeypatch.setattr(trust, "_compile", lambda: None)
    file = tmp_path / "cells.jsonl"
    trust.measure(5, 5, file)
    monkeypatch.setattr(trust, "answers", sound)
    trust.measure(5, 5, file)
    found = trust.measure(6, 5, file, limit=90.0).record()
    assert pressed == [[], [5, 4]] and found["settings"]["limit"] == 90.0
    assert found["shares"] == trust.stored(file).record()["shares"] and found["shares"][0]["judged"] == 5


def late(*_):
    raise Late


@pytest.mark.parametrize(("what", "outcome", "words"), [
    (late, "not judged", "the press took too long"), (lambda *_: 1 / 0, "crashed", "ZeroDivisionError")])
def test_what_goes_wrong_in_a_cell_is_a_verdict(what, outcome, words, monkeypatch):
    monkeypatch.setattr(compare, "_press", what)
    found = compare.judge((5, 0), limit=1.0)
    assert found.outcome == outcome and words in found.words and found.kinds


@pytest.mark.slow
@pytest.mark.parametrize("number", [95, 101])
def test_a_small_contact_of_a_flat_punch_is_told(number):
    """17 and 21 % too stiff on the default mesh at `fem-coarse`."""
    found = compare.judge((11, number), limit=120.0)
    assert found.outcome in ("sound", "marked"), found
