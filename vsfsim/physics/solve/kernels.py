"""The kernel modules that the solver launches, for compiling them ahead in one visible step."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import warp as wp

from vsfsim.physics.contact import rigid_kernels
from vsfsim.physics.contact.pair import kernels as pair_kernels
from vsfsim.physics.contact.pair import rows
from vsfsim.physics.solve import elasticity


def solver_kernels(precision: str, kinds: Iterable[str] = ("tet10",)) -> list[Any]:
    """One kernel of each module that the solver launches at a precision, for a model of these ``kinds`` of elements.
    A step that single precision cannot balance is solved in double."""
    return [*_body_kernels(precision, kinds), rigid_kernels.kernels().evaluate]


def coupled_kernels(precision: str, kinds: Iterable[str]) -> list[Any]:
    """As `solver_kernels`, for a sensor and an object that touch."""
    return [*_body_kernels(precision, kinds), pair_kernels.kernels().evaluate, rows.kernels().gram]


def _body_kernels(precision: str, kinds: Iterable[str]) -> list[Any]:
    out = []
    for real in (wp.float64,) if precision == "float64" else (wp.float32, wp.float64):
        out += [importlib.import_module(f"vsfsim.physics.elements.{kind}").kernels(real).forces for kind in kinds]
        out.append(elasticity.kernels(real).gather)
    return out
