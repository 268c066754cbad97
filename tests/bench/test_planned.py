"""A query shows the planned touch: where the robot left its plan tells the reading, and must not be seen."""

import dataclasses
import re

import numpy as np
import pytest

from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import as_planned, divide, record, share_unresolved
from vsfsim.bench.task import load_task, parse_task
from vsfsim.core.chain import Chain
from vsfsim.core.errors import TaskError
from vsfsim.core.shelf import find_task, tasks
from vsfsim.data.recipe import text_sha256

LIMIT = 4.0  # N: about half of the mock's touches meet it


def cut(touch):
    """The touch of a robot that stops where the force passes the limit, beside its plan."""
    over = np.flatnonzero(np.linalg.norm(touch.force, axis=1) > LIMIT)
    n = int(over[0]) if len(over) else len(touch.time)
    short = {f.name: getattr(touch, f.name)[:n] for f in dataclasses.fields(touch)
             if isinstance(getattr(touch, f.name), np.ndarray) and len(getattr(touch, f.name)) == len(touch.time)}
    return dataclasses.replace(touch, **short, audit={k: v[:n] for k, v in touch.audit.items()},
                               planned_time=touch.time, planned_pose=touch.mount_pose, planned_frame=np.arange(n))


@pytest.fixture(scope="module")
def views():
    made = [mock_view(i, touches=40) for i in range(8)]
    return [dataclasses.replace(v, touches=tuple(cut(t) for t in v.touches)) for v in made]


def test_the_length_of_the_path_tells_the_reading_and_that_of_the_plan_does_not(views, task):
    recordings = [record(view, task) for view in views]
    lengths = {len(r.action.time) for one in recordings for r in one.readings}
    assert len(lengths) > 3, "the path that was taken ends where the limit was met"
    assert {len(q.action.time) for one in recordings for q in one.queries} == {max(lengths)}


def test_only_frames_made_as_planned_are_scored(views, task):
    touch = views[0].touches[int(np.argmin([len(t.time) for t in views[0].touches]))]
    astray = dataclasses.replace(touch, planned_frame=np.where(np.arange(len(touch.time)) < 3, touch.planned_frame, -1))
    view = dataclasses.replace(views[0], touches=(astray, *views[0].touches[1:]))
    query = record(view, task).queries[0]
    assert as_planned(astray).sum() == 3 and np.flatnonzero(query.scored).tolist() == [0, 1, 2]
    assert np.isnan(query.clean[3:]).all() and len(query.action.time) == len(touch.planned_time)
    never = dataclasses.replace(touch, planned_frame=np.full(len(touch.time), -1))
    view = dataclasses.replace(view, touches=(never, *views[0].touches[1:]))
    draw = divide(view, task.protocol)
    assert 0 not in draw.query and 0 not in draw.pool, "a touch without such a frame cannot be a query"


def test_an_arm_without_its_plan_is_refused_where_objects_are_cross_validated(task):
    upright = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    arm = Chain(upright, ((0.0, 0.0, 0.2),), ((1.0, 0.0, 0.0, 0.0),), (0,), ())
    view = dataclasses.replace(mock_view(0), probe=arm)
    protocol = dataclasses.replace(task.protocol, folds=2, draws=3, trainings=1, seeds=0)
    folded = dataclasses.replace(task, protocol=protocol)
    with pytest.raises(TaskError, match=r"does not keep the planned paths .* plan = true in \[touches\]"):
        record(view, folded)
    assert record(view, task).queries, "older tasks go on"


def test_frames_that_the_mesh_does_not_resolve_are_left_out_unless_the_task_says_scored(task_text, views):
    """Of a straight touch, of one that leaves its plan, and of one without a resolved frame, which is no query."""
    scored = parse_task(task_text.replace("protocol = {", 'protocol = { unresolved = "scored",'), "toy-v1.toml")
    task = parse_task(task_text, "toy-v1.toml")
    assert task.sha256 != scored.sha256
    assert (task.protocol.unresolved, scored.protocol.unresolved) == ("left out", "scored")

    def odd(touch, none):
        good = np.arange(len(touch.time)) % 3 != 1
        return dataclasses.replace(touch, resolved=good & (not none))

    for touches in (views[0].touches, mock_view(0, touches=40).touches):
        view = dataclasses.replace(views[0], touches=tuple(odd(t, k == 0) for k, t in enumerate(touches)))
        queries, asked = record(view, task).queries, record(view, scored).queries
        for k, (query, of, touch) in enumerate(zip(queries, asked, view.touches, strict=True)):
            made = np.arange(len(touch.time)) % 3 != 1
            assert of.scored[:len(made)].all() and np.array_equal(query.scored[:len(made)], made & (k > 0))
        for protocol, usable in ((task.protocol, 39), (scored.protocol, 40)):
            draw = divide(view, protocol)
            assert len(draw.query) + len(draw.pool) == usable
    known = [(float(f @ f), not good) for t in view.touches for f, good in zip(t.force, t.resolved) if f.any()]
    share = sum(size for size, odd in known if odd) / sum(size for size, _ in known)
    assert share_unresolved(view.touches) == (len(known), sum(odd for _, odd in known), pytest.approx(share))


def test_tasks_that_were_released_before_score_every_frame_and_keep_their_sha256():
    new = {"fewshot-plants-v5-mini-v1", "palpation-mini-v1", "real-palpation-v1"}
    assert {name for name in tasks() if load_task(name).protocol.unresolved == "left out"} == new
    for name in set(tasks()) - new:
        text = re.sub(r"(?m)^unresolved *=.*\n", "", find_task(name).read_text())
        assert load_task(name).sha256 == text_sha256(text)
