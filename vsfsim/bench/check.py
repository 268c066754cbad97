"""`vsfsim check`: whether a method keeps the contract of `vsfsim.bench.method.Method`, in seconds, on mock objects."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.bench import method as rules
from vsfsim.bench.isolation.wire import packed
from vsfsim.bench.metrics import rmse, touch_errors
from vsfsim.bench.mock import mock_view
from vsfsim.bench.protocol import record, specimen
from vsfsim.bench.task import parse_task
from vsfsim.core.errors import MethodError, VsfsimError
from vsfsim.core.text_table import text_table

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


def check(name: str, *, parameters: Mapping[str, Any] | None = None, brief: bool = False) -> tuple[Finding, ...]:
    """Test every clause of the contract on mock objects.

    Args:
        name: an installed method, or module:attribute. parameters: of its constructor.
        brief: let it learn only once, and leave out `_LONGER`; `vsfsim evaluate` tests this first.

    Returns:
        One finding a clause; the method conforms if none of them failed.

    Raises:
        MethodError: the method is unknown or cannot be built at all.
    """
    factory = rules.find_method(name)
    values = rules.parameters_of(factory, parameters or {})
    rules.build_method(factory, values)
    contract = _Contract(factory, values, brief)
    return tuple(_try(clause, test, contract) for clause, test in _CLAUSES.items()
                 if not (brief and clause in _LONGER))


def report(name: str, findings: Sequence[Finding]) -> str:
    """The findings for a terminal."""
    failed = sum(f.outcome == "failed" for f in findings)
    verdict = "conforms" if not failed else f"does not conform: {failed} of {len(findings)} clauses failed"
    rows = [(f.outcome, f.clause, f.detail) for f in findings]
    return f"{text_table(('outcome', 'clause', 'what was observed'), rows)}\n{name} {verdict}"


def table(name: str, findings: Sequence[Finding]) -> dict[str, Any]:
    """The findings for JSON."""
    return {"method": name, "conforms": all(f.outcome != "failed" for f in findings),
            "clauses": [dataclasses.asdict(f) for f in findings]}


class _NotOffered(Exception):
    pass


def _try(clause: str, test: Callable[[_Contract], str | None], contract: _Contract) -> Finding:
    try:
        return Finding(clause, "ok", test(contract) or "")
    except _NotOffered as reason:
        return Finding(clause, "not offered", str(reason))
    except VsfsimError as error:
        return Finding(clause, "failed", str(error))
    except (Exception, SystemExit) as error:  # a method may raise anything, which is a finding
        return Finding(clause, "failed", f"{type(error).__name__}: {error}")


class _Contract:
    """The mock objects, and the clauses that are tested on them, a function each: it raises if the method breaks the
    clause, and may return what was observed. A clause begins with a copy of what was learned, as a trial does."""

    def __init__(self, factory: type, values: Mapping[str, Any], brief: bool):
        task = parse_task(MOCK_TASK, "mock task")
        test = mock_view(2)
        recording = record(test, task)
        self.factory, self.values, self.brief = factory, values, brief
        self.specimens = tuple(specimen(mock_view(i, split="train"), task) for i in range(2))
        self.view, self.readings, self.clean = rules.frozen_view(test.view), recording.readings, recording.clean
        self.support, self.actions = self.readings[:5], [reading.action for reading in self.readings[5:]]
        self.gap = [self.spoiled(reading, 4, valid=False) for reading in self.support]
        self.other = record(mock_view(3, stiffness=4.0), task).readings
        self._learned: rules.Method | None = None
        self._state = b""
        self._adapted = list[rules.Method]()
        self._untouched = self._arrays()

    # ------------------------------------------------------------------ what the clauses use

    def learn(self) -> rules.Method:
        method = rules.build_method(self.factory, self.values)
        method.meta_fit(self.specimens)
        return method

    def learned(self) -> rules.Method:
        self._learned = self._learned or self.learn()
        return self._learned

    def copy(self) -> rules.Method:
        self._state = self._state or packed(self.learned())
        return pickle.loads(self._state)

    def answer(self, method: rules.Method, support: Sequence[rules.Reading]) -> list[np.ndarray]:
        method.adapt(self.view, list(support))
        return self.prediction(method)

    def prediction(self, method: rules.Method, function: str = "predict") -> list[np.ndarray]:
        names = [f"mock touch {i} ({function})" for i in range(5, 8)]
        return rules.checked_prediction(getattr(method, function)(self.actions), self.actions, names)

    def spoiled(self, reading: rules.Reading, frame: int, *, valid: bool) -> rules.Reading:
        """A reading without the value of one frame."""
        value, known = np.array(reading.value), np.array(reading.valid)
        value[frame], known[frame] = np.nan, valid
        return dataclasses.replace(reading, value=rules.frozen(value), valid=rules.frozen(known))

    def optional(self, name: str) -> list[Callable[..., Any]]:
        """A function that a method may leave out, of those that predicted after no touch and after some."""
        if not hasattr(self.learned(), name):
            raise _NotOffered(f"no {name}()")
        return [getattr(method, name) for method in self._adapted]

    def _arrays(self) -> bytes:
        return pickle.dumps((self.specimens, self.view, self.readings, self.other), protocol=4)

    # ------------------------------------------------------------------ clauses

    def scored(self, support: Sequence[rules.Reading]) -> str:
        method = self.copy()
        answer = self.answer(method, support)
        rules.checked_prediction(method.predict([]), [], [])
        self._adapted.append(method)
        mine, zero = (rmse([touch_errors(p, y, r.valid) for p, y, r in zip(
            given, self.clean[5:], self.readings[5:], strict=True)]) for given in (
                answer, [np.zeros_like(y) for y in answer]))
        return f"rmse {mine:.3f} N (always answering 0: {zero:.3f} N)"

    def handed_on(self) -> None:
        _agree(self.answer(self.copy(), self.support), self.answer(self.learned(), self.support),
               "a copy of what it learned answers differently from the one that learned. What it learned must belong "
               "to the object.")

    def deterministic(self) -> None:
        other = self.copy() if self.brief else self.learn()
        _agree(self.answer(self.copy(), self.gap), self.answer(other, self.gap),
               "the same touches gave another answer the second time. Draw random numbers from a generator with a "
               "fixed seed, or take a constructor argument `seed`, and begin every adapt with what meta_fit learned.")

    def forgets(self) -> None:
        method = self.copy()
        method.adapt(self.view, list(self.other))
        _agree(self.answer(self.copy(), self.support), self.answer(method, self.support), "after adapting to another "
               "object first, the answer is another one. adapt must start from what meta_fit learned.")

    def refuses_nan(self) -> None:
        support = [self.spoiled(self.support[0], 3, valid=True), *self.support[1:]]
        try:
            self.copy().adapt(self.view, support)
        except (VsfsimError, ValueError):
            return
        raise MethodError("a NaN in a frame marked valid was accepted by adapt. Raise MethodError (or ValueError) that "
                          "names the touch.")

    def stiffness(self) -> None:
        for function in self.optional("stiffness"):
            estimate = function(np.array([[-0.02, 0.0, 0.03], [0.0, 0.0, 0.03], [0.02, 0.01, 0.03]]))
            for key in ("mean", "std"):
                given = getattr(estimate, key, None)
                values = rules.numbers(given, f"stiffness has a {key}")
                if values.shape != (3,) or not np.isfinite(values).all() or (values < 0).any():
                    raise MethodError(f"stiffness of 3 points has {key} {given!r}; it must return an Estimate with 3 "
                                      f"finite numbers >= 0.")

    def spread(self) -> None:
        self.optional("predict_std")
        if any((std < 0.0).any() for method in self._adapted for std in self.prediction(method, "predict_std")):
            raise MethodError("predict_std gave a negative standard deviation; it must be 0 or greater.")

    def choice(self) -> None:
        for function in self.optional("choose"):
            rules.checked_choice(function(self.view, list(self.support), self.actions), len(self.actions))

    def unchanged(self) -> None:
        if self._arrays() != self._untouched:
            raise MethodError("the arrays it was given have changed. Work on copies.")


def _agree(one: Sequence[np.ndarray], other: Sequence[np.ndarray], complaint: str) -> None:
    if not all(map(np.array_equal, one, other)):
        raise MethodError(complaint)


_CLAUSES: Mapping[str, Callable[[_Contract], Any]] = {
    "parameters are plain values": lambda c: rules.plain_parameters(c.values),
    "meta_fit learns from training objects": lambda c: c.learned() and None,
    "predicts before any touch (0-shot)": lambda c: c.scored([]),
    "copes with frames that have no reading": lambda c: c.scored(c.gap),
    "adapts to touches and predicts (5-shot)": lambda c: c.scored(c.support),
    "is deterministic": _Contract.deterministic,
    "refuses a reading that is not a number": _Contract.refuses_nan,
    "what it learned can be handed to a trial": _Contract.handed_on,
    "adapt forgets the object before": _Contract.forgets,
    "stiffness is finite and not negative": _Contract.stiffness,
    "predict_std is finite and not negative": _Contract.spread,
    "choose names one of the offered touches": _Contract.choice,
    "leaves its input alone": _Contract.unchanged}
_LONGER = ("adapts to touches and predicts (5-shot)", "what it learned can be handed to a trial",
           "adapt forgets the object before")
