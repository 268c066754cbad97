"""How long kernels take to compile: every module of a scene is compiled from nothing."""

import pytest
import warp as wp
from typer.testing import CliRunner

from vsfsim.cli.main import app


@wp.kernel(enable_backward=False)
def double(x: wp.array(dtype=wp.float64)):
    x[wp.tid()] = wp.float64(2.0) * x[wp.tid()]


@pytest.mark.slow  # Warp reads its headers: 5 s
def test_every_module_of_a_scene_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vsfsim.generate.effector.kernels_of", lambda scene: [double, double])
    done = CliRunner().invoke(app, ["measure", "compile", "shoes-v3-mini", "--no-card"])
    assert done.exit_code == 0, done.output
    rows = [line.split() for line in done.output.splitlines()]
    row = next(row for row in rows if row[:2] == ["shoes-v3-mini", "test_compiling"])
    assert int(row[2]) > 50 and 0.0 < float(row[3]) < 60.0
    assert row[4] == "-", "not for a card"
