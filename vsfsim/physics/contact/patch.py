"""The part of an object's surface that a touch can reach, and the quadrature over its faces.

Contact is integrated over six Gauss points, which are exact to degree 4, of every surface triangle or of every part
that it is cut into; never at vertices alone. A triangle is cut where a body is small against it, or was found between
its points. Each point q carries the penalty stiffness

    w_q = area x PENALTY x modulus / element size:

stiff enough that the penetration stays far under 1 % of the element size (it is measured and stored in every frame),
and soft enough that float64 keeps its digits. The solver inverts this block exactly, so stiffness costs no iterations.
"""

import functools
from dataclasses import dataclass

import numpy as np
import torch

from vsfsim.core.shape import Capsule, Plane, ProbeShape, Sphere
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.elements import tet10_shape
from vsfsim.physics.mesh.quadratic import ON_FACE, QuadraticMesh
from vsfsim.physics.model import Model

PENALTY = 1000.0
"""Contact pressure at a penetration of one element size, in units of the modulus under the surface [-]."""
CUTS = (1, 2, 3, 4, 6, 8)
"""Parts along the edge of a quadratic face that its contact may be integrated over."""
_LEAST = 1.5  # least size of a face for its stiffness, over the element size, under a body with edges
_MOST_CUTS = 4  # of a linear face along its edge
_ONSET = 0.01  # depth over which a sheet's contact with a body with edges stiffens, over the edge of its elements
_FACTOR = (0.1, 20.0)  # bounds of the factor on the contact stiffness of a sheet

# Degree-4 rule with six points on the triangle (Strang and Fix 1973; Cowper 1973); the weights add up to 1.
_A, _WA = 0.445948490915965, 0.223381589678011
_B, _WB = 0.091576213509771, 0.109951743655322
POINTS = np.array([[1 - 2 * a if i == k else a for i in range(3)] for a in (_A, _B) for k in range(3)])
"""Barycentric coordinates of the Gauss points (6, 3)."""
WEIGHTS = np.array([_WA] * 3 + [_WB] * 3)
"""Their weights (6,)."""


def shape_values(bary: np.ndarray) -> np.ndarray:
    """Quadratic shape functions of a triangle's six nodes (k, 6) at barycentric coordinates (k, 3)."""
    return tet10_shape.shape_values(np.pad(bary, ((0, 0), (0, 1))))[:, ON_FACE]


def face_grid(steps: int, corners: int) -> np.ndarray:
    """Shape values (s, corners) of the points of a grid on a face of 3 or 6 nodes with that many steps along its
    edges."""
    bary = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    return shape_values(bary) if corners == 6 else bary


def subdivided(cuts: int) -> np.ndarray:
    """Barycentric coordinates of the corners of the ``cuts`` ** 2 parts of a triangle (parts, 3, 3), wound as it is."""
    parts = []
    for i in range(cuts):
        for j in range(cuts - i):
            ways = [((i, j), (i + 1, j), (i, j + 1))]
            if i + j < cuts - 1:
                ways.append(((i + 1, j), (i + 1, j + 1), (i, j + 1)))
            parts += [[[1.0 - (a + b) / cuts, a / cuts, b / cuts] for a, b in way] for way in ways]
    return np.array(parts)


@functools.cache
def shape_table(corners: int, cuts: int = 1) -> np.ndarray:
    """Shape values of the six Gauss points of every part of a surface triangle (parts, 6 points, 6 nodes).

    Args:
        corners: nodes of the triangle: 6 (quadratic), or 3 (linear), whose last three columns are 0.
        cuts: parts along each edge; a face has ``cuts`` ** 2 in all.
    """
    bary = np.einsum("qk,pkc->pqc", POINTS, subdivided(cuts))
    if corners == 3:
        return np.concatenate([bary, np.zeros_like(bary)], axis=2)
    return shape_values(bary.reshape(-1, 3)).reshape(len(bary), len(POINTS), 6)


def smooth_radius(shape: ProbeShape) -> float:
    """Radius of curvature of a body [m]: 0 if it has edges, infinite for a plane."""
    if isinstance(shape, Plane):
        return float("inf")
    return shape.radius if isinstance(shape, (Sphere, Capsule)) else 0.0


def poisson_ratio(model: Model) -> float | None:
    """Poisson's ratio of a neo-Hookean body at small strain, its mean [-]; None for other laws and elements, on which
    the local indentation was not measured."""
    for block in model.blocks:
        p = block.parameters
        if block.law == "neo-hooke":
            lam = float((p["lam"] + p["mean_lam"][:, None]).mean())
            return lam / (2.0 * (lam + float(p["mu"].mean())))
    return None


PART = np.dtype([("local", np.int32, 6), ("shape", float, (6, 6)), ("stiffness", float, 6), ("area", float),
                 ("key", np.int64), ("host", np.int32), ("spot", float, 3), ("leave", float, 3), ("share", float),
                 ("soft", float)])
"""Six contact points of a part of a face, or one of a body. local: positions of its nodes among those of the patch, of
which a linear face has three, and any number in the other columns; shape: shape values of the points on the nodes;
stiffness: w_q of each point [N/m]; area [m^2], 0 of points of bodies; key: its boundary triangle, or their number and
that of the point of a body, -1 for padding; host: the body whose point it is, -1 for parts of faces; spot: that point
in the body's frame [m]; leave: direction in which it leaves the object [-]; share, soft: share of the stiffness of a
point of a body that acts at first [-], and the depth down to which it does [m]."""
NO_PART = np.array([(0, 0.0, 0.0, 0.0, -1, -1, 0.0, 0.0, 0.0, 0.0)], PART)
"""Padding (1,)."""


@dataclass(frozen=True)
class Patch:
    """The boundary triangles that one touch can reach."""

    faces: np.ndarray
    """Indices of the triangles (f,), increasing."""
    nodes: np.ndarray
    """Their nodes (s,), increasing."""
    parts: np.ndarray
    """The parts of the faces (f parts,) of `PART`, those of one face together."""


def make_patch(mesh: QuadraticMesh, faces: np.ndarray, area: np.ndarray, modulus: np.ndarray, cuts: np.ndarray,
               stiff: tuple[float, float] = (1.0, 0.0)) -> Patch:
    """The patch of some boundary triangles.

    Args:
        mesh: the mesh; its faces have six nodes, or three.
        faces: indices of the triangles (f,).
        area: their areas (f,) [m^2].
        modulus: Young's modulus under them (f,) [Pa].
        cuts: parts along the edge of each (f,), see `shape_table`.
        stiff: factor on the stiffness [-], and the element size [m] that counts where elements are smaller, as along
            the edges of a body, where a stiffer contact would only cost iterations; 0 for none.
    """
    corners = mesh.faces.shape[1]
    nodes, local = np.unique(mesh.faces[faces], return_inverse=True)
    pressure_per_metre = stiff[0] * PENALTY * modulus / np.maximum(np.sqrt(area), _LEAST * stiff[1])
    of = np.repeat(np.arange(len(faces)), cuts**2)
    parts = np.repeat(NO_PART, len(of))
    parts["key"], parts["area"] = faces[of], (area / cuts**2)[of]
    parts["local"][:, :corners] = local.reshape(len(faces), corners)[of]
    parts["stiffness"] = (parts["area"] * pressure_per_metre[of])[:, None] * WEIGHTS
    parts["shape"] = np.concatenate([np.zeros((0, 6, 6)), *(shape_table(corners, int(c)) for c in cuts)])
    return Patch(faces, nodes, parts)


def neighbours(mesh: QuadraticMesh, faces: np.ndarray) -> np.ndarray:
    """The boundary triangles that share a node with some of ``faces`` (f,), these included."""
    near = np.zeros(len(mesh.points), bool)
    near[mesh.faces[faces]] = True
    return np.flatnonzero(near[mesh.faces].any(axis=1))


def sheet_contact(bodies: RigidBodies, edge: float) -> tuple[int, float, float]:
    """How a sheet of linear faces with the mean ``edge`` [m] touches these bodies: number of parts along the edge of a
    face, factor on its contact stiffness [-], and depth over which the stiffness grows from zero [m].

    The six points of a part leave holes of radius 0.25 edge, and a dent stretches them by half. Over such a hole a
    ball of radius R is (0.4 edge)^2/(2 R) deep, under one per cent of an edge with these parts. The pressure under a
    body is that of the gas and of the sheet's tension over R, of the order E h/R, and few points carry it where a
    faceted sheet rests on its edges. So the penetration stays well under one per cent of an edge if the stiffness
    grows with edge / R: 10 times that suffices for a ball of 3 mm, and a plate needs a hundredth of it. A stiffer
    contact costs iterations, since the sheet itself is soft.

    Bodies with edges get the most, for a few points bear an edge. Their flat sides are pressed a hundred times less:
    there so stiff a contact with a kink at its onset makes points come and go without end, for each moves by less than
    its neighbours' penetration. So its stiffness grows with the depth, in proportion, and the penetration as the root
    of the pressure.
    """
    ratio = max(edge / max(smooth_radius(shape), 1e-9) for shape in bodies.shapes)
    onset = _ONSET * edge if any(smooth_radius(shape) == 0.0 for shape in bodies.shapes) else 0.0
    return (int(np.clip(np.ceil(3.0 * np.sqrt(ratio) - 1e-9), 1, _MOST_CUTS)), float(np.clip(10.0 * ratio, *_FACTOR)),
            onset)


def first_of(chosen: torch.Tensor) -> torch.Tensor:
    """Numbers (k, m) of the ``chosen`` (k, n) bool of each row, in order, and of others up to the most of any row."""
    order = torch.sort(chosen.to(torch.int8), dim=1, descending=True, stable=True)[1]
    return order[:, :int(chosen.sum(dim=1).amax())]


def nodal_sums(local: torch.Tensor, shapes: torch.Tensor, at_points: torch.Tensor, nodes: int) -> torch.Tensor:
    """Forces (k, s, c) on the s = ``nodes`` of k patches of forces ``at_points`` (k, f q, c).

    Args:
        local: nodes of the parts (k, f, n), each with q points on n nodes.
        shapes: shape values of their points (k, f, q, n).
        at_points, nodes: see above.
    """
    parts = (shapes.mT @ at_points.reshape(*shapes.shape[:3], at_points.shape[2])).flatten(1, 2)
    touch = torch.arange(len(local), device=local.device)[:, None]
    out = parts.new_zeros(len(local), nodes, parts.shape[2])
    return added(out, (touch, local.long().flatten(1)), parts)


def added(out: torch.Tensor, at: tuple[torch.Tensor, ...], values: torch.Tensor) -> torch.Tensor:
    """``out`` with ``values`` added in place at the indices ``at``, none of them negative, in a fixed order, on a GPU
    too: there `index_put_` sorts what it accumulates. It would also wait to look whether the indices are in range."""
    return torch._index_put_impl_(out, at, values, accumulate=True, unsafe=True)


def at_points(local: torch.Tensor, shapes: torch.Tensor, nodal: torch.Tensor) -> torch.Tensor:
    """Vectors at the nodes (k, s, 3) interpolated to the points of the parts (k, f q, 3)."""
    at = local.flatten(1)[:, :, None].expand(-1, -1, 3).long()
    return (shapes @ nodal.gather(1, at).view(*local.shape, 3)).flatten(1, 2)
