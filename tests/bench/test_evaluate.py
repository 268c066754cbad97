"""The harness itself: an oracle scores exactly 0, a constant scores what the formulas give, draws are reproducible."""

import dataclasses
import json

import numpy as np
import pytest
import toy_methods

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import divide, record, specimen, support
from vsfsim.core.errors import TaskError


@pytest.fixture(scope="module")
def oracle(task, toy_dataset, toy_views, tmp_path_factory):
    """The result of an oracle, and what each of its trials was given."""
    folder = tmp_path_factory.mktemp("oracle")
    np.savez(folder / "answers.npz", **{toy_methods.name_of(touch.mount_pose): -(touch.force @ touch.axis)[:, None]
                                        for view in toy_views[1:] for touch in view.touches})
    result = evaluate("toy_methods:Oracle", task, toy_dataset, parameters={"folder": str(folder)}, check=False)
    return result, [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]


def test_an_oracle_scores_exactly_zero(oracle):
    for label in ("0", "1", "5", "all"):
        assert (oracle[0].scores["rmse"][label].mean, oracle[0].scores["rmse"][label].std) == (0.0, 0.0)


def query_errors(task, toy_views):
    """The errors of answering 2 to each query touch, an array a touch."""
    return [np.abs([2.0 + float(f @ touch.axis) for f in touch.force]) for view in toy_views[1:]
            for touch in (view.touches[i] for i in divide(view, task.protocol).query)]


def test_a_constant_scores_what_a_hand_computes(task, toy_dataset, toy_views):
    constant = evaluate("toy_methods:Constant", task, toy_dataset, parameters={"value": 2.0})
    want = np.mean([np.sqrt(np.mean(e**2)) for e in query_errors(task, toy_views)])
    for label in constant.shots:
        assert constant.scores["rmse"][label].mean == pytest.approx(want, rel=1e-12), label
        assert constant.scores["rmse"][label].std == pytest.approx(0.0, abs=1e-12)
    assert constant.parameters == {"value": 2.0}
    assert len(constant.queries["n"]) == 2 * 4 * 4 * 3  # objects x query touches x shots x seeds


def test_support_and_query_never_meet_and_the_query_never_changes(toy_views, oracle):
    adapted, asked = oracle[1][0::2], oracle[1][1::2]
    by_object = {}
    for chosen, query in zip(adapted, asked, strict=True):
        assert not set(chosen) & set(query)
        assert len(set(chosen)) == len(chosen), "drawn with replacement"
        owner = next(v.name for v in toy_views for t in v.touches if toy_methods.name_of(t.mount_pose) == query[0])
        by_object.setdefault(owner, set()).add(tuple(query))
    assert [len(queries) for queries in by_object.values()] == [1, 1]
    assert sorted({len(chosen) for chosen in adapted}) == [0, 1, 5, 8]
    assert len({tuple(chosen) for chosen in adapted if len(chosen) == 5}) == 2 * 3, "one draw an object and seed"


def test_draws_are_set_by_the_seed_and_nested(task, toy_views):
    view, protocol = toy_views[1], task.protocol
    draw = divide(view, protocol)
    assert draw == divide(view, protocol)
    assert sorted((*draw.query, *draw.pool)) == list(range(12)) and len(draw.query) == 4
    one, five = (support(view, draw, label, 0, protocol) for label in ("1", "5"))
    assert five[:1] == one and set(five) <= set(draw.pool)
    assert five == support(view, draw, "5", 0, protocol)
    assert len({support(view, draw, "5", seed, protocol) for seed in range(20)}) > 10
    assert divide(view, dataclasses.replace(protocol, seed=1)) != draw
    other = dataclasses.replace(view, object_index=7)
    assert divide(other, protocol) != draw


def test_methods_receive_noise_and_scores_use_noise_free_readings(task, toy_views):
    recording = record(toy_views[1], task)
    noise = np.concatenate([(r.value - c).ravel() for r, c in zip(recording.readings, recording.clean)])
    # White noise of 0.15 N, tared with the mean of two frames: variance 0.15^2 (1 + 1/2); the offset of 0.5 N is gone.
    assert np.std(noise) == pytest.approx(0.15 * np.sqrt(1.5), rel=0.15)
    again = record(toy_views[1], task)
    assert all(np.array_equal(a.value, b.value) for a, b in zip(recording.readings, again.readings))


def test_unconverged_frames_are_masked_and_unusable_touches_left_out(task, toy_views):
    view = toy_views[1]
    touches = list(view.touches)
    for index, bad in ((0, slice(4, 6)), (1, slice(None))):
        converged, force = touches[index].converged.copy(), touches[index].force.copy()
        converged[bad], force[bad] = False, np.nan
        touches[index] = dataclasses.replace(touches[index], converged=converged, force=force)
    view = dataclasses.replace(view, touches=tuple(touches))
    recording = record(view, task)
    assert list(np.flatnonzero(~recording.readings[0].valid)) == [4, 5]
    assert (np.isnan(recording.readings[0].value[4:6]).all()
            and np.isfinite(recording.readings[0].value[recording.readings[0].valid]).all())
    draw = divide(view, task.protocol)
    assert 1 not in draw.query and 1 not in draw.pool
    assert len(specimen(view, task).touches) == 11


def test_too_few_touches_are_refused(task, toy_views):
    view = dataclasses.replace(toy_views[1], touches=toy_views[1].touches[:8])
    with pytest.raises(TaskError, match=r"has 8 touches .* need 9"):
        divide(view, task.protocol)


def test_a_seeded_method_is_fitted_anew_for_every_seed(task, toy_dataset):
    result = evaluate("toy_methods:Seeded", task, toy_dataset, check=False)
    per_seed = result.scores["rmse"]["0"].per_seed
    assert len(set(per_seed)) == 3 and result.scores["rmse"]["0"].std > 0
