"""Peers: what is computed from what was measured."""

import numpy as np
import pytest

from measurements import indent


def test_a_peers_errors_are_shares_of_the_reference():
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
