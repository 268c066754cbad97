"""Single precision first: a step that it cannot bring into equilibrium is solved in double, as is all that follows."""

from __future__ import annotations

import dataclasses

import torch
import warp as wp

from vsfsim.physics.solve.elasticity import Elasticity
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.newton import Equilibrium
from vsfsim.physics.solve.tangent_factor import TangentFactors

FLOAT32_AIM, FLOAT32_ACCEPT = 1e-3, 3e-3  # tolerance aimed at, and what counts as converged, in single precision
_NEWTON = 15  # Newton iterations of a step in single precision: at the floor of rounding more would gain nothing


def limits(options: SolverOptions, *, single: bool) -> tuple[SolverOptions, float]:
    """The options at single or double precision, and the measure at which a touch counts as balanced.

    Rounding of the nodal forces leaves about 1e-3 unbalanced in single precision: less would only cost iterations.
    """
    if not single:
        return options, options.tolerance
    fewer = dataclasses.replace(options, tolerance=max(options.tolerance, FLOAT32_AIM),
                                 newton=min(options.newton, _NEWTON))
    return fewer, max(options.tolerance, FLOAT32_ACCEPT)


def is_single(balance: Equilibrium) -> bool:
    """Whether elements and vectors of ``balance`` are in single precision."""
    return balance.real is torch.float32


def to_double(balance: Equilibrium, options: SolverOptions) -> None:
    """Go on in double precision from the displacements of ``balance``.

    Args:
        balance: a batch in single precision.
        options: the limits at double precision.
    """
    balance.elasticity = Elasticity(balance.model, device=balance.device, real=wp.float64)
    balance.elasticity.begin(len(balance.every))
    balance.real, balance.u = torch.float64, balance.u.to(torch.float64)
    balance.options, balance.accept = limits(options, single=False)
    balance.factors = TangentFactors(balance.model, balance.elasticity, balance.contact)
