"""The kernel modules that the solver launches, for compiling them ahead in one visible step."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vsfsim.physics.contact import intrusion, rigid_kernels
from vsfsim.physics.contact.law import PENALTY, ContactLaw
from vsfsim.physics.contact.pair import kernels as pair_kernels
from vsfsim.physics.elements.block import kernels_of
from vsfsim.physics.linear.cholesky import factor_kernels
from vsfsim.physics.solve import elasticity


def solver_kernels(elements: Sequence[tuple[str, str]], law: ContactLaw = PENALTY) -> list[Any]:
    """One kernel of each module that the solver launches for a body of ``elements`` of these kinds and laws, see
    `tiers.elements` and `block.elements_of`, and of a law of contact."""
    solid = factor_kernels() if any(law for _, law in elements) else []
    return [rigid_kernels.kernels(law).evaluate, *_body_kernels(elements), *solid]


def coupled_kernels(elements: Sequence[tuple[str, str]]) -> list[Any]:
    """As `solver_kernels`, for a sensor and an object that touch."""
    return [pair_kernels.kernels().evaluate, *_body_kernels(elements)]


def _body_kernels(elements: Sequence[tuple[str, str]]) -> list[Any]:
    return [*(kernels_of(kind, law).forces for kind, law in dict.fromkeys(elements)), elasticity.kernels().gather,
            intrusion.nearest_faces]
