"""Presets of the methods, and `vsfsim evaluate --all`."""

import inspect

import pytest

from vsfsim.bench.commands.catalogue import Choice, choices, preset
from vsfsim.bench.evaluate import evaluate_all
from vsfsim.bench.leaderboard import collect, text
from vsfsim.bench.method import find_method
from vsfsim.bench.metrics import Answer
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.bench.result import Result
from vsfsim.core.errors import MethodError
from vsfsim.core.shelf import methods


def test_every_shipped_method_has_a_preset_and_every_preset_builds_its_method():
    shipped = {name for name, entry in methods().items() if entry.value.startswith("vsfsim.baselines.")}
    rows = {name: choices(name, chosen=True) for name in OBSERVATIONS}
    slow = preset("fem-map-seen", "tuned", "normal-force")
    assert {row.method for one in rows.values() for row in one} == shipped - {slow.method}, "asked by its name alone"
    for row in (slow, *(row for one in rows.values() for row in one)):
        method = find_method(row.method)
        assert set(row.parameters) <= set(inspect.signature(method).parameters), row.stem
        method(**row.parameters)


def test_a_preset_knows_the_observation():
    shoes, plants = preset("sbml", "paper", "pressure"), preset("sbml", "paper", "joint-torque")
    assert (shoes.parameters["spacing"], plants.parameters["spacing"]) == (0.005, 0.01)  # appendix B.2
    assert preset("imaml", "paper", "joint-torque").parameters["inner_rate"] == 0.01  # appendix B.4
    assert "neural-vsf" not in {row.method for row in choices("joint-torque")}
    assert not any("device" in row.parameters for row in choices("normal-force"))
    assert not any("surface-gp-" in row.method for row in choices("normal-force")), "they differ by their choice alone"


@pytest.mark.parametrize("answer", [Answer.MASK, Answer.POSE, Answer.READINGS])
def test_methods_that_cannot_give_a_tasks_answer_are_left_out(answer):
    needs = {Answer.MASK: "stiffness", Answer.POSE: "locate", Answer.READINGS: "predict"}[answer]
    for row in choices("pressure", answer=answer.value):
        assert hasattr(find_method(row.method), needs), row.stem
    every = {row.method for row in choices("pressure")}
    able = {name for name in every if hasattr(find_method(name), needs)}
    assert {row.method for row in choices("pressure", answer=answer.value)} == able


@pytest.mark.parametrize(("method", "name", "message"), [
    ("sbml", "papers", "--preset is 'papers', but sbml has paper and tuned. Did you mean 'paper'?"),
    ("contact-points", "paper", "contact-points has tuned"),
    ("toy_methods:Constant", "paper", "the method 'toy_methods:Constant' has no presets"),
])
def test_an_unknown_preset_is_refused(method, name, message):
    with pytest.raises(MethodError) as error:
        preset(method, name, "pressure")
    assert message in str(error.value)


def test_all_rows_are_made_once_and_a_failure_does_not_end_them(task, toy_dataset, tmp_path):
    asked = [Choice("toy_methods:Constant", "paper", {"value": 2.0}), Choice("toy_methods:Crashes", "tuned", {}),
             Choice("toy_methods:Constant", "tuned", {"value": 3.0})]
    rows = {tmp_path / f"{k}.json": row for k, row in enumerate(asked)}
    found = list(evaluate_all(task, rows, dataset=toy_dataset.path, seeds=1, check=False))
    assert [one.state for one in found[::2]] == ["made", "made"] and "KeyError in adapt" in found[1].state
    assert found[1].result is None and found[1].path.stem == "1"
    del rows[found[1].path]
    assert Result.load(found[2].path).parameters == {"value": 3.0} and Result.load(found[2].path).preset == "tuned"
    again = list(evaluate_all(task, rows, dataset=toy_dataset.path, seeds=1, check=False))
    assert [one.state for one in again] == ["kept", "kept"]
    other = {found[0].path: Choice("toy_methods:Constant", "paper", {"value": 2.5})}
    assert [one.state for one in evaluate_all(task, other, dataset=toy_dataset.path, seeds=1, check=False)] == [
        "made"], "other parameters are another row"
    shown = text(collect(task, [tmp_path]))
    assert "toy_methods:Constant (paper)" in shown and "toy_methods:Constant (tuned)" in shown
