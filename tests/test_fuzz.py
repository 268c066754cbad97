"""Mutated files of every kind: no crash, no allocation over a gibibyte, no exception but a refusal."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mock_dataset import TASK, written

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.task import parse_task
from vsfsim.core import shelf

HERE = Path(__file__).parent
READERS = ("object", "manifest", "result", "board", "predictions", "task", "scene")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("fuzz")
    dataset = written(out / "toy", test=1, touches=2)
    np.savez(out / "predictions.npz", **{"a/0/0/000": np.zeros((12, 1)), "b/5/1/011": np.ones((12, 1))})
    text = TASK
    for old, new in (("query = 4", "query = 1"), ("[0, 1, 5]", "[0, 1]"), ("ranking_shot = 5", "ranking_shot = 1")):
        text = text.replace(old, new)
    task = parse_task(text, "toy-v1.toml")
    evaluate("contact-points", task, dataset, check=False).save(out / "result.json")
    shipped = shelf.folder("leaderboard") / "inclusion-mini-v3.json"
    (out / "board.json").write_bytes(shipped.read_bytes())
    (out / "task.toml").write_text(shelf.tasks()["inclusion-mini-v3"].read_text())
    (out / "scene.toml").write_text(shelf.scenes()["inclusion-pieces-mini"].read_text())
    return out


def fuzz(reader, folder, examples):
    out = subprocess.run([sys.executable, str(HERE / "fuzz_readers.py"), reader, str(folder), str(examples)],
                         capture_output=True, text=True)
    assert out.returncode == 0 and out.stdout == f"{reader}: {examples} files\n", out.stderr[-3000:]


@pytest.mark.parametrize("reader", READERS)
def test_mutated_files_are_read_or_refused(folder, reader):
    fuzz(reader, folder, 60)


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_many_mutated_files_are_read_or_refused(folder, reader):
    fuzz(reader, folder, 2000)
