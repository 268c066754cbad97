"""Measurement of a scene on a GPU, with a GPU that is played."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from measurements.datasets import card
from measurements.datasets.commands import app
from measurements.datasets.hot_kernels import hot_kernels
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.generate.recipe import make_recipe

SMI = """#!/bin/sh
echo "$*" > {folder}/asked
printf '20, 1000\\n60, 3000\\n'
sleep 60
"""
BLOCK = """
[object]
shape = { box = [0.06, 0.06, 0.03] }
young_modulus = 1e5
tier = "fem-coarse"
resolution = 0.02
[probe]
shape = { sphere = 0.015 }
[touches]
count = 2
depth = 0.004
frames = { free = 1, in = 2, hold = 0, out = 0 }
[camera]
width = 64
height = 48
"""


def test_a_machine_without_a_gpu_is_told_so():
    with pytest.raises(VsfsimError, match="--device is 'cpu', which is no GPU"):
        card.measure("shoes-v3-mini", device="cpu")
    if not torch.cuda.is_available():
        found = CliRunner().invoke(app, ["gpu", "shoes-v3-mini"])
        assert found.exit_code and "this machine has cpu" in str(found.exception)


def test_rates_load_and_ratio(monkeypatch, tmp_path):
    (tmp_path / "nvidia-smi").write_text(SMI.format(folder=tmp_path))
    (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=":")
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda device: SimpleNamespace(uuid="17"))
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "a GPU")
    asked = []

    def generate(scene, out, *, device, workers, **recipe):
        asked.append((device, workers, recipe))
        clock[0] += 2.0 if device == "cpu" else 0.5
        while device != "cpu" and not (tmp_path / "asked").exists():
            pass
        return [SimpleNamespace(touches=[SimpleNamespace(converged=np.array([True, True, True, False]))] * 5)]

    clock = [0.0]
    monkeypatch.setattr(card, "generate", generate)
    monkeypatch.setattr(card, "compile_kernels", lambda kernels, device: None)
    monkeypatch.setattr(card, "compare", lambda one, other: SimpleNamespace(worst=2e-5))
    monkeypatch.setattr(card.time, "perf_counter", lambda: clock[0])
    monkeypatch.setattr(card, "make_recipe", lambda *_, **__: None)
    kernel = {"kernel": "inverse", "seconds": 1e-3, "share": 0.9, "bandwidth": 0.6, "arithmetic": 0.1}
    monkeypatch.setattr(card, "hot_kernels", lambda *_: ([kernel], 200.0))
    found = card.measure("shoes-v3-mini", objects=1, workers=8, cores=16)
    gpu, cpu = found.record()["runs"]
    assert asked == [(device, count, {"objects": 1, "touches": None}) for device, count in (("cuda:0", 8), ("cpu", 16))]
    assert (gpu["frames"], gpu["converged"], gpu["rate"], cpu["rate"]) == (20, 0.75, 40.0, 10.0)
    assert (gpu["busy"], gpu["memory"], gpu["ratio"], gpu["difference"]) == (0.4, 3000 * 2.0**20, 4.0, 2e-5)
    assert gpu["limit"] == 200.0 and found.record()["kernels"] == [kernel]
    assert "-i GPU-17" in (tmp_path / "asked").read_text() and "times the cores" in found.text()


@pytest.mark.slow
def test_hot_kernels_and_the_limit_on_a_cpu(tmp_path):
    path = tmp_path / "block.toml"
    path.write_text(BLOCK)
    loaded = load_scene(path)
    rows, limit = hot_kernels(loaded, make_recipe(loaded, objects=1), "cpu")
    assert "1 columns" not in rows[0]["kernel"] and rows[1]["kernel"].startswith("tangents of ")
    assert sum(row["share"] for row in rows) == pytest.approx(1.0) and limit > 0.0
    assert all(row[name] > 0.0 for row in rows for name in ("seconds", "bandwidth", "arithmetic"))
