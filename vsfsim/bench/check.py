"""`vsfsim check`: whether a method keeps the contract of `vsfsim.bench.method.Method`, in seconds, on mock objects."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import pickle
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.method import (
    Action,
    Method,
    Reading,
    Specimen,
    build_method,
    checked_choice,
    checked_prediction,
    find_method,
    frozen,
    frozen_view,
    parameters_of,
    plain_parameters,
)
from vsfsim.bench.metric_functions import rmse, touch_errors
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import MethodError, VsfsimError
from vsfsim.data.records import ObjectView, View

MOCK_TASK = """
name = "mock-v1"
description = "A block of independent springs; every conforming method runs on it in seconds."
dataset = { folder = "mock", scene = "mock", seed = 0, objects = 3, views = 1, touches = 8 }
protocol = { shots = [0, 1, 5], seeds = 1, query = 3, seed = 0 }
observation = { kind = "normal-force" }
noise = { force_std = 0.01, offset_std = 0.05, drift_std = 0.0, tare_frames = 2, seed = 0 }
metrics = { primary = "rmse", ranking_shot = 5 }
"""


@dataclass(frozen=True)
class Finding:
    """What came of one clause of the contract."""

    clause: str
    """The clause."""
    outcome: str
    """"ok", "failed" or "not offered"."""
    detail: str = ""
    """What was observed."""


_Extra = Callable[[Method, "_Mock"], None]


@dataclass(frozen=True)
class _Mock:
    specimens: tuple[Specimen, ...]
    """Training objects."""
    view: View
    """Of the test object."""
    readings: tuple[Reading, ...]
    """Of the test object."""
    clean: tuple[np.ndarray, ...]
    """Their noise-free values (T, 1) [N]."""
    other: tuple[Reading, ...]
    """Of another test object."""

    @property
    def support(self) -> list[Reading]:
        return list(self.readings[:5])

    @property
    def actions(self) -> list[Action]:
        return [reading.action for reading in self.readings[5:]]


def check(name: str, *, parameters: Mapping[str, Any] | None = None, brief: bool = False) -> tuple[Finding, ...]:
    """Test every clause of the contract on mock objects.

    Args:
        name: an installed method, or module:attribute. parameters: of its constructor.
        brief: only the clauses that a few adaptations of one instance can test; `vsfsim evaluate` tests these first.

    Returns:
        One finding a clause; the method conforms if none of them failed.

    Raises:
        MethodError: the method is unknown or cannot be built at all.
    """
    factory = find_method(name)
    values = parameters_of(factory, parameters or {})
    mock, learned = _mock(), list[Method]()
    gap, untouched = _with_gap(mock.support), _digest(mock)
    build_method(factory, values)

    def learn() -> Method:
        method = build_method(factory, values)
        method.meta_fit(mock.specimens)
        return method

    def fitted() -> Method:
        """A copy of one instance that learned, where it can be copied; learning can take minutes."""
        if not learned:
            learned.append(learn())
        try:
            return learned[0] if brief else copy.deepcopy(learned[0])
        except Exception:  # of what a method holds, anything may refuse to be copied
            return learn()

    extras = (_stiffness_here, _predict_std_here, _choose_here) if brief else ()
    thorough: dict[str, Callable[[], str | None]] = {
        "adapts to touches and predicts (5-shot)": lambda: _run(fitted(), mock, mock.support),
        "adapt forgets the object before": lambda: _forgets(fitted, mock),
        "predict can be called twice": lambda: _twice(fitted(), mock),
        "what it learned can be handed to a trial": lambda: _handed_on(fitted(), build_method(factory, values), mock),
        "stiffness is finite and not negative": lambda: _adapted(fitted(), mock, _stiffness_here),
        "predict_std is finite and not negative": lambda: _adapted(fitted(), mock, _predict_std_here),
        "choose names one of the offered touches": lambda: _adapted(fitted(), mock, _choose_here)}
    clauses: dict[str, Callable[[], str | None]] = {
        "parameters are plain values": lambda: plain_parameters(values),
        "meta_fit learns from training objects": lambda: _nothing(fitted()),
        "predicts before any touch (0-shot)": lambda: _run(fitted(), mock, [], extras),
        "copes with frames that have no reading": lambda: _run(fitted(), mock, gap, extras),
        "is deterministic": lambda: _deterministic(fitted(), fitted() if brief else learn(), mock, gap),
        "refuses a reading that is not a number": lambda: _refuses_nan(fitted(), mock),
        **({} if brief else thorough),
        "leaves its input alone": lambda: _unchanged(mock, untouched)}
    out: list[Finding] = []
    for clause, test in clauses.items():
        out.append(_try(clause, test))
        if brief and out[-1].outcome == "failed":
            break  # the next clause would fail for the same reason
    return tuple(out)


def report(name: str, findings: Sequence[Finding]) -> str:
    """The findings for a terminal."""
    width = max(len(f.clause) for f in findings)
    lines = [f"{f.outcome:<12}{f.clause:<{width}}  {f.detail}".rstrip() for f in findings]
    failed = sum(f.outcome == "failed" for f in findings)
    lines.append(f"{name} conforms" if not failed
                 else f"{name} does not conform: {failed} of {len(findings)} clauses failed")
    return "\n".join(lines)


def table(name: str, findings: Sequence[Finding]) -> dict[str, Any]:
    """The findings for JSON."""
    return {"method": name, "conforms": all(f.outcome != "failed" for f in findings),
            "clauses": [dataclasses.asdict(f) for f in findings]}


class _NotOffered(Exception):
    pass


def _try(clause: str, test: Callable[[], str | None]) -> Finding:
    try:
        return Finding(clause, "ok", test() or "")
    except _NotOffered as reason:
        return Finding(clause, "not offered", str(reason))
    except VsfsimError as error:
        return Finding(clause, "failed", str(error))
    except (Exception, SystemExit) as error:  # a method may raise anything, which is a finding
        return Finding(clause, "failed", f"{type(error).__name__}: {error}")


def _mock() -> _Mock:
    task = parse_task(MOCK_TASK, "mock task")
    test, other = mock_view(2), mock_view(3, stiffness=4.0)
    recording = record(test, task)
    train: list[ObjectView] = [mock_view(i, split="train") for i in range(2)]
    return _Mock(tuple(specimen(view, task) for view in train), frozen_view(test.view), recording.readings,
                 recording.clean, record(other, task).readings)


def _answer(method: Method, mock: _Mock, support: Sequence[Reading]) -> list[np.ndarray]:
    method.adapt(mock.view, list(support))
    return _predict(method, mock)


def _predict(method: Method, mock: _Mock) -> list[np.ndarray]:
    names = [f"mock touch {i}" for i in range(5, 5 + len(mock.actions))]
    return checked_prediction(method.predict(mock.actions), mock.actions, names)


def _same(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(a, b))


def _nothing(_: object) -> None:
    return None


def _run(method: Method, mock: _Mock, support: Sequence[Reading], extras: Sequence[_Extra] = ()) -> str:
    answer = _answer(method, mock, support)
    checked_prediction(method.predict([]), [], [])
    for extra in extras:
        with contextlib.suppress(_NotOffered):
            extra(method, mock)
    rows = [touch_errors(p, y, r.valid) for p, y, r in zip(answer, mock.clean[5:], mock.readings[5:])]
    zero = [touch_errors(np.zeros_like(y), y, r.valid) for y, r in zip(mock.clean[5:], mock.readings[5:])]
    return f"rmse {rmse(rows):.3f} N (always answering 0: {rmse(zero):.3f} N)"


def _deterministic(one: Method, other: Method, mock: _Mock, support: Sequence[Reading]) -> None:
    if not _same(_answer(one, mock, support), _answer(other, mock, support)):
        raise MethodError("the same touches gave another answer the second time. Draw random numbers from a generator "
                          "with a fixed seed, or take a constructor argument `seed`, and begin every adapt with what "
                          "meta_fit learned.")


def _unchanged(mock: _Mock, before: str) -> None:
    if _digest(mock) != before:
        raise MethodError("the arrays it was given have changed. Work on copies.")


def _forgets(fitted: Callable[[], Method], mock: _Mock) -> None:
    straight = _answer(fitted(), mock, mock.support)
    method = fitted()
    method.adapt(mock.view, list(mock.other))
    if not _same(_answer(method, mock, mock.support), straight):
        raise MethodError("after adapting to another object first, the answer is another one. adapt must start from "
                          "what meta_fit learned.")


def _twice(method: Method, mock: _Mock) -> None:
    first = _answer(method, mock, mock.support)
    if not _same(first, _predict(method, mock)):
        raise MethodError("the second call of predict answers differently. predict must not change the method.")


def _with_gap(support: Sequence[Reading]) -> list[Reading]:
    out = []
    for reading in support:
        value, valid = np.array(reading.value), np.array(reading.valid)
        value[4], valid[4] = np.nan, False
        out.append(dataclasses.replace(reading, value=frozen(value), valid=frozen(valid)))
    return out


def _refuses_nan(method: Method, mock: _Mock) -> None:
    value = np.array(mock.readings[0].value)
    value[3] = np.nan
    support = [dataclasses.replace(mock.readings[0], value=frozen(value)), *mock.readings[1:5]]
    try:
        method.adapt(mock.view, support)
    except (VsfsimError, ValueError):
        return
    raise MethodError("a NaN in a frame marked valid was accepted by adapt. Raise MethodError (or ValueError) that "
                      "names the touch.")


def _handed_on(method: Method, fresh: Any, mock: _Mock) -> str:
    """By save and load if there are any, and by pickle."""
    copies = {}
    try:
        copies["an unpickled method"] = pickle.loads(pickle.dumps(method))
    except Exception as error:  # of what a method holds, anything may refuse to be pickled
        if not hasattr(method, "save") or not hasattr(method, "load"):
            raise MethodError(f"it cannot be pickled ({error}) and has no save() and load(). Give it both: what it "
                              f"learned reaches its trials by one of them.") from error
    straight = _answer(method, mock, mock.support)
    if hasattr(method, "save") and hasattr(method, "load"):
        with tempfile.TemporaryDirectory() as folder:
            method.save(Path(folder))
            fresh.load(Path(folder))
        copies["a loaded method"] = fresh
    for what, again in copies.items():
        if not _same(_answer(again, mock, mock.support), straight):
            raise MethodError(f"{what} answers differently from the one that learned. What it learned must belong to "
                              f"the object.")
    return " and ".join(copies)


def _adapted(method: Method, mock: _Mock, here: _Extra) -> None:
    """Test an optional function without a touch and after some."""
    for support in ([], mock.support):
        method.adapt(mock.view, support)
        here(method, mock)


def _stiffness_here(method: Method, mock: _Mock) -> None:
    if not hasattr(method, "stiffness"):
        raise _NotOffered("no stiffness()")
    estimate = method.stiffness(np.array([[-0.02, 0.0, 0.03], [0.0, 0.0, 0.03], [0.02, 0.01, 0.03]]))
    for key in ("mean", "std"):
        given = getattr(estimate, key, None)
        try:
            values = np.asarray(given, float)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if given is None or values.shape != (3,) or not np.isfinite(values).all() or (values < 0).any():
            raise MethodError(f"stiffness of 3 points has {key} {given!r}; it must return an Estimate with 3 finite "
                              f"numbers >= 0.")


def _predict_std_here(method: Method, mock: _Mock) -> None:
    if not hasattr(method, "predict_std"):
        raise _NotOffered("no predict_std()")
    spread = checked_prediction(method.predict_std(mock.actions), mock.actions,
                                [f"touch {i} (predict_std)" for i in range(len(mock.actions))])
    if any((std < 0.0).any() for std in spread):
        raise MethodError("predict_std gave a negative standard deviation; it must be 0 or greater.")


def _choose_here(method: Method, mock: _Mock) -> None:
    if not hasattr(method, "choose"):
        raise _NotOffered("no choose()")
    checked_choice(method.choose(mock.view, mock.support, mock.actions), len(mock.actions))


def _digest(mock: _Mock) -> str:
    out = hashlib.sha256()

    def add(item: Any) -> None:
        if dataclasses.is_dataclass(item):
            for f in dataclasses.fields(item):
                add(getattr(item, f.name))
        elif isinstance(item, np.ndarray):
            out.update(item.tobytes())
        elif isinstance(item, (tuple, list)):
            for part in item:
                add(part)

    add(mock)
    return out.hexdigest()
