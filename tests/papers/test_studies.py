"""Studies: their files, their tables beside known results, and their claims."""

import dataclasses
from pathlib import Path

import pytest
from texts import text

from papers import claims, report
from papers import results as stored_results
from papers.decide import FAILS, HOLDS, UNTOLD
from papers.results import Found
from papers.study import load_study, parse_study, studies
from vsfsim.bench.commands.catalogue import preset
from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task
from vsfsim.core.errors import TaskError

TASK = "fewshot-shoes-v3-mini-v1"


@pytest.fixture
def study():
    return parse_study(text("study"), Path("toy.toml"))


def result(values, shot="0"):
    """A result whose objects have these ratios to zero."""
    names = [f"shoes-v3-mini-{k:04d}-v0" for k in range(len(values))]
    one = [1] * len(values)
    return Result(task=TASK, task_sha256="", dataset_sha256="", dataset_made_by={}, method="sbml", entry="",
                  parameters={}, observation="normal-force", unit="N", shots=(shot,), seeds=(0,), scores={},
                  queries={"object": names, "shot": [shot] * len(names), "seed": [0] * len(names), "touch": one,
                           "n": one, "sse": [v**2 for v in values]},
                  timing={}, peak_memory_mib=0.0, machine={}, made_by={}, versions={},
                  readings={"object": names, "touch": one, "n": one, "ss": [1.0] * len(values)})


def found(study, **values):
    protocol = load_task(TASK).protocol
    of = {v.name: v for v in study.variants}
    return {name: Found(of[name], result(given), Path(f"{name}.json"), protocol)
            for name, given in values.items()}


LEVEL = [0.5, 0.9, 0.7, 1.2]


def test_a_table_shows_values_and_paired_differences(study):
    more = [v + 0.1 + 0.01 * k for k, v in enumerate(LEVEL)]
    page = report.text(study, found(study, all=LEVEL, half=more))
    assert "0.825 ± 0.149" in page and "+0.115 ± 0.006 *" in page and "2.00 ± 0.10" in page
    table = report.table(study, found(study, all=LEVEL, half=more))
    assert table["variants"][1]["difference"]["0"]["mean"] == pytest.approx(0.115)
    lacking = report.text(study, found(study, all=LEVEL))
    assert "missing: half; `vsfsim papers study toy` makes them" in lacking


@pytest.mark.parametrize(("more", "answer"), [(0.1, HOLDS), (-0.1, FAILS), (None, UNTOLD)])
def test_claims_are_decided_by_the_variants(study, more, answer, monkeypatch):
    values = {"all": LEVEL} if more is None else {"all": LEVEL, "half": [v + more + 0.001 * k for k, v in
                                                                         enumerate(LEVEL)]}
    monkeypatch.setattr(claims, "stored", lambda *_: found(study, **values))
    (verdict,) = claims.all_verdicts([study])
    assert verdict.answers.direction == answer and "vsfsim papers study toy" in str(verdict.rows)


def test_the_same_evaluation_has_one_file_in_all_studies(study):
    every, half = study.variants
    other = parse_study(text("study", ("A toy", "Another")), Path("other.toml"))
    assert study.stem(half) == other.stem(half) and study.stem(half).startswith("sbml.tuned-")
    assert study.stem(half) != study.stem(dataclasses.replace(half, share_of_touches=0.5))
    assert study.is_row(every) and not study.is_row(half)


@pytest.mark.parametrize("name", list(studies()))
def test_a_shipped_study_asks_what_there_is(name):
    study = load_study(name)
    task = load_task(study.task)
    for variant in study.variants:
        assert preset(variant.method, variant.preset, task.observation.name).method == variant.method
        for pool in variant.extra:
            assert study.wanted(pool.data).objects >= pool.objects
        labels = study.task_of(variant).protocol.labels if not study.is_row(variant) else task.protocol.labels
        assert all(shot in labels for one in study.claims for side, shot in (one.better, one.worse)
                   if side == variant.name)
    stems = [study.stem(v) for v in study.variants if not study.is_row(v)]
    assert len(set(stems)) == len(stems)


def test_a_damaged_result_is_named(study, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    half = study.variants[1]
    path = tmp_path / "results" / "studies" / TASK / f"{study.stem(half)}.json"
    path.parent.mkdir(parents=True)
    path.write_text("{")
    with pytest.raises(TaskError, match=path.name):
        stored_results.stored(study)


def test_the_command_lists_and_refuses(vsfsim, tmp_path):
    listed = vsfsim("papers", "study", cwd=tmp_path)
    assert listed.returncode == 0 and all(name in listed.stdout for name in studies())
    unknown = vsfsim("papers", "study", "shoes-bredth", cwd=tmp_path)
    assert unknown.returncode == 2 and "shoes-breadth" in unknown.stderr
    # Another number of touches than any that ships: a result that is stored later cannot answer it.
    own = studies()["shoes-views"].read_text().replace("touches = 10", "touches = 12")
    (tmp_path / "mine.toml").write_text(own)
    missing = vsfsim("papers", "study", "mine.toml", cwd=tmp_path)
    assert missing.returncode == 2
    assert "vsfsim generate shoes-v3-mini --objects 12 --views 8 --touches 12" in missing.stderr
