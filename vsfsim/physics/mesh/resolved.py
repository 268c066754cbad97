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

Without the local indentation, which is known under round bodies or on round faces and for the neo-Hookean law alone,
the error is larger: `BARE` h^2 / a^2. The ball of S1, nu 0.45, is 36 to 70 % too stiff where a is 0.32 of an element
and 19 to 37 % at 0.45; the PE foam of `references/foam_block.json` 14 % at 0.6. Poisson's ratio changes neither: a
ball of 10 mm at nu 0 and 0.3 is 39 to 50 % too stiff at 0.18 to 0.5 of an element, and within 7.3 % with the local
indentation.

Where a wall bends under the contact, only the share of the way that is local indentation has this error. A layer that
is thinner than its elements are long lacks less than the half-space that the local indentation was fitted to, or
nothing, and is too soft by as much: where it is larger, the error is the energy of the local indentation over that of
the elements.

Under a body with edges the error falls as h / a, since the pressure has no bound at an edge. 26 frames of six random
presses by flat cylinders, a / h from 1.5 to 3.2, were off by up to 0.18 h / a (0.08 in the median) against
`references/presses.json`; the largest is taken, so that a frame is marked below 1.8 elements.
"""

from __future__ import annotations

import numpy as np

from vsfsim.physics.elements.tet10_shape import jacobians
from vsfsim.physics.mesh.quadratic import QuadraticMesh

SHARE = 0.022
"""Error of the force times (a / h)^2 [-], see above."""
BARE = 0.07
"""The same where no local indentation acts [-]: see above; a frame is marked below 0.84 of an element."""
ROUND = 0.055
"""The same on round faces with the local indentation [-]. At `fem-coarse` a ball of 40 mm is 6.2, 5.6 and 4.8 % above
Hertz under a plate, 1, 1.5 and 2 % of the diameter deep, with a of 0.66, 0.66 and 0.8 of an element, and 7 % under a
ball like it at 0.66: elements end at the place of the touch. A frame is marked below 0.74 of an element."""
EDGES_SHARE = 0.18
"""The same times a / h under a body with edges [-]."""
ELSEWHERE = 0.015
"""Error of the force by the mesh away from the contact [-]: facets of a curved body, walls that bend, layers. Of 63
frames of `vsfsim measure trust --cells 27 --limit 30` without a mark 79 % are within what their contact alone says and
97 % with it."""
LIMIT = 0.115
"""Estimated error of the force from which a frame is marked as unresolved [-]: 0.1 by the contact, which is a contact
radius of 0.47 of an element, or of 1.8 under a body with edges."""
TURNED = 0.13
"""Largest rotation of an element up to which small strain keeps the force within 5 % [rad]. Above `fem-coarse` is
`linear` on a cantilever plate of 3 mm by 3.6, 6.9 and 21 % at 0.09, 0.18 and 0.35 rad, on one of 10 mm by 2.3 and 8.8 %
at 0.075 and 0.19, on a bridge of 4 mm by 1.4 and 10 % at 0.07 and 0.21."""
UNFELT = 1e-3
"""Depth over the edge of an element from which on a body that no contact point feels makes a frame unresolved [-]."""
PARTS = 0.25
"""Share of its stiffness by which a part inside may be off in a resolved frame [-]."""


def mesh_error(radius: np.ndarray, force: np.ndarray, share: np.ndarray,
               edges: np.ndarray, small: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Estimated error of the force by the mesh (B,) [-]; 0 without contact, NaN where there is no radius.

    Args:
        radius: of the contact with each body over the edge of the elements there (B, K) [-].
        force: on each body (B, K, 3) [N]; bodies count by what they bear.
        share: of each body's way that is local indentation (B, K) [-], see `RigidContact.resolution`. The stiffness of
            the rest, of a wall that bends say, does not hang on how the contact is resolved.
        edges: whether each body has edges (K,) bool.
        small: `SHARE`, `ROUND` or `BARE` of the contact with each body (K,) [-].
        local: energy of the local indentation over that of the elements (B, 1) [-].
    """
    size = np.linalg.norm(np.nan_to_num(force), axis=2)
    wide = np.maximum(radius, 0.01)
    own = np.maximum(np.maximum(small * share / wide**2, share * local), EDGES_SHARE * edges / wide)
    return (size * np.where(size > 0.0, own + ELSEWHERE, 0.0)).sum(axis=1) / np.maximum(size.sum(axis=1), 1e-300)


def corner_det_f(mesh: QuadraticMesh, nodes: np.ndarray, u: np.ndarray) -> float:
    """Least det F [-] at the corners of the tetrahedra that have one of ``nodes`` (s,), for displacements u (n, 3) [m].

    The solver integrates over four Gauss points inside a tetrahedron. Under a contact that is smaller than the element
    its corners may turn inside out while det F is positive at those points.
    """
    touched = np.isin(np.arange(len(mesh.points)), nodes)
    at = np.flatnonzero(touched[mesh.tets].any(axis=1))
    if not len(at):
        return 1.0
    own = mesh.tets[at]
    bent = jacobians(mesh.points[own] + u[own], np.eye(4))[1]
    return float((bent / mesh.corner_jacobians[at]).min())


def rotation(mesh: QuadraticMesh, u: np.ndarray) -> np.ndarray:
    """Largest rotation of a tetrahedron (B,) [rad], for displacements u (n, 3, B) [m]: that of its mean displacement
    gradient, from the skew part and the trace. The one tetrahedron in a hundred that turns furthest is left out: those
    few follow the slope of the dent at the rim of a contact, which the force does not feel."""
    slope = (mesh.mean_gradients.mT @ u.reshape(len(u), -1)[mesh.tets]).reshape(len(mesh.tets), 3, *u.shape[1:])
    sine = np.sqrt(0.125 * ((slope - np.swapaxes(slope, 1, 2)) ** 2).sum(axis=(1, 2)))
    return np.quantile(np.arctan2(sine, 1.0 + 0.5 * np.trace(slope, 0, 1, 2)), 0.99, axis=0)


def resolved(error: np.ndarray, corner: np.ndarray, turned: np.ndarray | float, converged: np.ndarray,
             parts: float = 0.0) -> np.ndarray:
    """Whether mesh and tier resolve each frame (...,) bool: the estimated error of the force is `LIMIT` at most, no
    corner of an element is inside out, none turns further than the tier follows, and the mesh holds the parts inside.
    A frame without an equilibrium is not.

    Args:
        error: of `mesh_error` (...,) [-].
        corner: least det F at corners (...,) [-].
        turned: largest rotation of an element at a tier of small strain (...,) [rad]; 0 at the others.
        converged: (...,) bool.
        parts: by how much the stiffness of a part inside is off at most, see `Solid.parts` [-].
    """
    return (converged & ~(error > LIMIT) & ~(corner <= 0.0) & ~(turned > TURNED)
            & ((parts <= PARTS) | (error == 0.0)))


def past_small_strain(error: np.ndarray, turned: np.ndarray, law: np.ndarray) -> np.ndarray:
    """Whether small strain does not follow each frame (...,) bool: an element turns too far, or the error by the law is
    too large, alone or as the larger part of an ``error`` that is. Arguments as of `in_words`."""
    return (turned > TURNED) | (law > LIMIT) | (error > LIMIT) & (2.0 * law**2 > error**2)


def in_words(error: np.ndarray, corner: np.ndarray, turned: np.ndarray, converged: np.ndarray,
             law: np.ndarray, support: np.ndarray) -> str:
    """Sentences on the frames (T,) of a press that are not resolved, see `resolved`; empty if all are. ``law`` and
    ``support`` are the parts of the error that are due to small strain and to the box that holds the body (T,) [-]."""
    words, folded = [], converged & (corner <= 0.0)
    small = converged & (error > LIMIT) & (2.0 * law**2 <= error**2)
    held = small & (2.0 * support**2 > error**2)
    bent = converged & past_small_strain(error, turned, law)
    if bent.any():
        words.append(f"In {bent.sum()} of {len(error)} frames elements "
                     f"{'turn' if (turned > TURNED).any() else 'stretch'} too far for this tier: take --tier fem.")
    for which, what in ((small & ~held, "contact in {}: it is small against the elements"),
                        (held, "supports in {}: the box of `fixed` ends inside elements")):
        if which.any():
            words.append(f"The mesh does NOT resolve the {what.format(f'{which.sum()} of {len(error)} frames')}, and "
                         f"the force is off there by up to {100 * error[which].max():.0f} %.")
    if folded.any():
        words.append(f"In {int(folded.sum())} of {len(error)} frames a corner of an element is inside out.")
    if (small | folded).any():
        words.append("Give a smaller resolution in [object], and compare meshes with --refine 3.")
    return " ".join(words)
