"""Limits of the solver, and its results: the frames of a batch of touches."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np


class Reason(IntEnum):
    """Why a frame did not converge."""

    text: str
    """In words, for people and datasets."""

    def __new__(cls, number: int, text: str = "") -> Reason:
        out = int.__new__(cls, number)
        out._value_, out.text = number, text
        return out

    NONE = 0, ""
    ITERATIONS = 1, "the iteration limit was reached, halved steps included"
    TIME = 2, "the limit of the frame's processor time was reached"
    STALLED = 3, "no step lowers the potential any more, and the forces do not balance"
    NOT_FINITE = 4, "the state was not finite; the one before was kept"
    PATCH = 5, "the contact patch kept growing"
    WRONG_SIDE = 6, "the surface slipped through a body"
    INVERTED = 7, "an element is inside out (det F <= 0)"
    INTRUSION = 8, "a body lies inside another where no contact point feels it"
    CRUSHED = 9, "an element is compressed below a tenth of its volume (det F < 0.1)"
    PATH = 10, "the frame itself is in equilibrium, but the way to it was not followed from its start"
    SNAPPED = 11, "the object snapped to another equilibrium, and which one depends on its motion"
    ARM = 12, "a joint of the arm was at its stop or a motor at its limit: its sensors do not read the contact"
    MOUNT = 13, "the spring of the mount and the contact do not balance"


@dataclass(frozen=True)
class SolverOptions:
    """Limits and tolerances."""

    tolerance: float = 1e-4
    """Largest sum of unbalanced nodal forces over that of the contact (or weight) forces [-]; it bounds the error of
    the force balance."""
    newton: int = 40
    """Newton iterations of a step."""
    cg_tolerance: float = 0.03
    """Relative residual of a linear system near the solution [-]."""
    local_indentation: bool = False
    """Whether the indentation under balls and capsules that the mesh is too coarse for is a compliance of the contact
    points, see `contact.local_indentation`."""
    indentation_by_place: bool = False
    """Whether that is what the object's mesh lacks at the place of the touch, not the mean of places in an element."""
    cg_frame: int = 1500
    """Conjugate-gradient iterations of one touch in one step of a frame's way, halves included; a touch that needs more
    is marked."""
    newton_frame: int = 10_000
    """Newton iterations of one touch, likewise."""
    halvings: int = 5
    """How often a failed step is halved."""
    seconds: float = 120.0
    """Processor time that a frame may take for each touch [s], see `clock.now`; a batch has the sum."""


OF_AN_EQUILIBRIUM = ("force", "body_force", "body_moment", "reaction", "energy")
"""Fields of `Frames` that are results of an equilibrium: NaN in the other frames."""


@dataclass(frozen=True)
class Frames:
    """Results of B touches of T frames by K rigid bodies."""

    force: np.ndarray
    """Force on all bodies together (T, B, 3) [N]; this and the others of `OF_AN_EQUILIBRIUM` are NaN where a frame did
    not converge."""
    unbalanced_force: np.ndarray
    """The same of the state in which a frame ended that did not converge, for diagnosis; 0 elsewhere (T, B, 3) [N]."""
    body_force: np.ndarray
    """Force on each body (T, B, K, 3) [N]."""
    body_moment: np.ndarray
    """Moment on each body about its origin, world (T, B, K, 3) [N m]."""
    reaction: np.ndarray
    """Force of the supports on the object (T, B, 3) [N]."""
    converged: np.ndarray
    """Whether the frame is an equilibrium (T, B) bool."""
    reason: np.ndarray
    """Why not, `Reason` (T, B)."""
    residual: np.ndarray
    """Unbalanced over contact force (T, B) [-]."""
    iterations: np.ndarray
    """Newton iterations (T, B)."""
    cg_iterations: np.ndarray
    """Conjugate-gradient iterations (T, B)."""
    force_balance: np.ndarray
    """|force - reaction - weight| over the largest of them (T, B) [-]."""
    min_det_f: np.ndarray
    """Least det F (T, B) [-]."""
    energy: np.ndarray
    """Elastic energy (T, B) [J]."""
    penetration: np.ndarray
    """Depth of the deepest point of the object's boundary inside a body, between the contact points too, or of a body's
    surface inside the object (T, B) [m]; of two soft bodies likewise."""
    slipping: np.ndarray
    """Share of the points in contact that slip (T, B) [-]."""
    contact_points: np.ndarray
    """Number of contact points that touch (T, B)."""
    contact_radius: np.ndarray
    """How well the contact is resolved: radius of a circle of its area over the edge of the elements there (T, B) [-];
    NaN between two soft bodies."""
    mesh_error: np.ndarray
    """Estimated error of the force by elements (`mesh.resolved`), small strain and supports (T, B) [-]; NaN where it is
    not known: of membranes, between two soft bodies, and of elements that are no tetrahedra."""
    law_error: np.ndarray
    """The part of it by small strain (T, B) [-], see `LinearElasticity.law_error`; NaN likewise."""
    support_error: np.ndarray
    """The part of it by a box that holds the body and ends inside elements (T, B) [-], see `audit`; NaN likewise."""
    corner_det_f: np.ndarray
    """Least det F at the corners of the tetrahedra in contact (T, B) [-]; NaN likewise."""
    rotation: np.ndarray
    """Largest rotation of a tetrahedron (T, B) [rad]; NaN likewise."""
    seconds: np.ndarray
    """Duration of the frame, shared by the batch, the first with what is set up before it (T,) [s]."""
