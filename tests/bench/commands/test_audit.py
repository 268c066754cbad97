"""`vsfsim lab audit`: shortcuts, ranks and agreement with fresh objects, on boards whose answers are known."""

import dataclasses
import math

import numpy as np
import pytest

from measurements import audit as module
from measurements.audit import audit, text
from measurements.release import ship_audit
from vsfsim.baselines.shortcuts import KINDS, Shortcut
from vsfsim.bench.check import MOCK_TASK
from vsfsim.bench.method import Reading, Specimen
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record
from vsfsim.bench.result import Result
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import TaskError


@pytest.fixture
def folded(folded_text):
    return parse_task(folded_text.replace("draws = 2, trainings = 2", "draws = 1, trainings = 1"), "toy-v1.toml")


def row(task, name, errors, folder):
    """A result whose objects err by these shares of predicting zero, at every number of touches."""
    objects = [f"mock-{k:04d}-v0" for k in range(len(errors)) for _ in range(4)]
    touches = [touch for _ in errors for touch in range(4)]
    parts = [(o, shot, 0, touch, 5, 5.0 * errors[k // 4] ** 2)
             for shot in task.protocol.labels for k, (o, touch) in enumerate(zip(objects, touches))]
    queries = dict(zip(("object", "shot", "seed", "touch", "n", "sse"), map(list, zip(*parts)), strict=True))
    readings = {"object": objects, "touch": touches, "n": [5] * len(objects), "ss": [5.0] * len(objects)}
    made = Result(task=task.name, task_sha256=task.sha256, dataset_sha256="d" * 64, dataset_made_by={}, method=name,
                  entry="m:M", parameters={}, observation="normal-force", unit="N", shots=task.protocol.labels,
                  seeds=(0,), scores={}, queries=queries, timing={}, peak_memory_mib=1.0,
                  machine={}, made_by={}, versions={}, readings=readings)
    folder.mkdir(exist_ok=True)
    dataclasses.replace(made, scores=made.computed()).save(folder / f"{name}.json")


def test_neighbours_and_the_least_difference(folded, tmp_path):
    """a and b differ by 0.1 in every object; b and c by 0.01, 0.03 and -0.01."""
    base = np.array([0.3, 0.5, 0.4])
    for name, errors in (("a", base), ("b", base + [0.1, 0.1, 0.1]), ("c", base + [0.11, 0.13, 0.09])):
        row(folded, name, errors, tmp_path / "r")
    found = audit(folded, [tmp_path / "r"], dataset=None)
    assert (found.rows, found.told, found.best, found.shortcuts) == (3, 1, "a", ())
    spread = np.std([0.01, 0.03, -0.01], ddof=1) / math.sqrt(3)
    assert found.least == pytest.approx(np.median([0.0, spread]) * 4.3027, rel=1e-4)  # Student's, 2 degrees of freedom
    words = text(found, "rmse_ratio, area")
    assert "50 % (1 of 2)" in words and words.count("not measured") == 2


def test_rows_agree_with_those_of_fresh_objects_or_not(folded, tmp_path):
    for k, name in enumerate("abcde"):
        row(folded, name, [0.1 * k + 0.1] * 3, tmp_path / "r")
        row(folded, name, [0.1 * k + 0.3] * 3, tmp_path / "same")
        row(folded, name, [0.9 - 0.1 * k] * 3, tmp_path / "turned")
    row(folded, "a", [0.2] * 3, tmp_path / "one")
    found = audit(folded, [tmp_path / "r"], fresh=[tmp_path / name for name in ("same", "one", "turned")])
    assert [one for _, _, one in found.fresh[::2]] == pytest.approx([1.0, -1.0])
    words = text(found, "m")
    assert "same: rank correlation 1.00 of 5 rows; enough" in words and "one: 1 rows in common, fewer than 4" in words
    assert "turned: rank correlation -1.00 of 5 rows; less than the 0.9" in words


def test_what_needs_data_ships_and_is_read_without_them(folded, tmp_path, monkeypatch):
    row(folded, "good", [0.1, 0.2, 0.15], tmp_path / "r")
    errors = {sees: {f"mock-{k:04d}": 0.5 + 0.03 * k for k in range(3)} for sees in KINDS}
    monkeypatch.setattr(module, "_shortcuts", lambda *_: errors)
    found = dataclasses.replace(audit(folded, [tmp_path / "r"]), fresh=(("toy-v1-seed-2", 5, 0.95),))
    monkeypatch.setattr(module.shelf, "folder", lambda _: tmp_path)
    ship_audit(found, tmp_path / "audits" / "toy-v1.json", folded.sha256, "digest")
    assert module.shipped(folded).of == "digest"
    again = audit(folded, [tmp_path / "r"], measure=False)
    assert again.errors == errors and again.shortcuts == found.shortcuts and again.fresh == found.fresh
    other = audit(dataclasses.replace(folded, sha256="0" * 64), [], measure=False)
    assert other.errors == {} and other.fresh == () and "no audit of it ships" in text(other, "m")
    (tmp_path / "audits" / "toy-v1.json").write_text("{}")
    with pytest.raises(TaskError, match="is no audit as `vsfsim lab release` writes it"):
        audit(folded, [tmp_path / "r"], measure=False)


def test_shortcuts_stand_beside_the_best_row(folded, tmp_path, monkeypatch):
    row(folded, "good", [0.1, 0.2, 0.15], tmp_path / "r")
    shares = dict(zip(KINDS, (0.9, 0.12, 0.5, 0.8), strict=True))
    assert module.KINDS == KINDS
    monkeypatch.setattr(module, "_shortcuts", lambda *_: {
        sees: {f"mock-{k:04d}": share + 0.03 * k for k in range(3)} for sees, share in shares.items()})
    found = audit(folded, [tmp_path / "r"])
    behind = {s.sees: s.behind for s in found.shortcuts}
    difference = np.array([0.12, 0.15, 0.18]) - [0.1, 0.2, 0.15]
    assert behind["action"] == pytest.approx(difference.mean() / (difference.std(ddof=1) / math.sqrt(3)))
    assert "action: no row is told to be better than this shortcut" in text(found, "m") and behind["constant"] > 2.0
    assert [s.sees for s in found.shortcuts if not s.beaten] == ["action"]


# ------------------------------------------------------------------------------------------ what a shortcut knows


@pytest.fixture(scope="module")
def felt():
    """Objects of which each is as stiff, and as bright, as its number says."""
    task, out = parse_task(MOCK_TASK, "mock"), []
    for k in range(6):
        view = mock_view(k, touches=8)
        shape = np.linspace(0.0, 1.0, len(view.touches[0].time))[:, None]
        bright = dataclasses.replace(view.view, rgb=(view.view.rgb * (0.4 + 0.1 * k)).astype(np.uint8))
        out.append(Specimen(view.name, bright, tuple(
            Reading(r.action, (1.0 + k) * shape * (1.0 + 10.0 * abs(r.action.poses[-1, 0, 3])),
                    np.ones(len(shape), bool)) for r in record(view, task).readings)))
    return out


@pytest.mark.parametrize("sees", KINDS)
def test_a_shortcut_uses_what_it_sees_and_nothing_else(felt, sees, tmp_path):
    method, other = Shortcut(sees=sees), Shortcut(sees=sees)
    method.meta_fit(felt[:5])
    method.save(tmp_path)
    other.load(tmp_path)
    asked = [r.action for r in felt[5].touches[4:]]

    def answers(view, support):
        other.adapt(view, support)
        return np.concatenate(other.predict(asked), axis=1)

    blind = answers(felt[0].view, [])
    changed = {"view": not np.allclose(answers(felt[5].view, []), blind),
               "touch": not np.allclose(answers(felt[0].view, felt[5].touches[:3]), blind),
               "action": not np.allclose(blind, blind[:, :1])}
    assert changed == {key: key == sees for key in changed}
    truth = np.concatenate([r.value for r in felt[5].touches[4:]], axis=1)
    if sees == "touch":
        assert np.abs(answers(felt[5].view, felt[5].touches[:4]) - truth).mean() < 0.7 * np.abs(blind - truth).mean()
    method.adapt(felt[0].view, [])
    np.testing.assert_allclose(np.concatenate(method.predict(asked), axis=1), blind)


def test_a_task_without_rows_is_audited(task):
    """Without rows and data nothing is measured."""
    assert audit(task, []).rows == 0 and math.isnan(audit(task, []).least)
