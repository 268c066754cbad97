"""Parts inside a body: mesh vertices moved onto the surfaces of inclusions, so that few elements have two materials,
and the largest modulus that still matters of parts that are far stiffer than what surrounds them.

A part whose modulus is a million times that of its surroundings does not strain: it only moves and turns. Newton's
straight steps stretch a part that turns, and the larger the modulus the more steps that costs, for a force that no
longer changes. So the modulus of such a part is limited to

    E <= COMPACT (longest / thickness)^3 E_around,     thickness = 2 volume / area

of its longest extent and its surface. A compact part in a soft matrix strains by about E_around / E of what the matrix
does (for a ball longest / thickness is 3). A slender one bends more easily, by the cube of its slenderness,
and keeps as much more of its modulus. Only parts without a node on the boundary of the body are limited: what loads
them comes through their surroundings.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np

from vsfsim.core.material import Inclusion, MaterialField
from vsfsim.core.solid import Solid, boundary_faces, tet_volumes
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.physics.mesh.validity import Mover, joined

# A tetrahedron may lose shape to a move, but not below this smallest sine of its angles (8.6 degrees).
WORST_SINE = 0.15
# The farthest a vertex goes, in parts of its shortest edge, pass by pass: near ones first, so that they are in
# place when the rest is tried.
REACH = (0.2, 0.35, 0.5, 0.7, 0.9)
TOLD = 0.05
"""Share of its stiffness by which a part is off in the mesh from which it is told [-]."""
ESHELBY = 0.44
"""2 (4 - 5 nu) / (15 (1 - nu)), the shear of a ball in what is around it over its shear if both were free [-]: 0.48 at
nu = 0.3, 0.42 at 0.45."""
_FINEST = 16  # parts of the edge of a tetrahedron at a surface that its share of a part is sampled with
# On the surface, in parts of the shortest edge.
_ON = 1e-3
COMPACT = 40.0
"""Largest modulus of a part over that of its surroundings and over the cube of its slenderness [-]: 1,080 for a ball.
On the block of scenes/indent.toml, pressed 10 mm, the force at a contrast of 1e3 is 0.18 % under that of 1e4, and takes
24 Newton steps in place of 103."""
ENCLOSED = 0.9
"""Part of the volume of the elements next to a part that decides what surrounds it [-]."""


def snap_to_inclusions(solid: Solid, field: MaterialField) -> Solid:
    """Move vertices near a spherical or capsular inclusion onto its surface.

    No tetrahedron inverts or becomes worse than `WORST_SINE` (or than it was). A vertex of the outer boundary slides
    in its plane, or along the edge of two planes; where the boundary is curved or has a corner it stays.

    Args:
        solid: the mesh.
        field: its inclusions, in the object's frame; boxes are left unchanged.

    Returns:
        The solid with its vertices moved.
    """
    slide, shortest = _freedom(solid), _shortest_edges(solid.vertices, solid.tets)
    mover = Mover(solid.vertices, solid.tets, WORST_SINE)
    for part in field.inclusions:
        for reach in REACH if part.kind != "box" else ():
            _pass(part, reach, mover, solid.tets, slide, shortest)
    return dataclasses.replace(solid, vertices=mover.vertices)


def held_stiffness(solid: Solid, field: MaterialField, modulus: np.ndarray | None, values: np.ndarray) -> np.ndarray:
    """What the mesh holds of each part's stiffness over its own, and of what is around them (k + 1,) [-]; 1 of a part
    like its surroundings.

    It is the volume integral of what a part adds to Young's modulus: under 1, a stiff part is too soft or too small in
    the mesh; over 1, a soft part is too large. What a ball adds has a bound, since a stiff one does not strain however
    stiff it is: e / (1 + `ESHELBY` e) with e = E / E_around - 1, as its far field (Eshelby 1957, The determination of
    the elastic field of an ellipsoidal inclusion, Proc. R. Soc. A 241). What is around the parts, a skin or a wall
    perhaps, lacks the volume that they are off by.

    Args:
        solid: the mesh, in the object's frame.
        field: with the parts.
        modulus: of each region (R,) [Pa], see `MaterialField.evaluate`.
        values: modulus of each tetrahedron (m,) [Pa].
    """
    count = len(field.inclusions)
    out, own, volume = np.ones(count + 1), np.zeros(count), tet_volumes(solid.vertices, solid.tets)
    corners = solid.vertices[solid.tets]
    centre = corners.mean(axis=1)
    reach = np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1)
    for k, part in enumerate(field.inclusions):
        others = dataclasses.replace(field, inclusions=field.inclusions[:k] + field.inclusions[k + 1:])
        near = np.flatnonzero(part.distance(centre) < reach)
        steps = int(np.clip(np.ceil(6.0 * reach[near].max(initial=0.0) / part.thickness), 6, _FINEST))
        points = _samples(solid, near, steps)
        whole, without = (f.evaluate(*points, modulus) for f in (field, others))
        own[k] = volume[near] @ (whole != without).mean(axis=1)
        bound = ESHELBY if part.kind == "sphere" else 0.0
        added = volume[near] @ _added(whole, without, bound).mean(axis=1)
        if abs(added) > 1e-9 * float(volume[near].sum()):
            out[k] = volume[near] @ _added(values[near], 1.0 / (1.0 / without).mean(axis=1), bound) / added
        elif part.young_modulus != field.base:
            out[k] = 0.0 if len(near) and not _hidden(part, field, k) else 1.0
    lacks, around = float(np.abs(out[:count] - 1.0) @ own), float(volume.sum() - own.sum())
    out[count] = 1.0 - min(1.0, lacks / max(around, 1e-12 * float(volume.sum()))) if lacks else 1.0
    return out


def _added(modulus: np.ndarray, around: np.ndarray, bound: float) -> np.ndarray:
    """What a part of this ``modulus`` adds to that ``around`` it (...), over that [-], see `held_stiffness`."""
    more = modulus / around - 1.0
    return more / (1.0 + bound * more)


def mixed_modulus(solid: Solid, field: MaterialField, modulus: np.ndarray | None) -> np.ndarray:
    """One modulus for each tetrahedron (m,) [Pa]: the harmonic mean over its volume; arguments as `held_stiffness`.

    Snapping leaves few tetrahedra with two materials. In those the soft part carries the strain (Reuss): an arithmetic
    mean, or the modulus at the Gauss points, would enlarge a stiff inclusion by up to an element, which stiffens case
    S2 by 15-30 %.
    """
    return 1.0 / (1.0 / field.evaluate(*_samples(solid, np.arange(len(solid.tets)), 6), modulus)).mean(axis=1)


def _samples(solid: Solid, which: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (k, s, 3) [m] inside the tetrahedra ``which`` (k,), n cells along an edge, and their regions (k, s)."""
    steps = np.array([(i, j, k, n - i - j - k) for i in range(n + 1) for j in range(n + 1 - i)
                      for k in range(n + 1 - i - j)])
    # moved towards the centroid a little, so that a point on a face belongs to its own tetrahedron
    points = np.einsum("sk,mkc->msc", 0.9 * steps / n + 0.1 / 4.0, solid.vertices[solid.tets[which]])
    return points, np.repeat(np.asarray(solid.region)[which, None], len(steps), axis=1)


def _hidden(part: Inclusion, field: MaterialField, k: int) -> bool:
    """Whether the middle of part ``k`` lies in a later one."""
    n = np.asarray(part.numbers)
    middle = n[:3] if part.kind == "sphere" else 0.5 * (n[:3] + n[3:6])
    return any(float(later.distance(middle)) <= 0.0 for later in field.inclusions[k + 1:])


def part_notes(field: MaterialField, share: np.ndarray) -> list[str]:
    """A sentence for each part whose stiffness in the mesh is off by more than `TOLD`, and for what is around them;
    ``share`` (k + 1,) [-] of `held_stiffness`."""
    notes = []
    for number, (part, held) in enumerate(zip(field.inclusions, share.tolist(), strict=False), start=1):
        if abs(held - 1.0) > TOLD:
            off = f"{100 * abs(held - 1.0):.0f} %"
            notes.append(f"Inclusion {number} ({part.kind}, {1e3 * part.thickness:.3g} mm thick, "
                         f"{part.young_modulus:.3g} Pa) is {off} too {'small or soft' if held < 1.0 else 'large'} in "
                         f"the mesh; give a smaller resolution in [object].")
    if 1.0 - share[-1] > TOLD:
        notes.append(f"What is around the inclusions is off by {100 * (1.0 - share[-1]):.0f} % of its volume in the "
                     f"mesh, for it is thin; give a smaller resolution in [object].")
    return notes


def _pass(part: Inclusion, reach: float, mover: Mover, tets: np.ndarray, slide: np.ndarray,
          shortest: np.ndarray) -> None:
    vertices = mover.vertices
    distance = part.distance(vertices)
    side = np.where(np.abs(distance) <= _ON * shortest, 0, np.sign(distance)).astype(int)
    crossed = (side[tets] > 0).any(axis=1) & (side[tets] < 0).any(axis=1)
    near = np.zeros(len(vertices), bool)
    near[tets[crossed]] = True
    candidates = np.flatnonzero(near & ~mover.taken & (side != 0) & (np.abs(distance) < reach * shortest))
    for v in candidates[np.argsort(np.abs(distance[candidates]) / shortest[candidates], kind="stable")]:
        mine = mover.around[v]
        if not ((side[tets[mine]] > 0).any(axis=1) & (side[tets[mine]] < 0).any(axis=1)).any():
            continue  # its neighbours' moves have already done the work
        target = _onto(part.distance, vertices[v], slide[v], shortest[v])
        if target is None or np.linalg.norm(target - vertices[v]) > reach * shortest[v]:
            continue
        if mover.move(v, target):
            side[v] = 0


def _onto(distance: Callable[[np.ndarray], np.ndarray], start: np.ndarray, slide: np.ndarray,
          size: float) -> np.ndarray | None:
    """The nearest zero of ``distance`` from ``start`` along the directions that ``slide`` (3, 3) leaves, or None."""
    point = start.copy()
    step = 1e-5 * size
    for _ in range(12):
        probes = np.concatenate([point[None], point + step * np.eye(3), point - step * np.eye(3)])
        d = distance(probes)
        if abs(d[0]) < 1e-6 * size:
            return point
        gradient = slide @ ((d[1:4] - d[4:7]) / (2.0 * step))
        steep = float(gradient @ gradient)
        # where the surface is nearly tangent, the vertex would slide far
        if steep < 0.05:
            return None
        point = point - d[0] / steep * gradient
    return None


def _freedom(solid: Solid) -> np.ndarray:
    """Projector (n, 3, 3) onto the directions in which each vertex may move without changing the body's form: those
    across no face of the boundary at it."""
    faces, _ = boundary_faces(solid.tets)
    corner = solid.vertices[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    held = np.zeros((len(solid.vertices), 3, 3))
    np.add.at(held, faces, (normal[:, :, None] * normal[:, None])[:, None])
    value, axes = np.linalg.eigh(held)
    return (axes * (value < 1e-9)[:, None]) @ axes.mT


def _shortest_edges(vertices: np.ndarray, tets: np.ndarray) -> np.ndarray:
    """Length of the shortest edge at each vertex (n,) [m]."""
    pairs = tets[:, list(itertools.combinations(range(4), 2))].reshape(-1, 2)
    out = np.full(len(vertices), np.inf)
    np.minimum.at(out, pairs, np.linalg.norm(vertices[pairs[:, 0]] - vertices[pairs[:, 1]], axis=1)[:, None])
    return out


def limited(mesh: QuadraticMesh, young_modulus: np.ndarray) -> tuple[np.ndarray, float]:
    """The moduli with those of nearly rigid parts limited.

    Args:
        mesh: the mesh.
        young_modulus: E at its Gauss points (m, 4) [Pa].

    Returns:
        The moduli (m, 4) [Pa], and the largest factor by which one was lowered, 1 if none was.
    """
    mean = young_modulus.mean(axis=1)
    stiff = mean > COMPACT * mean.min()
    if not stiff.any():
        return young_modulus, 1.0
    out = young_modulus.copy()
    boundary = np.zeros(len(mesh.points), bool)
    boundary[mesh.surface_nodes()] = True
    which = np.flatnonzero(stiff)
    # stiff tetrahedra that share a corner are one part
    label = joined(mesh.tets[which, :4].reshape(-1, 1), np.repeat(np.arange(len(which)), 4), len(which))
    for part in (which[label == k] for k in range(label.max() + 1)):
        nodes = np.zeros(len(mesh.points), bool)
        nodes[mesh.tets[part]] = True
        around = nodes[mesh.tets].any(axis=1)
        around[part] = False
        if (nodes & boundary).any() or not around.any():
            continue
        # a few tetrahedra at the surface of a part hold a mixture of both materials
        surroundings = np.quantile(mean[around], ENCLOSED, weights=mesh.volume[around], method="inverted_cdf")
        out[part] = np.minimum(out[part], COMPACT * _slenderness(mesh, part) ** 3 * surroundings)
    return out, float((young_modulus / out).max())


def _slenderness(mesh: QuadraticMesh, part: np.ndarray) -> float:
    """Longest extent over thickness of a part of the mesh, by its tetrahedra [-]."""
    corners = mesh.tets[part][:, :4]
    a, b, c = np.moveaxis(mesh.points[boundary_faces(corners)[0]], 1, 0)
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    at = mesh.points[np.unique(corners)]
    longest = 2.0 * np.linalg.norm(at - at.mean(axis=0), axis=1).max()
    return float(longest * area / (2.0 * mesh.volume[part].sum()))
