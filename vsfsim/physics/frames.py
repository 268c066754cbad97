"""What goes into the solver besides the body, and what comes out: limits, and the frames of a batch of touches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SolverOptions:
    """Limits and tolerances.

    tolerance: largest sum of unbalanced nodal forces over the sum of contact (or weight) forces [-]; bounds the error of
    the force balance. newton: iterations a step. cg: iterations a linear system. cg_tolerance: its relative residual near the solution.
    cg_far: looser by this factor far from it, where Newton's model is no better.
    halvings: how often a failed step is halved. seconds: wall-clock limit of one frame of the batch [s].
    """

    tolerance: float = 1e-4
    newton: int = 40
    cg: int = 150
    cg_tolerance: float = 1e-2
    cg_far: float = 10.0
    halvings: int = 5
    seconds: float = 120.0


@dataclass(frozen=True)
class Frames:
    """What B touches of T frames gave; arrays (T, B) unless said.

    force: on the probe (T, B, 3) [N]. reaction: of the supports on the body (T, B, 3) [N].
    converged: bool. residual: unbalanced over contact force [-]. iterations: Newton. cg_iterations: conjugate gradients.
    force_balance: |force - reaction - weight| over the larger [-]. min_det_f: least det F [-]. energy: elastic [J].
    penetration: deepest point of the surface inside the probe [m]. seconds: of the frame, shared by the batch (T,) [s].
    """

    force: np.ndarray
    reaction: np.ndarray
    converged: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    cg_iterations: np.ndarray
    force_balance: np.ndarray
    min_det_f: np.ndarray
    energy: np.ndarray
    penetration: np.ndarray
    seconds: np.ndarray
