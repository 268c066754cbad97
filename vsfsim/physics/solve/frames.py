"""What goes into the solver besides the body, and what comes out: limits, and the frames of a batch of touches."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class Reason(IntEnum):
    """Why a frame did not converge."""

    NONE = 0
    ITERATIONS = 1
    TIME = 2
    STALLED = 3
    NOT_FINITE = 4
    PATCH = 5
    WRONG_SIDE = 6
    INVERTED = 7

    @property
    def text(self) -> str:
        """In words, for people and datasets."""
        return ("", "the iteration limit was reached, halved steps included", "the time limit of the frame was reached",
                "no step lowers the potential any more, and the forces do not balance",
                "the state was not finite; the one before was kept",
                "the contact patch kept growing", "the surface slipped through a body",
                "an element is inside out (det F <= 0)")[self]


@dataclass(frozen=True)
class SolverOptions:
    """Limits and tolerances.

    tolerance: largest sum of unbalanced nodal forces over the sum of contact (or weight) forces [-]; bounds the error
    of the force balance. newton: iterations a step. cg: iterations a linear system. cg_tolerance: its relative residual
    near the solution.
    cg_far: looser by this factor far from it, where Newton's model is no better. cg_plain: the residual is measured by
    its length, not in the preconditioner's norm, see `pcg.solve`.
    cg_frame, newton_frame: conjugate gradients and Newton iterations that one touch may take in one frame, halved steps
    included: what needs more is marked.
    halvings: how often a failed step is halved. seconds: wall-clock limit of one frame of the batch [s].
    """

    tolerance: float = 1e-4
    newton: int = 40
    cg: int = 150
    cg_tolerance: float = 1e-2
    cg_far: float = 10.0
    cg_plain: bool = False
    cg_frame: int = 1500
    newton_frame: int = 10_000
    halvings: int = 5
    seconds: float = 120.0


@dataclass(frozen=True)
class Frames:
    """What B touches of T frames by K rigid bodies gave; arrays (T, B) unless said.

    force: on all bodies together (T, B, 3) [N]. body_force: on each (T, B, K, 3) [N].
    body_moment: on each about its origin, in the world (T, B, K, 3) [N m]. reaction: of the supports on the object (T,
    B, 3) [N].
    converged: bool. reason: why not, `Reason`. residual: unbalanced over contact force [-]. iterations: Newton.
    cg_iterations: conjugate gradients. force_balance: |force - reaction - weight| over the larger [-]. min_det_f: least
    det F [-]. energy: elastic [J].
    penetration: deepest point of the surface inside a body [m]. slipping: share of the points in contact that slip [-].
    seconds: of the frame, shared by the batch (T,) [s].
    """

    force: np.ndarray
    body_force: np.ndarray
    body_moment: np.ndarray
    reaction: np.ndarray
    converged: np.ndarray
    reason: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    cg_iterations: np.ndarray
    force_balance: np.ndarray
    min_det_f: np.ndarray
    energy: np.ndarray
    penetration: np.ndarray
    slipping: np.ndarray
    seconds: np.ndarray
