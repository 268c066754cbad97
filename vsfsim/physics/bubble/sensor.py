"""The air-filled bubble sensor as a body for the solver: inflated once, and in equilibrium at u = 0.

Mount frame: origin at the centre of the rim, x along the long semi-axis, y along the short one, +z out of the dome.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from vsfsim.core.bubble import NODES, Bubble
from vsfsim.core.errors import SceneError
from vsfsim.core.shape import Capsule, Plane, Sphere
from vsfsim.core.solid import Solid
from vsfsim.physics.bubble.sheet import Sheet, inflate
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.elements import gas, hinge, stop, triangle
from vsfsim.physics.elements.block import Block
from vsfsim.physics.linear.rest_factor import RestFactor
from vsfsim.physics.mesh import membrane as membrane_mesh
from vsfsim.physics.mesh.membrane import READ_OUT, TriangleMesh, Wishes, closed
from vsfsim.physics.mesh.quadratic import assemble
from vsfsim.physics.model import Model
from vsfsim.physics.solve import increments

# of a ball's radius: the longest edge where it touches; `vsfsim press punyo --refine 3` tells what half of it changes
SHARE = 1.0 / 3.0
# of the membrane's edge: the same under bodies with edges, which no mesh resolves. A corner of a cube is pushed back
# by a Punyo, 6 mm deep, with 2.80 N on an even mesh, 2.22 N with this, and 2.20 N on edges of 1.2 mm
SHARP = 0.6
_STOP = 10.0  # penalty of the housing over E h: the gas presses a node 4 mm from the next 0.02 mm into it
_SHALLOW = 0.1  # height of the first dome over the short semi-axis


@dataclass(frozen=True)
class FlatMesh:
    """A mesh of the flat skin."""

    flat: np.ndarray
    """Positions before inflation (n, 2) [m]."""
    faces: np.ndarray
    """Triangles, wound outwards (m, 3)."""
    rim: np.ndarray
    """Nodes of the rim in order (r,)."""


@dataclass(frozen=True)
class BubbleModel(Model):
    """A bubble in its mount frame: a `Model` whose rest state, u = 0, is the free inflated dome.

    Its mesh is a `TriangleMesh` of linear triangles and its solid has no tetrahedra. Its moduli, which scale the
    contact, are E h over the mean edge, or over the size of each triangle. Its element size is the mean edge of the
    inflated mesh, where it was refined that at the touched nodes.
    """

    spec: Bubble
    """The bubble that it was built from."""
    flat: np.ndarray
    """Positions of the nodes in the clamped sheet before inflation (n, 2) [m]."""
    dead_volume: float
    """Volume of the chamber behind the plane of the rim [m^3]."""
    read_out: FlatMesh
    """The mesh of the sensor's reading."""

    def least_force(self) -> float:
        """Forces below this count as zero [N]: 1e-7 of the gas's force on the plane of the rim (6 uN for the Punyo),
        which 20,000 nodes balance at u = 0 to 1e-12 only, or 1e-8 of the force that stretches the membrane to twice its
        width, since a membrane with hardly any gas balances its own tension."""
        a, b = self.spec.semi_axes
        return max(1e-7 * self.spec.gauge_pressure * np.pi * a * b, 1e-8 * self.spec.modulus * (a + b))


def wishes(dome: np.ndarray, edge: float, bodies: RigidBodies, poses: np.ndarray, contact_edge: float | None) -> Wishes:
    """Where rigid bodies ask for a finer mesh.

    Args:
        dome: nodes of the free dome (n, 3) [m].
        edge: of its mesh [m].
        bodies: K of them.
        poses: their way, in the mount frame (T, K, 4, 4).
        contact_edge: the edge where they touch [m], or None for `SHARE` of the radius of balls and capsules, nothing
            for planes and `SHARP` for other bodies.
    """
    gap = np.full((len(bodies), len(dome)), np.inf)
    before = poses[:1]
    for pose in poses:
        for way in increments.pieces(before, pose[None], edge, bodies.reaches):
            for k in range(len(bodies)):
                turn, at = way[0, k, :3, :3], way[0, k, :3, 3]
                gap[k] = np.minimum(gap[k], bodies.distance(k, (dome - at) @ turn))
        before = pose[None]
    out = []
    for shape, own in zip(bodies.shapes, gap, strict=True):
        wanted = (contact_edge if contact_edge is not None else SHARE * shape.radius
                  if isinstance(shape, (Sphere, Capsule)) else np.inf if isinstance(shape, Plane) else SHARP * edge)
        if wanted < edge and own.min() < edge:
            # at least the nearest node: a small tip may dent a triangle between its corners
            met = own < max(0.0, float(own.min()) + 1e-9)
            out.append((float(wanted), tuple(int(i) for i in np.flatnonzero(met))))
    return tuple(out)


def flat_mesh(spec: Bubble, nodes: int | None = None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Flat positions (n, 2) [m], triangles (f, 3) and rim (r,). The mesh with the default number of nodes contains the
    nodes of the read-out mesh."""
    a, b = spec.semi_axes
    nodes = spec.nodes if nodes is None else nodes
    if nodes != NODES:
        return membrane_mesh.ellipse(a, b, nodes)
    mesh = membrane_mesh.ellipse(a, b, READ_OUT)
    return membrane_mesh.cut(*mesh, (a, b), np.ones(len(mesh[1]), bool), mesh[0])[:3]


def elastic_blocks(spec: Bubble, points: np.ndarray, flat: np.ndarray, faces: np.ndarray) -> tuple[Block, Block]:
    """Membrane and bending elements of a sheet that was stretched by ``spec.pre_stretch`` when it was clamped, with
    u = 0 at ``points`` (n, 3) [m].

    The rim may rotate. A clamp would bend the sheet over sqrt(D / tension) = 0.3 mm, less than the size of an element,
    and the dome would depend on the mesh.
    """
    rest = flat / spec.pre_stretch
    return (triangle.block(faces, points, rest[faces], spec.modulus),
            hinge.block(faces, points, rest, spec.bending))


def _free(nodes: int, rim: np.ndarray) -> np.ndarray:
    free = np.ones((nodes, 3))
    free[rim] = 0.0
    return free.ravel()


def _inflated(spec: Bubble, mesh: tuple[np.ndarray, np.ndarray, np.ndarray],
              known: tuple[np.ndarray, np.ndarray, np.ndarray] | None, where: str) -> np.ndarray:
    """Displacements (n, 3) [m] from a flat mesh to the free dome, from the nodes, triangles and displacements of a
    ``known`` dome on another mesh; where that does not converge, or without one, by following the branch."""
    flat, faces, rim = mesh
    points = np.column_stack([flat, np.zeros(len(flat))])
    own = Sheet(points, elastic_blocks(spec, points, flat, faces), closed(faces, rim), _free(len(flat), rim))
    if known is not None:
        triangle, weights = containing(*known[:2], flat)
        weights[np.abs(weights) < 1e-12] = 0.0
        guess = (interpolation(known[1][triangle], weights, len(known[0])) @ known[2]).ravel() * own.free
        found = own.balanced(guess, spec.gauge_pressure, iterations=20)
        if found is not None:
            return found.displacement.reshape(-1, 3)
    (a, b), begin = spec.semi_axes, np.zeros((len(flat), 3))
    begin[:, 2] = _SHALLOW * b * (1.0 - (flat[:, 0] / a) ** 2 - (flat[:, 1] / b) ** 2)  # of a shallow dome
    return inflate(own, begin.ravel(), spec.gauge_pressure, where=where).displacement.reshape(-1, 3)


def containing(flat: np.ndarray, faces: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The triangle of a plane mesh with nodes ``flat`` (n, 2) [m] that holds each of some points ``at`` (k, 2) [m], or
    for one outside the one whose smallest weight is largest: its number (k,), and the barycentric weights (k, 3)."""
    from scipy.spatial import cKDTree

    corners = flat[faces]
    inverse = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    near = np.sort(cKDTree(corners.mean(axis=1)).query(at, k=min(24, len(faces)))[1], axis=1)
    share = np.einsum("kcij,kcj->kci", inverse[near], at[:, None] - corners[near][:, :, 0])
    weights = np.concatenate([1.0 - share.sum(axis=2, keepdims=True), share], axis=2)
    rows, best = np.arange(len(at)), weights.min(axis=2).argmax(axis=1)
    return near[rows, best], weights[rows, best]


def interpolation(nodes: np.ndarray, weights: np.ndarray, count: int) -> sp.csr_matrix:
    """Matrix (k, count) that interpolates values with ``weights`` (k, 3) of ``nodes`` (k, 3); its transpose distributes
    forces."""
    return sp.csr_matrix((weights.ravel(), (np.repeat(np.arange(len(nodes)), 3), nodes.ravel())),
                         shape=(len(nodes), count))


@functools.lru_cache(maxsize=8)
def build_bubble(spec: Bubble, *, finer: Wishes = (), where: str = "[sensor]") -> BubbleModel:
    """The model of a bubble, made once in a process.

    Args:
        spec: the bubble.
        finer: where its mesh is refined; the element size is that at the nodes that it names.
        where: scene and section, for messages.

    Raises:
        SceneError: the gauge pressure is beyond the membrane's limit point, or the dome holds more than the gas.
    """
    flat, faces, rim = flat_mesh(spec)
    known = None
    if finer:
        even = build_bubble(spec, where=where)
        flat, faces, rim = membrane_mesh.finer(even.flat, even.mesh.faces, even.mesh.rim, spec.semi_axes,
                                               even.mesh.points, finer)
        dome = even.mesh.points - np.column_stack([even.flat, np.zeros(len(even.flat))])
        known = even.flat, even.mesh.faces, dome
    elif spec.nodes > READ_OUT:
        # the branch is followed on the read-out mesh, whose dome is the guess for the fine one
        coarse = flat_mesh(spec, READ_OUT)
        known = *coarse[:2], _inflated(spec, coarse, None, where)
    points = np.column_stack([flat, np.zeros(len(flat))]) + _inflated(spec, (flat, faces, rim), known, where)
    faces = faces.astype(np.int32)
    mesh = TriangleMesh.of(points, faces, rim)
    inside = float(mesh.volume[0])
    dead = spec.gas_volume - inside
    if dead < 0.0:
        raise SceneError(f"{where}: gas_volume is {1e6 * spec.gas_volume:.4g} mL, but the inflated dome alone holds "
                         f"{1e6 * inside:.4g} mL; gas_volume is all of "
                         "the enclosed air, dome and chamber behind it, so give more than that (in m^3).")
    air = gas.block(closed(faces, rim), points, pressure=spec.gauge_pressure, volume=inside, gamma=spec.gamma,
                    ambient=spec.ambient_pressure, dead_volume=dead)
    free = _free(len(points), rim)
    # the housing: a plate at the floor of the chamber, before every node that is not clamped
    stopped = np.flatnonzero((free[2::3] > 0.0) & (points[:, 2] >= -spec.chamber))
    plate = stop.block(stopped, int(rim[0]), points, _STOP * spec.modulus, below=spec.chamber)
    blocks = (*elastic_blocks(spec, points, flat, faces), air, plate)
    factor = RestFactor.of(assemble(len(points), blocks), free, points, gas.rest_coupling(air, len(points)))
    edge = mesh.edge(np.array(sorted({node for _, nodes in finer for node in nodes}), int))
    read_out = FlatMesh(*membrane_mesh.ellipse(*spec.semi_axes, READ_OUT))
    nothing = Solid(np.zeros((0, 3)), np.zeros((0, 4), np.int64), np.zeros(0, np.int64), ("membrane",))
    return BubbleModel(mesh, blocks, np.array([spec.modulus / edge]), free, np.zeros(points.size),
                       spec.modulus / np.sqrt(2.0 * mesh.face_area()), nothing,
                       edge, factor, spec, flat, dead, read_out)
