"""Studies: their files, their tables beside known results, and their claims."""

import dataclasses
from pathlib import Path

import pytest
from texts import changed, text

from papers import claims, report, worlds
from papers import results as stored_results
from papers.decide import FAILS, HOLDS, UNTOLD, answers
from papers.results import Found
from papers.study import load_study, parse_study, studies
from vsfsim.bench.commands.catalogue import preset
from vsfsim.bench.result import Result
from vsfsim.bench.task import load_task
from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import scenes

TASK = "fewshot-shoes-v2-mini-v3"
@pytest.fixture
def study():
    return parse_study(text("study"), Path("toy.toml"))


def result(values, shot="0"):
    """A result whose objects have these ratios to zero."""
    names = [f"shoes-v2-mini-{k:04d}-v0" for k in range(len(values))]
    one = [1] * len(values)
    return Result(task=TASK, task_sha256="", dataset_sha256="", dataset_made_by={}, method="sbml", entry="",
                  parameters={}, observation="normal-force", unit="N", shots=(shot,), seeds=(0,), scores={},
                  queries={"object": names, "shot": [shot] * len(names), "seed": [0] * len(names), "touch": one,
                           "n": one, "sse": [v**2 for v in values], "sae": list(values)},
                  timing={}, peak_memory_mib=0.0, machine={}, made_by={}, versions={},
                  readings={"object": names, "touch": one, "n": one, "ss": [1.0] * len(values)})


def found(study, **values):
    protocol = load_task(TASK).protocol
    return {name: Found(study.variant(name), result(given), Path(f"{name}.json"), protocol)
            for name, given in values.items()}


LEVEL = [0.5, 0.9, 0.7, 1.2]


def test_a_table_shows_values_and_paired_differences(study):
    more = [v + 0.1 + 0.01 * k for k, v in enumerate(LEVEL)]
    page = report.text(study, "mini", found(study, all=LEVEL, half=more))
    assert "0.825 ± 0.149" in page and "+0.115 ± 0.006 *" in page and "2.00 ± 0.10" in page
    table = report.table(study, "mini", found(study, all=LEVEL, half=more))
    assert table["variants"][1]["difference"]["0"]["mean"] == pytest.approx(0.115)
    lacking = report.text(study, "mini", found(study, all=LEVEL))
    assert "missing: half; `vsfsim papers study toy --size mini` makes them" in lacking


def test_only_a_class_of_objects_counts(study):
    boots = dataclasses.replace(study.variant("all"), only="boot")
    counted = stored_results._counted(study, boots, study.task_of(boots, "mini"))
    assert counted == {f"shoes-v2-mini-{k:04d}" for k in (0, 4, 8)}
    one = Found(boots, result(LEVEL), Path("all.json"), study.task_of(boots, "mini").protocol, counted)
    assert one.values("rmse_ratio", "0") == {"shoes-v2-mini-0000": pytest.approx(0.5)}


@pytest.mark.parametrize(("more", "answer"), [(0.1, HOLDS), (-0.1, FAILS), (None, UNTOLD)])
def test_claims_are_decided_by_the_variants(study, more, answer, monkeypatch):
    values = {"all": LEVEL} if more is None else {"all": LEVEL, "half": [v + more + 0.001 * k for k, v in
                                                                         enumerate(LEVEL)]}
    monkeypatch.setattr(claims, "stored", lambda *_: found(study, **values))
    (verdict,) = claims.verdicts([study], "mini")
    assert answers([verdict.question])[0].direction == answer
    assert "vsfsim papers study toy --size mini" in verdict.command


def test_the_same_evaluation_has_one_file_in_all_studies(study):
    half, every = study.variant("half"), study.variant("all")
    other = parse_study(text("study", ("A toy", "Another")), Path("other.toml"))
    assert study.stem(half) == other.stem(half) and study.stem(half).startswith("sbml.tuned-")
    assert study.stem(half) != study.stem(dataclasses.replace(half, share_of_touches=0.5))
    assert study.is_row(every) and not study.is_row(half)
    folds = parse_study(text("study", ('"A toy"', '"A toy"\nfolds = 3')), Path("toy.toml"))
    assert folds.task_of(half, "mini").protocol.folds == 3 and folds.stem(half) != study.stem(half)


def test_folds_of_a_task_without_cross_validation_need_trainings_and_draws():
    """Without them nothing would be evaluated, and a mean of nothing be asked for."""
    asked = text("study", (TASK, "localization-mini-v3"), ('"A toy"', '"A toy"\nfolds = 4'))
    study = parse_study(asked, Path("toy.toml"))
    with pytest.raises(TaskError, match="localization-mini-v3 for 0 trainings and 0 draws"):
        study.task_of(study.variant("all"), "mini")
    study = parse_study(changed(asked, ("folds = 4", "folds = 4\ntrainings = 1\ndraws = 2")), Path("toy.toml"))
    assert study.task_of(study.variant("all"), "mini").protocol.runs(seeded=True) == (0, 1)


@pytest.mark.parametrize("name", list(studies()))
def test_a_shipped_study_asks_what_there_is(name):
    study = load_study(name)
    models = {m for path in scenes().values() for m in stored_results.models_of(path.read_text())}
    assert set(study.class_of) <= models | set(worlds.CLASSES)
    for size in study.tasks or ("mini",):
        for variant in study.variants:
            task = study.task_of(variant, size)
            assert preset(variant.method, variant.preset, task.observation.name).method == variant.method
            assert study.stem(variant) and (not variant.only or variant.only in study.classes)
            for pool in variant.extra:
                assert study.wanted(pool.data, size, task).objects >= pool.first + pool.objects
            for asked in study.claims:
                for side, shot in (asked.better, asked.worse):
                    if side == variant.name and (name not in claims.PLAIN or size == "standard"):
                        assert shot in task.protocol.labels
    stems = [study.stem(v) for v in study.variants if not study.is_row(v)]
    assert len(set(stems)) == len(stems)


def test_the_blocks_of_the_worlds_differ_in_their_pictures_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("VSFSIM_DATASETS", str(tmp_path))
    monkeypatch.setattr(worlds, "_TASK", worlds._TASK.replace("24", "2").replace("touches = 23", "touches = 9"))
    told, blind, looks = (worlds.dataset(name) for name in ("springs", "springs-blind", "springs-looks"))
    assert [(a.view.rgb != b.view.rgb).any() for a, b in zip(told, blind)] == [False, True], "every second is reversed"
    colours = [{tuple(c) for c in one.view.rgb[one.view.mask]} for one in looks]
    assert all(len(found) == 2 for found in colours) and not colours[0] & colours[1], "each block has its own"
    for a, b in (*zip(told, blind), *zip(told, looks)):
        assert (a.truth.probe_stiffness == b.truth.probe_stiffness).all()


def test_a_damaged_result_is_named(study, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    half = study.variant("half")
    path = tmp_path / "results" / "studies" / study.task_of(half, "mini").name / f"{study.stem(half)}.json"
    path.parent.mkdir(parents=True)
    path.write_text("{")
    assert stored_results.stored(study, "standard", [half]) == {}, "the study has no task of this size"
    with pytest.raises(TaskError, match=path.name):
        stored_results.stored(study, "mini", [half])


def test_the_command_lists_and_refuses(vsfsim, tmp_path):
    listed = vsfsim("papers", "study", cwd=tmp_path)
    assert listed.returncode == 0 and all(name in listed.stdout for name in studies())
    unknown = vsfsim("papers", "study", "shoes-bredth", cwd=tmp_path)
    assert unknown.returncode == 2 and "shoes-breadth" in unknown.stderr
    # Another number of touches than any that ships: a result that is stored later cannot answer it.
    own = studies()["shoes-views"].read_text().replace("touches = 10", "touches = 11")
    (tmp_path / "mine.toml").write_text(own)
    missing = vsfsim("papers", "study", "mine.toml", cwd=tmp_path)
    assert missing.returncode == 2
    assert "vsfsim generate shoes-v2-mini --objects 12 --views 8 --touches 11" in missing.stderr
