"""The mechanisms of the solver, each with how it is switched off: the solver itself has no such switches."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Any
from unittest import mock

import numpy as np
import torch

from vsfsim.physics import tiers
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.solve import increments, tangent_factor
from vsfsim.physics.solve.work_check import WorkCheck

Patch = Callable[[], list[Any]]


def _set(owner: Any, **values: Any) -> Patch:
    return lambda: [mock.patch.object(owner, name, value) for name, value in values.items()]


def _unhalved() -> list[Any]:
    inner = tiers.options
    return [mock.patch.object(tiers, "options", lambda tier: dataclasses.replace(inner(tier), halvings=0))]


MECHANISMS: dict[str, tuple[str, Patch]] = {
    "extrapolation": ("a step begins from the last two equilibria, extrapolated", _set(
        increments, ratio=lambda first, *_: np.zeros(len(first)))),
    "halving": ("a step that fails is made in two", _unhalved),
    "inner bodies": ("a Newton step ends before a contact point enters an inner body", _set(
        RigidContact, reach=lambda _self, columns, *_: torch.ones(len(columns), dtype=torch.float64))),
    "work": ("an equilibrium that lacks the work of the bodies is marked", _set(
        WorkCheck, snapped=lambda _self, columns, *_: torch.zeros(len(columns), dtype=torch.bool))),
    "factors": ("a factor of a deformed state preconditions", _set(
        tangent_factor.TangentFactors, count=lambda *_: None)),
}
"""What each does, and the patches without it."""


def without(names: Sequence[str]) -> ExitStack:
    """Switches off mechanisms while it is open."""
    out = ExitStack()
    for name in names:
        for patch in MECHANISMS[name][1]():
            out.enter_context(patch)
    return out
