"""A sealed set: its public part asks the same questions without an answer, and its private part keeps a commitment."""

import dataclasses
import hashlib
import json
import os
import re
import shlex
from pathlib import Path

import msgspec
import numpy as np
import pytest

from measurements.release import ship, write_list
from vsfsim.bench import leaderboard, predictions
from vsfsim.bench.board import rows
from vsfsim.bench.commands.score import score_predictions
from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task
from vsfsim.core.errors import TaskError


@pytest.fixture(scope="module")
def toy_dataset(write_dataset, toy_views):
    """Of a probe on a spring, as the datasets of shoes are."""
    return write_dataset([dataclasses.replace(view, touches=tuple(
        dataclasses.replace(touch, mount_stiffness=2000.0) for touch in view.touches)) for view in toy_views])


@pytest.fixture
def parts(task, toy_dataset, tmp_path):
    commitment = predictions.seal(task, toy_dataset, tmp_path / "public", tmp_path / "private.json")
    return tmp_path / "public", tmp_path / "private.json", commitment


def test_the_public_part_asks_what_the_dataset_asks(parts, task, toy_dataset):
    public, _, _ = parts
    asked = {(q.name, q.shot, q.seed): q for q in predictions.questions(task, toy_dataset)}
    found = {(q.name, q.shot, q.seed): q for q in predictions.questions(task, public)}
    assert found.keys() == asked.keys()
    for key, mine in found.items():
        theirs = asked[key]
        assert (mine.keys, mine.touches, mine.train) == (theirs.keys, theirs.touches, ())
        for name in ("rgb", "depth", "mask", "intrinsics", "camera_pose"):
            np.testing.assert_array_equal(getattr(mine.view, name), getattr(theirs.view, name))
        actions = [*zip(mine.actions, theirs.actions), *((a.action, b.action) for a, b in zip(mine.support,
                                                                                              theirs.support))]
        for one, other in actions:
            for field in dataclasses.fields(one):
                assert str(getattr(one, field.name)) == str(getattr(other, field.name)), field.name
        for one, other in zip(mine.support, theirs.support, strict=True):
            np.testing.assert_array_equal(one.value, other.value)
            np.testing.assert_array_equal(one.valid, other.valid)


def test_nothing_of_a_query_and_nothing_of_the_seed_is_public(parts, toy_dataset):
    public, private, commitment = parts
    for file in public.glob("*.npz"):
        with np.load(file) as arrays:
            head = json.loads(arrays["head"].tobytes())
            inside = {k: {name.split("/")[1] for name in arrays.files if name.startswith(f"{k}/")}
                      for k in map(int, head["probes"])}
        assert all(inside[k] == {"time", "poses", "axis"} for k in head["query"])
        assert all(inside[k] >= {"time", "poses", "axis", "value", "valid"} for k in inside.keys() - {*head["query"]})
        assert set(head) == {"name", "probes", "query", "asked"}
    index = json.loads((public / "sealed.json").read_text())
    text = json.loads(private.read_text())["text"]
    assert hashlib.sha256(text.encode()).hexdigest() == commitment == index["commitment"]
    assert json.loads(text)["seed"] == toy_dataset.recipe.seed and len(json.loads(text)["word"]) == 32
    assert set(index) == {"format", "version", "task", "task_sha256", "commitment", "files"}
    assert toy_dataset.sha256 not in (public / "sealed.json").read_text()


def test_answers_are_scored_against_the_private_part(parts, task, toy_dataset, tmp_path, monkeypatch):
    public, private, commitment = parts
    answers = {key: np.full((len(action.time), 1), 2.0) for q in predictions.questions(task, public)
               for key, action in zip(q.keys, q.actions)}
    np.savez(tmp_path / "p.npz", **answers)
    predictions.check_commitment(private, task, toy_dataset)
    result = score_predictions(tmp_path / "p.npz", task, toy_dataset, name="mine")
    result.save(tmp_path / "r.json")
    # a row is sealed by an entry of the list with the receipt that the holder of the private part alone can make
    monkeypatch.setattr(leaderboard, "folder", lambda _: tmp_path)
    monkeypatch.setattr(rows, "folder", lambda _: tmp_path)
    ship({Path("toy-v1", "r.json"): (result, "", 0.0)}, tmp_path)
    entry = next(one for one in rows.listed().values() if one.task == "toy-v1")
    given = predictions.receipt(private, entry.sha256)
    assert given["commitment"] == commitment and given != predictions.receipt(private, "0" * 64)
    write_list([msgspec.structs.replace(entry, evidence="sealed", **given)], tmp_path / rows.LIST)
    board = leaderboard.collect(task)
    assert board.rows[0].evidence == "sealed" and "  sealed  " in leaderboard.text(board).splitlines()[4]
    assert ">sealed<" in leaderboard.page([board])
    # the same result changes nothing; one that comes out again, to the same numbers, is verified
    for made, evidence in ((result, "sealed"), (dataclasses.replace(result, timing={"predict_s": 7.0}), "verified")):
        ship({Path("toy-v1", "r.json"): (made, "", 0.0)}, tmp_path)
        assert leaderboard.collect(task).rows[0].evidence == evidence
    assert [entry.cpu_s for entry in rows.listed().values() if entry.task == "toy-v1"] == [7.0]


def test_what_was_changed_is_refused(parts, task, toy_dataset, tmp_path):
    public, private, _ = parts
    table = json.loads(private.read_text())
    other = json.dumps({**json.loads(table["text"]), "seed": 7})
    for text, commitment, message in ((other, table["commitment"], "does not keep its commitment"),
                                      (other, hashlib.sha256(other.encode()).hexdigest(), "seed differ"),
                                      ("{}", hashlib.sha256(b"{}").hexdigest(), "not that of a sealed set")):
        private.write_text(json.dumps({**table, "text": text, "commitment": commitment}))
        with pytest.raises(TaskError, match=message):
            predictions.check_commitment(private, task, toy_dataset)
    with pytest.raises(TaskError, match="is a sealed set of task toy-v1, not of this text"):
        next(predictions.questions(dataclasses.replace(task, sha256="0" * 64), public))
    file = next(public.glob("*.npz"))
    file.write_bytes(file.read_bytes()[:-1] + b"x")
    with pytest.raises(TaskError, match="was changed after the set was sealed"):
        list(predictions.questions(task, public))
    with pytest.raises(TaskError, match="is no part of a sealed set"):
        next(predictions.questions(task, tmp_path))
    with pytest.raises(TaskError, match="exists already"):
        predictions.seal(task, toy_dataset, public, tmp_path / "new.json")
    with pytest.raises(TaskError, match="would lie in the public folder"):
        predictions.seal(task, toy_dataset, tmp_path / "new", tmp_path / "new" / "private.json")


PAGE = (Path(__file__).parents[3] / "GOVERNANCE.md").read_text().split("## Score a sealed")[1].split("\n## ")[0]


def test_the_page_goes_through_a_round(toy_dataset, task_text, vsfsim, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("round").mkdir()
    Path("toy-v1.toml").write_text(task_text)
    Path("data").mkdir()
    for place in (Path("data/toy"), Path("round/data")):
        place.symlink_to(toy_dataset.path)
    monkeypatch.setenv("VSFSIM_DATASETS", str(tmp_path / "data"))
    blocks = re.findall(r"```(bash|py)\n(.*?)```", PAGE.replace("fewshot-shoes-v3-mini-v1", "toy-v1.toml"), re.DOTALL)
    assert [kind for kind, _ in blocks] == ["bash", "py", "bash"]
    said = []
    for kind, block in blocks:
        if kind == "py":
            exec(compile(block, "GOVERNANCE.md", "exec"), {})
            continue
        for line in block.splitlines():
            words = shlex.split(line)
            if words[1] != "generate":  # the data are there, and not of a secret seed
                found = vsfsim(*words[1:], cwd=tmp_path)
                assert found.returncode == 0, found.stderr
                said.append(found.stdout)
    commitment = re.search(r"commitment to publish: (\w{64})", said[0])[1]
    assert "a seed with 12 digits or more" in said[0] and f"commitment: {commitment}" in said[1]
    assert re.search(r"receipt: \w{64}", said[1])
    row = Result.load(next(Path("results").rglob("mine.json")))
    assert row.task == "toy-v1-sealed" and 0.0 < row.scores["rmse_ratio"]["5"].mean < 1.0
    public = b"".join(path.read_bytes() for path in Path("round/public").iterdir())
    assert row.dataset_sha256.encode() not in public and os.environ["VSFSIM_DATASETS"].encode() not in public


def test_the_round_of_the_page_keeps_its_commitment_and_its_receipt():
    (text,) = re.findall("(?m)^{.*}$", PAGE)
    commitment, row, receipt = re.findall(r"\| `(\w{64})` \|", PAGE)
    assert hashlib.sha256(text.encode()).hexdigest() == commitment
    assert hashlib.sha256(f"{text}{row}".encode()).hexdigest() == receipt
    assert json.loads(text)["task_sha256"] == load_task("fewshot-shoes-v3-mini-v1-sealed").sha256


def test_a_sealed_task_tells_no_seed():
    """Neither its digest nor its data depend on it."""
    task = load_task("fewshot-shoes-v3-mini-v1")
    sealed = task.on("sealed")
    assert sealed.name == "fewshot-shoes-v3-mini-v1-sealed" == load_task(sealed.name).name
    assert load_task(sealed.name).sha256 == sealed.sha256 != task.sha256 and sealed.protocol == task.protocol
