"""`vsfsim check`: whether a method keeps the contract of `vsfsim.bench.method.Method`, in seconds, on mock objects."""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import hashlib
import json
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

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


def check(name: str, *, parameters: Mapping[str, Any] | None = None, brief: bool = False,
          before: Callable[[str], None] = lambda call: None) -> tuple[Finding, ...]:
    """Test every clause of the contract on mock objects.

    Args:
        name: an installed method, or module:attribute. parameters: of its constructor.
        brief: only the clauses that four adaptations of one instance can test; `vsfsim evaluate` tests these first.
        before: called with the name of each function of the method before it is called.

    Returns:
        One finding a clause; the method conforms if none of them failed.

    Raises:
        MethodError: the method is unknown or cannot be built at all.
    """
    factory = find_method(name)
    values = parameters_of(factory, parameters or {})
    mock = _mock()

    def learned() -> Method:
        before("its constructor")
        method = cast(Method, _Told(build_method(factory, values), before))
        method.meta_fit(mock.specimens)
        return method

    before("its constructor")
    build_method(factory, values)
    if brief:
        return _brief(learned, values, mock)
    first: list[Method] = []

    def fitted() -> Method:
        """A copy of one instance that learned, where it can be copied; learning can take minutes."""
        if not first:
            first.append(learned())
        try:
            return copy.deepcopy(first[0])
        except Exception:  # of what a method holds, anything may refuse to be copied
            return learned()

    clauses: tuple[tuple[str, Callable[[], str | None]], ...] = (
        ("parameters are plain values", lambda: _plain(values)),
        ("meta_fit learns from training objects", lambda: _nothing(fitted())),
        ("predicts before any touch (0-shot)", lambda: _run(fitted(), mock, [])),
        ("adapts to touches and predicts (5-shot)", lambda: _run(fitted(), mock, mock.support)),
        ("predicts an empty list of touches", lambda: _empty(fitted(), mock)),
        ("is deterministic", lambda: _deterministic(fitted(), learned(), mock)),
        ("adapt forgets the object before", lambda: _forgets(fitted, mock)),
        ("predict can be called twice", lambda: _twice(fitted(), mock)),
        ("leaves its input alone", lambda: _leaves_alone(build_method(factory, values), _mock())),
        ("copes with frames that have no reading", lambda: _run(fitted(), mock, _with_gap(mock.support))),
        ("refuses a reading that is not a number", lambda: _refuses_nan(fitted(), mock)),
        ("save and load keep what was learned",
         lambda: _save_load(fitted, lambda: build_method(factory, values), mock)),
        ("stiffness is finite and not negative", lambda: _adapted(fitted(), mock, _stiffness_here)),
        ("predict_std is finite and not negative", lambda: _adapted(fitted(), mock, _predict_std_here)),
        ("choose names one of the offered touches", lambda: _adapted(fitted(), mock, _choose_here)),
    )
    return tuple(_try(clause, test) for clause, test in clauses)


def _brief(learned: Callable[[], Method], values: Mapping[str, Any], mock: _Mock) -> tuple[Finding, ...]:
    """The clauses that need one instance and four adaptations of it."""
    before, instance, answers = _digest(mock), list[Method](), list[list[np.ndarray]]()
    gap = _with_gap(mock.support)

    def adapts(support: Sequence[Reading]) -> None:
        answers.append(_answer(instance[0], mock, support))
        checked_prediction(instance[0].predict([]), [], [])
        for extra in (_stiffness_here, _predict_std_here, _choose_here):
            with contextlib.suppress(_NotOffered):
                extra(instance[0], mock)

    def again() -> None:
        if not _same(_answer(instance[0], mock, gap), answers[-1]):
            raise MethodError("the same touches gave another answer the second time. Draw random numbers from a "
                              "generator with a fixed seed, and begin every adapt with what meta_fit learned.")

    def unchanged() -> None:
        if _digest(mock) != before:
            raise MethodError("the arrays it was given have changed. Work on copies.")

    clauses: tuple[tuple[str, Callable[[], object]], ...] = (
        ("parameters are plain values", lambda: _plain(values)),
        ("meta_fit learns from training objects", lambda: instance.append(learned())),
        ("predicts before any touch (0-shot)", lambda: adapts([])),
        ("copes with frames that have no reading", lambda: adapts(gap)),
        ("is deterministic", again),
        ("refuses a reading that is not a number", lambda: _refuses_nan(instance[0], mock)),
        ("leaves its input alone", unchanged),
    )
    out: list[Finding] = []
    for clause, test in clauses:
        out.append(_try(clause, lambda test=test: _nothing(test())))  # type: ignore[misc]
        if out[-1].outcome == "failed":
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


class _Told:
    """A method that says which of its functions is called next."""

    def __init__(self, method: Method, before: Callable[[str], None]):
        self._method, self._before = method, before

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # while a copy is made, which has nothing yet
            raise AttributeError(name)
        found = getattr(self._method, name)
        if callable(found):
            self._before(name)
        return found


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


def _plain(values: Mapping[str, Any]) -> None:
    try:
        json.dumps(dict(values), allow_nan=False)
    except (TypeError, ValueError) as error:
        raise MethodError(f"a parameter cannot be written into a result file: {error}. Use numbers, "
                          f"text, lists.") from error


def _run(method: Method, mock: _Mock, support: Sequence[Reading]) -> str:
    answer = _answer(method, mock, support)
    rows = [touch_errors(p, y, r.valid) for p, y, r in zip(answer, mock.clean[5:], mock.readings[5:])]
    zero = [touch_errors(np.zeros_like(y), y, r.valid) for y, r in zip(mock.clean[5:], mock.readings[5:])]
    return f"rmse {rmse(rows):.3f} N (always answering 0: {rmse(zero):.3f} N)"


def _empty(method: Method, mock: _Mock) -> None:
    method.adapt(mock.view, mock.support)
    checked_prediction(method.predict([]), [], [])


def _deterministic(one: Method, other: Method, mock: _Mock) -> None:
    if not _same(_answer(one, mock, mock.support), _answer(other, mock, mock.support)):
        raise MethodError("two fresh instances answered the same question differently. Draw random numbers from a "
                          "generator with a fixed seed, or take a constructor argument `seed`.")


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


def _leaves_alone(method: Method, mock: _Mock) -> None:
    before = _digest(mock)
    method.meta_fit(mock.specimens)
    support = mock.support
    method.adapt(mock.view, support)
    actions = mock.actions
    method.predict(actions)
    if _digest(mock) != before or len(support) != len(mock.support) or len(actions) != len(mock.actions):
        raise MethodError("the arrays or lists it was given have changed. Work on copies.")


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


def _save_load(fitted: Callable[[], Method], fresh: Callable[[], Method], mock: _Mock) -> None:
    method = fitted()
    if not (hasattr(method, "save") and hasattr(method, "load")):
        raise _NotOffered("no save() and load()")
    straight = _answer(method, mock, mock.support)
    with tempfile.TemporaryDirectory() as folder:
        method.save(Path(folder))
        again = fresh()
        again.load(Path(folder))  # type: ignore[attr-defined]
    if not _same(_answer(again, mock, mock.support), straight):
        raise MethodError("a loaded method answers differently from the one that was saved.")


def _adapted(method: Method, mock: _Mock, here: Callable[[Method, _Mock], None]) -> None:
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
