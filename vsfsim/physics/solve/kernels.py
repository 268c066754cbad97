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


def solver_kernels(elements: Sequence[tuple[str, str]], law: ContactLaw | None = PENALTY) -> list[Any]:
    """One kernel of each module that the solver launches for bodies of ``elements`` of these kinds and laws, see
    `tiers.elements` and `block.elements_of`, and for a law of contact with rigid bodies; None for a soft sensor's."""
    contact = pair_kernels.KERNELS if law is None else rigid_kernels.kernels(law)
    return [contact.evaluate, *(kernels_of(*each).forces for each in dict.fromkeys(elements)), elasticity.gather,
            intrusion.nearest_faces, *factor_kernels()]
