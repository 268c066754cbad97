"""Mutated files of every kind: no crash, no allocation over a gibibyte, no exception but a refusal."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mock_dataset import written
from texts import text

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.task import parse_task
from vsfsim.core import shelf

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("fuzz")
    dataset = written(out / "toy", test=1, touches=2)
    np.savez(out / "predictions.npz", **{"a/0/0/000": np.zeros((12, 1)), "b/5/1/011": np.ones((12, 1))})
    task = parse_task(text("toy-v1", ("objects = 3", "objects = 2"), ("touches = 12", "touches = 2"),
                           ("query = 4", "query = 1"), ("[0, 1, 5]", "[0, 1]"),
                           ("ranking_shot = 5", "ranking_shot = 1")), "toy-v1.toml")
    evaluate("contact-points", task, dataset, check=False).save(out / "result.json")
    shipped = shelf.folder("leaderboard") / "fewshot-shoes-v3-mini-v1" / "gaussian.tuned.json"
    (out / "row.json").write_bytes(shipped.read_bytes())
    (out / "task.toml").write_text(shelf.tasks()["inclusion-mini-v3"].read_text())
    (out / "scene.toml").write_text(shelf.scenes()["inclusion-pieces-mini"].read_text())
    return out


@pytest.mark.parametrize("examples", [40, pytest.param(2000, marks=pytest.mark.slow)])
def test_mutated_files_are_read_or_refused(folder, examples):
    """All readers in one process, which imports the libraries once."""
    out = subprocess.run([sys.executable, str(HERE / "fuzz_readers.py"), str(folder), str(examples)],
                         capture_output=True, text=True)
    assert out.returncode == 0 and out.stdout == f"{examples} files for each of 7 readers\n", out.stderr[-3000:]
