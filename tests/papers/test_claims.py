"""The papers' claims beside results whose answers are known."""

import re
from pathlib import Path

import pytest

from vsfsim.bench.leaderboard import Board, Row
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task
from vsfsim.papers.claims import FAILS, HOLDS, UNTOLD, Claim, Side, claims_of, judge, text, with_results
from vsfsim.papers.study import load_study, studies

TASK = "fewshot-shoes-v2-mini-v3"


def row(method, values, preset="tuned"):
    """A ranked row whose objects have these ratios at 0 touches."""
    result = Result(task=TASK, task_sha256="", dataset_sha256="", dataset_made_by={}, method=method, entry="",
                    parameters={}, observation="normal-force", unit="N", shots=("0",), seeds=(0,), scores={},
                    queries={}, timing={}, peak_memory_mib=0.0, machine={}, made_by={}, versions={}, preset=preset)
    objects = {"0": {f"o{k}": v for k, v in enumerate(values)}}
    return Row(1, "", result, {}, Path(f"{method}.json"), False, objects)


def verdict(better, worse, figures="1 and 2", **given):
    claim = Claim("a claim", "a paper", figures, TASK, Side("a", "0"), Side("b", "0"), **given)
    rows = [r for r in (better, worse) if r is not None]
    board = Board(load_task(TASK), "", False, 0.0, tuple(rows))
    return judge([claim], {TASK: board})[0]


LEVEL = [0.4, 0.9, 0.6, 1.2, 0.7]


def test_a_claim_is_decided_object_by_object():
    much_less = [v - 0.1 - 0.01 * k for k, v in enumerate(LEVEL)]
    mixed = [v + 0.3 * (-1) ** k for k, v in enumerate(LEVEL)]
    assert verdict(row("a", much_less), row("b", LEVEL)).answer == HOLDS
    assert verdict(row("a", LEVEL), row("b", much_less)).answer == FAILS
    assert verdict(row("a", mixed), row("b", LEVEL)).answer == UNTOLD
    nearly = [v + 0.03 * (-1) ** k for k, v in enumerate(LEVEL)]
    assert verdict(row("a", nearly), row("b", LEVEL), equal=True).answer == HOLDS
    assert verdict(row("a", mixed), row("b", LEVEL), equal=True).answer == UNTOLD, "too wide to tell"
    assert verdict(row("a", much_less), row("b", LEVEL), equal=True).answer == FAILS
    assert verdict(row("a", LEVEL[:2]), row("b", [v + 1.0 for v in LEVEL[:2]])).answer == UNTOLD, "two objects"


def test_a_large_difference_of_the_paper_that_is_none_here_does_not_hold():
    nearly = row("a", [v + 0.03 * (-1) ** k for k, v in enumerate(LEVEL)])
    mixed = row("a", [v + 0.3 * (-1) ** k for k, v in enumerate(LEVEL)])
    assert verdict(nearly, row("b", LEVEL), "7.43 and 9.76 hPa").answer == FAILS
    assert verdict(nearly, row("b", LEVEL), "7.43 and 8.27 hPa").answer == UNTOLD, "10 % in the paper, too"
    assert verdict(nearly, row("b", LEVEL), "drawn, no number").answer == UNTOLD
    assert verdict(mixed, row("b", LEVEL), "7.43 and 9.76 hPa").answer == UNTOLD, "too wide to tell"


def test_a_claim_takes_the_first_size_with_results():
    less = row("a", [v - 0.1 - 0.01 * k for k, v in enumerate(LEVEL)])
    mini, none = verdict(less, row("b", LEVEL)), verdict(less, None)
    standard = verdict(row("a", LEVEL), row("b", [v - 0.1 - 0.01 * k for k, v in enumerate(LEVEL)]))
    assert with_results([[standard], [mini]]) == [standard] and with_results([[none], [mini]]) == [mini]
    assert with_results([[none], [none]]) == [none] and with_results([[], [mini]]) == [mini]


def test_a_missing_result_is_named_with_its_command():
    found = verdict(row("a", LEVEL), None)
    assert found.answer == UNTOLD and found.difference is None
    assert found.commands == (f"vsfsim evaluate --method b --preset tuned --task {TASK}",)
    assert "Of 1 claims 0 hold, 0 do not hold, and 1 cannot be told." in text([found])
    assert f"  {found.commands[0]}  # claims 1" in text([found])
    other = verdict(row("a", LEVEL), row("b", LEVEL, preset="paper"))
    assert other.answer == UNTOLD, "another preset is another row"
    plain = verdict(row("a", [v - 0.1 for v in LEVEL]), row("b", LEVEL, preset=""))
    assert plain.answer == HOLDS and "(a.json)" in plain.commands[0]


@pytest.mark.parametrize("size", ["mini", "standard"])
def test_every_claim_asks_a_task_and_methods_that_there_are(size):
    from vsfsim.core.shelf import methods

    for claim in claims_of(size):
        task = load_task(claim.task)
        for side in (claim.better, claim.worse):
            assert side.method in methods() and side.shot in task.protocol.labels, claim.text
        assert claim.metric == "rmse_ratio" or claim.metric == task.primary or claim.note
        assert task.observation.name in OBSERVATIONS


def test_the_papers_figures_are_two_numbers_or_words():
    """Their difference is read from them, so that a form that is not read would never tell that a claim fails."""
    asked = [claim.figures for size in ("mini", "standard") for claim in claims_of(size)]
    asked += [one.figures for name in studies() for one in load_study(name).claims]
    for figures in asked:
        assert re.fullmatch(r"((F1|recall) )?\d+\.\d+ and \d+\.\d+( N m| hPa)?|\w+, no number", figures), figures


def test_the_command_prints_every_claim(vsfsim, tmp_path):
    found = vsfsim("claims", cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    asked = claims_of() + [a for name in studies() for a in load_study(name).claims]
    assert f"{len(asked)} claims" in found.stdout
    wrong = vsfsim("claims", "--preset", "best", cwd=tmp_path)
    assert wrong.returncode == 2 and "--preset is 'best'" in wrong.stderr
