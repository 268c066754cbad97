"""The record of a measurement, its report and its JSON; and the command where there is no checkout."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from measurements import gpu, peers
from measurements.measurement import Column, Measurement, Table
from vsfsim.core.errors import VsfsimError

ROOT = Path(__file__).parents[2]

ROWS = [{"name": "a", "depth": 0.0025, "parts": {"solve": 1.5}, "ends": [0.1, None], "share": 0.5},
        {"name": "longer", "depth": float("nan"), "parts": {}, "ends": [0.2, 3.0], "share": 0.25}]
COLUMNS = (Column("name", "who"), Column("depth", "depth", "m", "mm", ".1f"), Column("parts.solve", "solve", "s"),
           Column("ends.1", "last", "1"), Column("share", "share", "1", "%", ".0f"))


@pytest.fixture
def measured():
    return Measurement.of("toy", {"device": "cpu", "size": 3}, [
        Table("some rows", COLUMNS, ROWS, name="rows"),
        Table("a view of them", COLUMNS[:1], ROWS)], notes=["It holds for toys."], numbers={"extra": 7})


def test_the_report_prints_stored_values_in_the_printed_unit(measured):
    lines = [line.split() for line in measured.text().splitlines()]
    assert ["who", "depth", "[mm]", "solve", "[s]", "last", "share", "[%]"] in lines
    assert ["a", "2.5", "1.5", "-", "50"] in lines and ["longer", "-", "-", "3.0", "25"] in lines
    assert "note: It holds for toys." in measured.text()


def test_the_json_holds_rows_units_and_the_run(measured):
    found = json.loads(json.dumps(measured.record(), allow_nan=False))
    assert found["rows"][0] == ROWS[0] and found["rows"][1]["depth"] is None
    assert found["units"] == {"rows": {"depth": "m", "parts.solve": "s", "ends.1": "1", "share": "1"}}
    assert found["command"] == "vsfsim measure toy" and found["settings"]["size"] == 3 and found["extra"] == 7
    assert found["notes"] == ["It holds for toys."] and found["version"] and found["date"].endswith("+00:00")


def test_an_installed_package_without_its_repository_says_where_the_scripts_are(tmp_path):
    """As in a wheel: the package and nothing beside it."""
    shutil.copytree(ROOT / "vsfsim", tmp_path / "vsfsim", ignore=shutil.ignore_patterns("__pycache__"))
    out = subprocess.run([sys.executable, "-c", "from vsfsim.cli.main import main; main()", "measure", "solver"],
                         capture_output=True, text=True, cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)})
    assert out.returncode == 2 and "needs a checkout of the repository" in out.stderr and "measurements/" in out.stderr


def test_a_peers_errors_are_shares_of_the_reference_and_its_set_up_is_paid():
    made = {"forces": [1.1, 1.8], "balance": [1e-6, 1e-7], "seconds": [1.0, 3.0], "once": 2.0, "unknowns": 8}
    found = peers.compared(made, np.array([1.0, 2.0]))
    assert found["full"] == pytest.approx(-0.1) and found["first"] == found["worst"] == pytest.approx(0.1)
    assert found["rms"] == pytest.approx(0.1) and found["seconds"] == 6.0 and found["balance"] == 1e-6
    cut = peers.compared(made, np.array([1.0, 2.0, 3.0]))
    assert cut["full"] is None and "2 of 3 depths" in cut["said"]
    assert "no equilibrium" in peers.compared({"forces": []}, np.array([1.0]))["said"]


def test_every_case_has_a_reference_and_the_five_were_no_part_of_a_fit():
    for case, (cell, file) in peers.CASES.items():
        depths, force, unsure = peers.known(case)
        assert depths[-1] == pytest.approx(cell.depth) and (np.diff(force) > 0.0).all() and unsure < 0.03
        assert (file == "presses") == (cell.body != ("box", 0.1, 0.1, 0.05))  # S1's, on which constants were fitted


@pytest.mark.slow
def test_a_direct_solver_finds_the_equilibrium_of_this_one_on_a_round_body():
    """On the same curved tetrahedra, without the local indentation; linear ones of the same corners are stiffer."""
    pytest.importorskip("cvxopt")
    depth = peers.known("ball")[0][-1:]
    own = peers.ours("ball", "fem-coarse", False, depth)
    quadratic, linear = (peers.theirs("ball", "fem-coarse", peer, depth) for peer in peers.PEERS[:2])
    assert quadratic["forces"] == pytest.approx(own["forces"], rel=0.01)  # observed 0.4 %
    assert linear["forces"][0] > 1.2 * quadratic["forces"][0] and quadratic["unknowns"] == own["unknowns"]
    assert max(quadratic["balance"]) < 1e-3 and min(own["once"], quadratic["once"]) > 0.0


def test_without_a_peers_packages_the_command_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(VsfsimError, match="pip install scikit-fem cvxopt"):
        peers.measure(folder=tmp_path)


def test_a_gpu_is_compared_with_cores_and_a_cpu_is_refused(device):
    if device == "cpu":
        with pytest.raises(VsfsimError, match="'cpu', which is no GPU"):
            gpu.measure("shoes-mini", device=device)
        return
    runs, host = (t.rows for t in gpu.measure("shoes-mini", device=device, objects=1, touches=2, cores=1).tables)
    assert runs[0]["frames"] == runs[1]["frames"] > 0 and runs[0]["difference"] < 2e-4  # each within 1e-4
    assert host[0]["operations"] > host[0]["waits"] > 0.0 and 0.0 < host[0]["busy"] < 1.0
