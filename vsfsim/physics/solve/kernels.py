"""The kernel modules that the solver launches, for compiling them ahead in one visible step."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

import warp as wp

from vsfsim.physics.contact import pair_points, pair_rows, rigid_points
from vsfsim.physics.solve import elasticity


def solver_kernels(precision: str, kinds: Iterable[str] = ("tet10",)) -> list[Any]:
    """One kernel of each module that the solver launches at a precision, for a model of these ``kinds`` of elements."""
    real = wp.float64 if precision == "float64" else wp.float32
    elements = [importlib.import_module(f"vsfsim.physics.elements.{kind}").kernels(real).forces for kind in kinds]
    return [*elements, elasticity.kernels(real).gather, rigid_points.kernels().evaluate]


def pair_kernels(precision: str, kinds: Iterable[str]) -> list[Any]:
    """As `solver_kernels`, of a sensor and an object that touch."""
    real = wp.float64 if precision == "float64" else wp.float32
    elements = [importlib.import_module(f"vsfsim.physics.elements.{kind}").kernels(real).forces for kind in kinds]
    return [*elements, elasticity.kernels(real).gather, pair_points.kernels().evaluate, pair_rows.kernels().gram]
