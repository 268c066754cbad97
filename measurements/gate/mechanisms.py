"""The mechanisms of the solver, each with how it is switched off: the solver itself has no such switches."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any
from unittest import mock

import numpy as np

from vsfsim.physics import tiers
from vsfsim.physics.solve import newton, tangent_factor, touches
from vsfsim.physics.solve.solution_branch import SolutionBranch
from vsfsim.physics.solve.touches import Solver

_NEVER = 10**9  # iterations after which something is done
Patch = Callable[[], list[Any]]


def _set(owner: Any, **values: Any) -> Patch:
    return lambda: [mock.patch.object(owner, name, value) for name, value in values.items()]


def _unhalved() -> list[Any]:
    inner = tiers.options
    return [mock.patch.object(tiers, "options", lambda tier: dataclasses.replace(inner(tier), halvings=0))]


MECHANISMS: dict[str, tuple[str, Patch]] = {
    "predictor": ("a step begins from the extrapolated, condensed problem", _set(Solver, _predict=lambda *_: None)),
    "halving": ("a step that fails is made in two", _unhalved),
    "branch": ("states of another solution branch are barred and marked", _set(
        SolutionBranch, bar=lambda *_: None, mark=lambda *_, **__: None,
        repeats=lambda _self, columns, _pose: np.zeros(len(columns), bool))),
    "doubts": ("a step that lacks energy is made again in shorter ones", _set(touches, _DOUBTS=0)),
    # without it the cell "box" keeps two of four frames, at eight times the CPU time
    "correction": ("every Newton step is corrected by a condensed problem", _set(
        newton, correct=lambda _balance, _columns, direction, *_: direction)),
    "local factors": ("a factor of the most deformed nodes corrects the factor at rest", _set(
        tangent_factor, _NEAR=_NEVER, _VOLUME_NEAR=_NEVER)),
    "whole factors": ("a factor of the whole deformed body preconditions", _set(tangent_factor, _FIRST=_NEVER)),
    "factors": ("a factor of a deformed state preconditions", _set(
        tangent_factor, _NEAR=_NEVER, _VOLUME_NEAR=_NEVER, _FIRST=_NEVER)),
}
"""What each does, and the patches without it."""


def without(names: Sequence[str]) -> ExitStack:
    """Switches off mechanisms while it is open."""
    out = ExitStack()
    for name in names:
        for patch in MECHANISMS[name][1]():
            out.enter_context(patch)
    return out
