"""Rankings, estimates of errors and peers: what is computed from what was measured."""

import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from measurements import indent
from measurements.trade import ranking
from measurements.trade.ranking import agreement, kendall
from vsfsim.generate.trade.front import Point
from vsfsim.generate.trade.plot import draw


def test_rankings_agree_as_far_as_their_objects_do():
    one = np.array([[1.0, 1.1, 0.9, 1.0], [2.0, 2.1, 1.9, 2.0], [3.0, 2.9, 3.1, 3.0]])
    assert agreement(one, one) == (1.0, 1.0, 1.0) and agreement(one, one[::-1]) == (-1.0, -1.0, -1.0)
    assert kendall(np.array([1, 2, 3]), np.array([1, 3, 2])) == pytest.approx(1 / 3)
    mixed = one + [[0, 0, 0, 0], [0, 0, 0, 8], [0, 0, 0, 0]]  # the middle one is worst where the last object is drawn
    tau, low, high = agreement(mixed, one)
    assert tau == pytest.approx(1 / 3) and low == pytest.approx(1 / 3) and high == 1.0


def test_a_peer_that_is_not_there_is_skipped_with_the_reason(tmp_path, monkeypatch):
    monkeypatch.setattr(indent.venv, "create", lambda *_, **__: None)
    failed = subprocess.CompletedProcess([], 1, "", "WARNING: a\nERROR: No matching distribution\n")
    monkeypatch.setattr(indent.subprocess, "run", lambda *_, **__: failed)
    with pytest.raises(indent.Skipped, match="mujoco cannot be installed here: No matching distribution"):
        indent.python_of("mujoco", tmp_path, ["mujoco"])
    made = {"forces": [1.1, 1.8], "balance": [1e-6, 1e-7], "seconds": [1.0, 3.0], "tets": 8, "said": ""}
    found = indent.compared(made, np.array([0.001, 0.005]), np.array([1.0, 2.0]))
    assert found["at_5"] == pytest.approx(-0.1) and found["at_1"] == found["worst"] == pytest.approx(0.1)
    assert found["rms"] == pytest.approx(0.1) and found["seconds"] == 2.0 and found["balance"] == 1e-6


def test_a_peer_that_stops_leaves_the_depths_that_it_reached(tmp_path, monkeypatch):
    case, script = tmp_path / "S1.npz", tmp_path / "toy.py"
    np.savez(case, depths=np.array([0.001, 0.002]), tets=np.zeros((3, 4)))
    text = "def make(given):\n    return '1.0', '', lambda depth: (1000.0 * depth / (depth < MOST), 0.0)\n"
    script.write_text(text.replace("MOST", "0.0015"))
    monkeypatch.setitem(indent.PEERS, "toy", (str(script), "", False, False))
    found = indent.pressed("toy", case, None)
    assert found["forces"] == [1.0] and found["said"].startswith("stopped at 1 mm after") and found["tets"] == 3
    assert indent.compared(found, np.array([0.001, 0.002]), np.array([2.0, 4.0]))["rms"] == 0.5
    script.write_text(text.replace("MOST", "1.0"))  # another script: its figures are made again
    assert indent.pressed("toy", case, None)["forces"] == [1.0, 2.0]
    monkeypatch.setattr(indent.subprocess, "run", None)  # what is whole is kept
    assert indent.pressed("toy", case, None)["said"] == ""


def test_the_front_is_drawn(tmp_path):
    points = [Point(f"fem, {k} mm", "fem", 1.0 / k, 1, 1, 1, 1, 0, 0.01 * k, 0.015, {}, front=k == 2)
              for k in (1, 2, 3)]
    draw(points, "a block", tmp_path / "front.png")
    assert (tmp_path / "front.png").read_bytes()[:4] == b"\x89PNG"


def test_what_is_trained_cheaply_is_also_tested_on_the_finest_data(tmp_path, monkeypatch):
    asked = []

    def evaluate(method, task, dataset, *, training, check):
        learned = training.extra[0].dataset.sha256 if training.extra else dataset.sha256
        asked.append((method, learned, dataset.sha256))
        return f"{method} {learned}{'!' * (task.noise.force_std > 0.0)}"  # a letter more for the noise

    monkeypatch.setattr(ranking, "evaluate", evaluate)
    monkeypatch.setattr(ranking, "by_object", lambda result, metric, shot: {
        "b": 1.0 + len(result) + (shot == "4"), "a": 2.0})
    entries = tuple(SimpleNamespace(object_index=k, name=str(k)) for k in range(4))
    monkeypatch.setattr(ranking, "made", lambda one, *_, **__: SimpleNamespace(sha256=one.name, entries=entries))
    given = {"fidelities": ["linear"], "methods": ("gaussian", "sbml"), "out": tmp_path}
    found = ranking.measure(**given).record()
    (cheap, fine), (part, _) = found["ranking"], found["split"]
    assert ("sbml", "linear", "linear") in asked and ("sbml", "linear", "fem") in asked and len(asked) == 10
    assert part == {"method": "gaussian", "error": 8.5, "noise": 0.5, "touches": 0.5, "model": 7.5}
    assert cheap["fidelity"] == "linear" and cheap["own_tau"] == fine["own_tau"] == 1.0
    (tmp_path / "scores.jsonl").open("a").write('{"key": "half')  # a run that was killed
    for _ in range(2):
        assert ranking.measure(**given | {"methods": ("gaussian", "sbml", "cnp")}).record()["ranking"]
        assert len(asked) == 15, "what is scored is not scored again"
