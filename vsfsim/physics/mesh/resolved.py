"""Does the mesh resolve what happens on it? An estimate of the force's error from the size of the contact.

A contact of radius a on elements of edge h is felt as if it were as wide as an element can show, so that a small one
is too stiff. The error of the force on 40 random balls of 2 to 25 mm radius, at random places of a block of 0.1 x 0.1 x
0.05 m on elements of 7 to 16 mm, at five depths up to 1.5 radii, against the same tier on a mesh that is refined to two
fifths of the contact radius (200 frames of `fem-coarse` and `fem`), by the radius
over the edge that the frame itself measured:

    a / h             0.1-0.15  0.15-0.2  0.2-0.25  0.25-0.3  0.3-0.35  0.35-0.4  0.4-0.5  0.5-0.7  0.7-1  over 1
    median error [%]  128       49        39        29        19        9         4        2        0.9    0.9
    largest [%]       163       107       68        45        27        28        18       10       5      1.7
    SHARE h^2/a^2 [%] 121       66        41        30        22        16        10       6        3      1.5

Where a wall bends under the contact, only the share of the way that is local indentation has this error.

Under a body with edges the error falls as h / a, since the pressure has no bound at an edge. Six frames of two random
presses by flat cylinders, a / h from 0.46 to 0.68, were off by 0.03 to 0.114 h / a (`vsfsim measure trust --seed 11`,
presses 95 and 101); the largest is taken, so that a frame is marked below 1.1 elements.
"""

from __future__ import annotations

import numpy as np

from vsfsim.physics.elements.tet10_shape import determinants, jacobians
from vsfsim.physics.mesh.quadratic import QuadraticMesh

SHARE = 0.022
"""Error of the force times (a / h)^2 [-], see above."""
EDGES_SHARE = 0.114
"""The same times a / h under a body with edges [-]."""
LIMIT = 0.10
"""Estimated error of the force from which a frame is marked as unresolved [-]: a contact radius of 0.47 of an
element, or of 1.1 under a body with edges."""
PARTS = 0.25
"""Share of its stiffness by which a part inside may be off in a resolved frame [-]."""


def mesh_error(radius: np.ndarray, force: np.ndarray, share: np.ndarray | float = 1.0,
               edges: np.ndarray | bool = False) -> np.ndarray:
    """Estimated error of the force by the mesh (B,) [-]; 0 without contact, NaN where there is no radius.

    Args:
        radius: of the contact with each body over the edge of the elements there (B, K) [-].
        force: on each body (B, K, 3) [N]; bodies count by what they bear.
        share: of each body's way that is local indentation (B, K) [-], see `RigidContact.local_share`. The stiffness of
            the rest, of a wall that bends say, does not hang on how the contact is resolved.
        edges: whether each body has edges (K,) bool.
    """
    size = np.linalg.norm(np.nan_to_num(force), axis=2)
    wide = np.maximum(radius, 0.01)
    own = np.maximum(SHARE * share / wide**2, np.where(edges, EDGES_SHARE / wide, 0.0))
    return (size * np.where(size > 0.0, own, 0.0)).sum(axis=1) / np.maximum(size.sum(axis=1), 1e-300)


def corner_det_f(mesh: QuadraticMesh, nodes: np.ndarray, u: np.ndarray) -> float:
    """Least det F [-] at the corners of the tetrahedra that have one of ``nodes`` (s,), for displacements u (n, 3) [m].

    The solver integrates over four Gauss points inside a tetrahedron. Under a contact that is smaller than the element
    its corners may turn inside out while det F is positive at those points.
    """
    on = np.zeros(len(mesh.points), bool)
    on[nodes] = True
    at = np.flatnonzero(on[mesh.tets].any(axis=1))
    if not len(at):
        return 1.0
    rest, bent = (determinants(jacobians(x[mesh.tets[at]], np.eye(4))) for x in (mesh.points, mesh.points + u))
    return float((bent / rest).min())


def resolved(error: np.ndarray, corner: np.ndarray, converged: np.ndarray, parts: float = 0.0) -> np.ndarray:
    """Whether the mesh resolves each frame (...,) bool: the estimated error of the force is `LIMIT` at most, no corner
    of an element is inside out, and the mesh holds the parts inside. A frame without an equilibrium is not.

    Args:
        error: of `mesh_error` (...,) [-].
        corner: least det F at corners (...,) [-].
        converged: (...,) bool.
        parts: by how much the stiffness of a part inside is off at most, see `Solid.parts` [-].
    """
    return converged & ~(error > LIMIT) & ~(corner <= 0.0) & ((parts <= PARTS) | (error == 0.0))


def in_words(error: np.ndarray, corner: np.ndarray, converged: np.ndarray) -> str:
    """A sentence on the frames (T,) of a press that the mesh does not resolve; empty if it resolves all."""
    small, folded = converged & (error > LIMIT), converged & (corner <= 0.0)
    if not (small | folded).any():
        return ""
    words = []
    if small.any():
        most = float(error[small].max())
        words.append(f"The mesh does NOT resolve the contact in {int(small.sum())} of {len(error)} frames: it is small "
                     f"against the elements, and the force is off there by "
                     f"{'more than 100' if most > 1.0 else f'about {100 * most:.0f}'} % at most.")
    if folded.any():
        words.append(f"In {int(folded.sum())} of {len(error)} frames a corner of an element is inside out (det F "
                     f"{float(corner[folded].min()):.2f}).")
    return " ".join(words) + " Give a smaller resolution in [object], and compare meshes with --refine 3."
