"""The kernel modules that the solver launches, for compiling them ahead in one visible step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from vsfsim.physics.contact import intrusion, rigid_kernels
from vsfsim.physics.contact.pair import kernels as pair_kernels
from vsfsim.physics.contact.pair import rows
from vsfsim.physics.elements.block import kernels_of
from vsfsim.physics.linear.multifrontal import factor_kernels
from vsfsim.physics.solve import elasticity


def solver_kernels(precision: str, elements: Sequence[tuple[str, str]]) -> list[Any]:
    """One kernel of each module that the solver launches at a precision, for a body of ``elements`` of these kinds and
    laws (see `tiers.elements` and `block.elements_of`). A step that single precision cannot balance is solved in
    double."""
    solid = [intrusion.kernels().surface, *factor_kernels()] if any(law for _, law in elements) else []
    return [rigid_kernels.kernels().evaluate, *_body_kernels(precision, elements), *solid]


def coupled_kernels(precision: str, elements: Sequence[tuple[str, str]]) -> list[Any]:
    """As `solver_kernels`, for a sensor and an object that touch."""
    return [pair_kernels.kernels().evaluate, *_body_kernels(precision, elements), rows.kernels().gram]


def _body_kernels(precision: str, elements: Sequence[tuple[str, str]]) -> list[Any]:
    out = []
    for real in (wp.float64,) if precision == "float64" else (wp.float32, wp.float64):
        out += [kernels_of(kind, law, real).forces for kind, law in dict.fromkeys(elements)]
        out.append(elasticity.kernels(real).gather)
    return out
