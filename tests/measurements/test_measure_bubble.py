"""Measurement of the bubble: frames of a touch, and (slow) a small run through the command line."""

import json
import os
import subprocess
import sys

import pytest

from measurements.bubble import schedule
from measurements.commands import bubble
from vsfsim.core.errors import VsfsimError


def command(*words, cwd):
    return subprocess.run([sys.executable, "-P", "-c", "from vsfsim.cli.main import main; main()", "measure", "bubble",
                           *map(str, words)], capture_output=True, text=True, cwd=cwd,
                          env={**os.environ, "OMP_NUM_THREADS": "1"})


@pytest.mark.parametrize("frames", [4, 8, 15, 60])
def test_a_touch_has_the_frames_asked_for(frames):
    assert sum(schedule(frames)) == frames and min(schedule(frames)) >= 1


def test_a_wrong_option_is_refused():
    with pytest.raises(VsfsimError, match="--tier is 'linear'"):
        bubble(tier="linear")


@pytest.mark.slow
def test_a_small_run(tmp_path):
    out = command("--tier", "fem-coarse", "--resolution", 0.02, "--nodes", 100, "--touches", 2, "--frames", 5, "--json",
                  "numbers.json", cwd=tmp_path)
    assert out.returncode == 0, out.stderr
    result = json.loads((tmp_path / "numbers.json").read_text())
    assert f"{result['poke']['seconds']:.3f}" in out.stdout and f"{result['batch']['per_minute']:.1f}" in out.stdout
    assert result["units"]["poke"]["force"] == "N" and result["settings"]["nodes"] == 100
    poke, batch = result["poke"], result["batch"]
    assert (poke["frames"] == batch["frames"] == 5 and poke["nodes"] == 100 and poke["in_contact"] >= 3
            and poke["force"] > 0.0 and poke["pressure"] > 0.0)
    assert (0.0 < poke["cpu_seconds"] and poke["seconds"] <= poke["worst_seconds"]
            and batch["per_minute"] == pytest.approx(60.0 * 2 / batch["seconds"]))
    # every frame reports its progress, so that an interrupted run has shown something
    assert "second touch: frame 5" in out.stderr and "touches a minute so far" in out.stderr
