"""Comparisons of methods: areas, errors over objects and runs, ranks. The errors are held against a bootstrap, and the
intervals against truths that are known."""

import dataclasses
import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from vsfsim.bench.board.compare import LEVEL, by_object, by_run, holm, interval, paired, ranks, shares, wins
from vsfsim.bench.result_file import as_rows
from vsfsim.bench.task import load_task


def of(values):
    """Values (objects, trainings, draws), or of objects alone, by the names of objects."""
    values = np.asarray(values, float)
    return {f"o{k}": one.reshape(1, 1) if one.ndim == 0 else one for k, one in enumerate(values)}


def drawn(rng, objects, trainings, draws, *, sizes=(0.5, 0.3, 0.3, 0.3)):
    """A difference whose mean is zero: deviations of objects, trainings, draws, and of each value."""
    o, t, d, each = sizes
    return (o * rng.standard_normal((objects, 1, 1)) + t * rng.standard_normal((1, trainings, 1))
            + d * rng.standard_normal((1, 1, draws)) + each * rng.standard_normal((objects, trainings, draws)))


def test_the_error_is_the_sum_of_three_bootstraps():
    """Of objects, of trainings and of draws, each with one fewer than there are."""
    values = drawn(np.random.default_rng(1), 12, 3, 4)
    rng, spread = np.random.default_rng(2), 0.0
    for axis, count in enumerate(values.shape):
        mean = np.moveaxis(values, axis, 0).reshape(count, -1).mean(axis=1)
        spread += mean[rng.integers(0, count, (200_000, count - 1))].mean(axis=1).var()
    assert paired(of(values), of(np.zeros((12, 1, 1)))).error == pytest.approx(math.sqrt(spread), rel=0.01)


@pytest.mark.parametrize("shape", [(12, 3, 4), (40, 3, 4), (50, 3, 1)])
def test_intervals_cover_over_objects_trainings_and_draws(shape):
    """At least nine in ten intervals of 95 % hold the truth, where three trainings decide and where they add nothing;
    400 seeds tell the share within 2.2 %. What one draw alone adds cannot be known, so that it adds nothing here."""
    for o, t, d, each in ((0.5, 0.1, 0.1, 0.5), (0.5, 0.3, 0.3, 0.3), (0.2, 0.5, 0.0, 0.2)):
        rng, sizes = np.random.default_rng(3), (o, t, d * (shape[2] > 1), each)
        found = [paired(of(drawn(rng, *shape, sizes=sizes)), of(np.zeros((shape[0], 1, 1)))) for _ in range(400)]
        inside = np.mean([abs(one.mean) <= one.half_width for one in found])
        assert 0.9 <= inside <= 0.995, (sizes, inside)
        assert np.mean([one.told_apart for one in found]) == pytest.approx(1.0 - inside)


def test_objects_alone_give_the_t_test_of_pairs():
    rng = np.random.default_rng(0)
    one, other = rng.uniform(0.3, 1.5, (2, 9))
    known, found = stats.ttest_rel(one, other), paired(of(one), of(other))
    assert (found.chance(), found.freedom) == (pytest.approx(known.pvalue), pytest.approx(8.0))
    low, high = known.confidence_interval(0.95)
    assert (found.mean - found.half_width, found.mean + found.half_width) == (pytest.approx(low), pytest.approx(high))
    assert found.chance(0.2) == pytest.approx(stats.ttest_rel(one, other + 0.2).pvalue)
    assert found.level == pytest.approx(other.mean()) and math.isnan(paired(of([1.0]), of([0.0])).error)
    assert not paired(of([2.0, 3.0]), of([1.0, 2.0])).told_apart, "two objects tell nothing"
    assert paired(of([2.0, 3.0, 4.0]), of([1.0, 2.0, 3.0])).told_apart, "a difference that is always the same"
    assert paired(of([2.0]), {}).objects == 0


def test_draws_are_paired_and_a_method_without_trainings_meets_each_of_the_other():
    rng = np.random.default_rng(4)
    draw = rng.standard_normal((1, 1, 4))  # the same support sets for both
    one, other = 0.3 + draw + np.zeros((8, 3, 1)), draw + np.zeros((8, 1, 1))
    found = paired(of(one), of(other))
    assert found.error == pytest.approx(0.0, abs=1e-12) and found.told_apart and found.mean == pytest.approx(0.3)
    assert paired(of(one), of(other.mean(axis=2, keepdims=True))).error > 0.1, "a mean alone has no draws to pair"


def differ(values):
    """All pairs that differ by the rule of the page, by their places."""
    pairs = list(itertools.combinations(range(len(values)), 2))
    chance = holm([paired(of(values[i]), of(values[k])).chance() for i, k in pairs])
    return {pair for pair, p in zip(pairs, chance, strict=True) if p <= LEVEL}


@pytest.mark.parametrize("seed", range(8))
def test_no_two_rows_of_a_rank_differ_by_the_rule_of_the_page(seed):
    rng = np.random.default_rng(seed)
    level = rng.uniform(0.3, 1.5, 12)
    values = sorted((level + step + 0.05 * rng.standard_normal(12) for step in rng.uniform(0.0, 0.4, 7)), key=np.mean)
    found, apart = ranks([of(v) for v in values]), differ(values)
    assert found[0] == 1 and found == sorted(found) and apart
    for i, k in itertools.combinations(range(7), 2):
        assert found[i] != found[k] or (i, k) not in apart
    for k in range(1, 7):  # a rank begins where a row differs from one of the rank before
        begins = found[k] != found[k - 1]
        assert begins == any((i, k) in apart for i in range(found[k - 1] - 1, k)) and (not begins or found[k] == k + 1)


def test_ranks_are_corrected_for_the_number_of_pairs():
    """Two methods that differ by themselves are a tie among twenty others."""
    rng = np.random.default_rng(5)
    one = rng.uniform(0.3, 1.5, 10)
    other = one + 0.02 + 0.025 * (-1.0) ** np.arange(10)
    assert 0.001 < paired(of(one), of(other)).chance() < LEVEL and ranks([of(one), of(other)]) == [1, 2]
    crowd = [of(one + 0.01 * rng.standard_normal(10) + 0.002 * k) for k in range(20)]
    assert ranks([of(one), of(other), *crowd])[:2] == [1, 1]
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06]) and holm([]) == []


def test_wins_are_shares_of_objects_and_other_rows():
    a, b, c = of([0.1, 0.2, 0.9]), of([0.2, 0.3, 0.4]), of([0.2, 0.1, 0.5])
    assert wins([a, b, c]) == pytest.approx([3.0 / 6.0, (1 + 0.5 + 1) / 6.0, (0.5 + 2 + 1) / 6.0])
    assert wins([a, b, c], sign=-1.0) == pytest.approx([1.0 - w for w in wins([a, b, c])])
    assert math.isnan(wins([a])[0])


def test_every_doubling_of_the_touches_counts_alike():
    """Of 100 shoes: 28 touches less 8 queries; a curve that falls in proportion to the doublings has the area of its
    middle; of a transfer, half of the touches are queries."""
    task = load_task("fewshot-shoes-v3-v1")
    found, at = shares(task), np.log2(1.0 + np.array([0, 1, 5, 10, 20]))
    assert list(found) == ["0", "1", "5", "10", "all"] and sum(found.values()) == pytest.approx(1.0)
    assert sum(share * (1.0 - x / at[-1]) for share, x in zip(found.values(), at, strict=True)) == pytest.approx(0.5)
    fewer = shares(dataclasses.replace(task, protocol=dataclasses.replace(task.protocol, shots=(0, 20))))
    assert fewer == pytest.approx({"0": 0.5, "20": 0.5, "all": 0.0}), "20 are all"
    assert shares(load_task("transfer-shoes-mini-v1"))["all"] == pytest.approx(0.5 * math.log2(8 / 6) / 3.0)
    assert shares(load_task("rope-punyo-v1")) == {"20": 0.5, "all": 0.5}


def test_a_value_is_of_its_shot_alone_and_a_missing_one_is_left_out():
    columns = {"object": ["a-v0", "a-v0", "a-v1", "a-v0", "b-v0"], "shot": ["5", "5", "5", "all", "5"],
               "seed": [0, 1, 0, 0, 0], "mask_f1": [0.2, None, 0.4, 0.9, None]}
    result = SimpleNamespace(values={}, rows_of=lambda _: as_rows(columns), seeds=(0, 1))
    assert by_run(result, "mask_f1", "5")["a"][:, 0] == pytest.approx([0.3, math.nan], nan_ok=True)
    assert by_object(result, "mask_f1", "5") == {"a": pytest.approx(0.3)}
    assert by_object(result, "mask_f1", "all") == {"a": 0.9} and by_object(result, "mask_f1", "0") == {}
    kept = SimpleNamespace(values={"mask_f1": {"5": {"a": [0.1, 0.2, 0.3, 0.6]}, "all": {"a": 0.5}}})
    assert by_run(kept, "mask_f1", "5", 2)["a"].shape == (2, 2)
    assert by_run(kept, "mask_f1", "all", 2)["a"].shape == (1, 1), "a row that holds the mean alone"
    assert interval(by_run(kept, "mask_f1", "5", 2)).mean == pytest.approx(0.3)
