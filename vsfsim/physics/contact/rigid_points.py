"""Contact of the object's surface with rigid bodies: a stiff penalty along the normal, Coulomb friction across it.

    Pi_n = sum_q w_q/2 <-g(x_q)>^2,     f_n = -w_q g n                         where g < 0
    Pi_t = sum_q { v_q/2 |d|^2                       |d| <= tau/v_q   (sticks)
                 { tau |d| - tau^2/(2 v_q)           else             (slips),     tau = mu f_n, found before

integrated over six Gauss points of every quadratic surface triangle (exact to degree 4), or of every part of a linear
one, never at vertices alone. g is the distance to the nearest rigid body, d the tangential way of the point from its
anchor, the spot of the body where it last stuck. The limit tau and the normal of the tangent plane are held while
Newton's method brings the forces into balance, which then has a potential, and renewed (`relaxation`) until they are
the present ones (a sequence of Tresca problems): the law is Coulomb's. Slipping points drag their anchor along when
the frame is done: stick-slip with history. v_q = STICK w_q: a stuck point gives way by a thousandth of an element at
most.
w_q = area x PENALTY x modulus / element size: so stiff that the penetration stays far under 1 % of the element size
(it is measured and stored in every frame), and soft enough that float64 keeps its digits; the solver inverts
this block exactly, so stiffness costs no iterations.
A point that the body would push out on its far side, through the object, is *astray*: it is not pushed, and a state
with one is no solution.
Everything here is double precision: a contact force is a stiff spring on a small difference of positions.
"""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.contact import relaxation, sdf
from vsfsim.physics.mesh.quadratic import QuadraticMesh

PENALTY = 1000.0  # contact pressure of a penetration of one element size, in units of the modulus under the surface
# tangential stiffness of a stuck point over the normal one: softer, since stick and slip meet in a kink of that width
STICK = 0.1
# cosine between the object's and the body's outward normal above which a point inside the body counts as astray
FACING = 0.5

# Degree-4 rule with six points on the triangle (Strang and Fix 1973; Cowper 1973), weights sum to 1.
_A, _WA = 0.445948490915965, 0.223381589678011
_B, _WB = 0.091576213509771, 0.109951743655322
_BARY = np.array([[1 - 2 * a if i == k else a for i in range(3)] for a in (_A, _B) for k in range(3)])
WEIGHTS = np.array([_WA] * 3 + [_WB] * 3)


def shape_values(bary: np.ndarray) -> np.ndarray:
    """Quadratic shape functions of a triangle's six nodes (k, 6) at barycentric coordinates (k, 3)."""
    return np.stack([*(bary[:, k] * (2 * bary[:, k] - 1) for k in range(3)),
                     *(4 * bary[:, i] * bary[:, j] for i, j in ((0, 1), (1, 2), (2, 0)))], axis=1)


def shape_table(corners: int, cuts: int = 1) -> np.ndarray:
    """Shape values of the six Gauss points of every part of a surface triangle (parts, 6 points, 6 nodes).

    Args:
        corners: nodes of the triangle: 6 quadratic, or 3 linear, whose last three columns are 0. cuts: parts along each
        edge; ``cuts`` ** 2 in all.
    """
    parts = []
    for i in range(cuts):
        for j in range(cuts - i):
            ways = [((i, j), (i + 1, j), (i, j + 1))] + ([((i + 1, j), (i + 1, j + 1), (i, j + 1))] if i + j < cuts - 1
                                                         else [])
            parts += [[[1.0 - (a + b) / cuts, a / cuts, b / cuts] for a, b in way] for way in ways]
    bary = np.einsum("qk,pkc->pqc", _BARY, np.array(parts))
    if corners == 3:
        return np.concatenate([bary, np.zeros_like(bary)], axis=2)
    return shape_values(bary.reshape(-1, 3)).reshape(len(parts), len(_BARY), 6)


def shape_grid(steps: int) -> np.ndarray:
    """Shape values (s, 6) of a linear triangle on a grid of ``steps`` along each edge."""
    bary = np.array([(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]) / steps
    return np.hstack([bary, np.zeros_like(bary)])


@functools.cache
def kernels() -> Any:
    """The contact kernels and their types.

    Owners of anchors are coded: -1 none, j >= 0 body j, -2 - j body j with an anchor that this frame made and may still
    move.
    """
    real = wp.float64
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    module = "vsfsim_contact"
    probe = sdf.functions(real, module)
    relaxed = relaxation.function(real, module)
    most_anchorings = wp.constant(relaxation.ANCHORINGS)
    facing = wp.constant(real(FACING))

    @wp.func(module=module)
    def place(shape: wp.array3d(dtype=real), q: int, b: int, f: int, local: wp.array3d(dtype=wp.int32),
              x: wp.array2d(dtype=vec3)):
        # Gauss point q of part f of touch b; the parts of one face follow one another
        part = f % shape.shape[0]
        out = vec3()
        for a in range(6):
            out += shape[part, q, a] * x[b, local[b, f, a]]
        return out

    @wp.func(module=module)
    def axis_across(m: vec3):
        # a unit vector across m
        out = wp.cross(m, vec3(real(0.0), real(0.0), real(1.0)))
        if wp.abs(m[2]) > real(0.9):
            out = wp.cross(m, vec3(real(1.0), real(0.0), real(0.0)))
        return wp.normalize(out)

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # model
        shape: wp.array3d(dtype=real),
        bodies: probe.Bodies,
        count: int,
        columns: wp.array(dtype=wp.int32),
        local: wp.array3d(dtype=wp.int32),
        stiffness: wp.array3d(dtype=real),
        softening: wp.array(dtype=real),
        stick: real,
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        anchor_in: wp.array3d(dtype=vec3),
        owner_in: wp.array3d(dtype=wp.int32),
        limit_in: wp.array3d(dtype=real),
        across_in: wp.array3d(dtype=vec3),
        # state out
        gap_out: wp.array3d(dtype=real),
        body_out: wp.array3d(dtype=wp.int32),
        normal_out: wp.array3d(dtype=vec3),
        force_out: wp.array3d(dtype=vec3),
        rows_out: wp.array3d(dtype=mat33),
        bend_out: wp.array3d(dtype=mat33),
        slips_out: wp.array3d(dtype=wp.int32),
        astray_out: wp.array2d(dtype=wp.int32),
        energy_out: wp.array2d(dtype=real),
    ):
        f, k = wp.tid()
        b = columns[k]
        energy = real(0.0)
        astray = int(0)  # noqa: UP018, RUF046
        corner = x_in[b, local[b, f, 0]]
        outward = wp.cross(x_in[b, local[b, f, 1]] - corner, x_in[b, local[b, f, 2]] - corner)
        outward = outward / wp.max(wp.length(outward), real(1e-30))
        for q in range(6):
            force = vec3()
            rows = mat33()
            bend = mat33()
            gap = real(1e30)
            slips = int(0)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
            w = softening[b] * stiffness[b, f, q]
            if w > real(0.0):
                p = place(shape, q, b, f, local, x_in)
                near = int(0)  # noqa: UP018, RUF046
                for j in range(count):
                    g = probe.gap(bodies, j, wp.transpose(turn[b, j]) * (p - origin[b, j]))
                    if g < gap:
                        gap = g
                        near = j
                body_out[b, f, q] = near
                if gap < real(0.0):
                    r = turn[b, near]
                    spot = wp.transpose(r) * (p - origin[b, near])
                    n = r * probe.normal(bodies, near, spot)
                    if wp.dot(n, outward) > facing:
                        # the nearest way out leads through the object: the surface has come past the body's middle
                        astray += 1
                        gap = real(0.0)
                if gap < real(0.0):
                    normal_out[b, f, q] = n
                    force = -w * gap * n
                    root = wp.sqrt(w)
                    for c in range(3):
                        rows[0, c] = root * n[c]
                    bend = w * gap * (r * probe.curvature(bodies, near, spot) * wp.transpose(r))
                    energy += real(0.5) * w * gap * gap
                # friction acts under the limit that was found last, on points that have left since, too: only so there
                # is one potential
                limit = limit_in[b, f, q]
                if limit > real(0.0):
                    owner = owner_in[b, f, q]
                    if owner < -1:
                        owner = -2 - owner
                    m = across_in[b, f, q]
                    d = p - (origin[b, owner] + turn[b, owner] * anchor_in[b, f, q])
                    d = d - wp.dot(d, m) * m
                    way = wp.length(d)
                    # two directions across m: along the slip, if there is one, and across it
                    e = axis_across(m)
                    if way > real(0.0):
                        e = d / way
                    side = wp.cross(m, e)
                    v = stick * w
                    if v * way <= limit:
                        force -= v * d
                        energy += real(0.5) * v * way * way
                        for c in range(3):
                            rows[1, c] = wp.sqrt(v) * e[c]
                            rows[2, c] = wp.sqrt(v) * side[c]
                    else:
                        force -= limit * e
                        energy += limit * way - real(0.5) * limit * limit / v
                        slips = 1
                        # along the slip the force is constant
                        for c in range(3):
                            rows[2, c] = wp.sqrt(limit / way) * side[c]
            gap_out[b, f, q] = gap
            force_out[b, f, q] = force
            rows_out[b, f, q] = rows
            bend_out[b, f, q] = bend
            slips_out[b, f, q] = slips
        energy_out[b, f] = energy
        astray_out[b, f] = astray

    @wp.kernel(module=module, enable_backward=False)
    def lag(
        # model
        shape: wp.array3d(dtype=real),
        bodies: probe.Bodies,
        columns: wp.array(dtype=wp.int32),
        local: wp.array3d(dtype=wp.int32),
        stiffness: wp.array3d(dtype=real),
        softening: wp.array(dtype=real),
        friction: wp.array(dtype=real),
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        origin_before: wp.array2d(dtype=vec3),
        turn_before: wp.array2d(dtype=mat33),
        x_before: wp.array2d(dtype=vec3),
        gap_in: wp.array3d(dtype=real),
        body_in: wp.array3d(dtype=wp.int32),
        normal_in: wp.array3d(dtype=vec3),
        # state out
        anchor_out: wp.array3d(dtype=vec3),
        owner_out: wp.array3d(dtype=wp.int32),
        limit_out: wp.array3d(dtype=real),
        across_out: wp.array3d(dtype=vec3),
        anchorings_out: wp.array3d(dtype=wp.int32),
        damping_out: wp.array3d(dtype=real),
        change_out: wp.array3d(dtype=real),
        miss_out: wp.array3d(dtype=real),
    ):
        # the limit and the tangent plane of the next iteration; anchors of points that have come into touch in this
        # frame
        f, k = wp.tid()
        b = columns[k]
        for q in range(6):
            limit = real(0.0)
            g = gap_in[b, f, q]
            if g < real(0.0):
                j = body_in[b, f, q]
                limit = -friction[j] * softening[b] * stiffness[b, f, q] * g
                across_out[b, f, q] = wp.normalize(normal_in[b, f, q])
                owner = owner_out[b, f, q]
                if owner != j and (owner != -2 - j or anchorings_out[b, f, q] < most_anchorings):
                    anchorings_out[b, f, q] = anchorings_out[b, f, q] + 1
                    # where the body's surface came upon it in this step, had it stood still; or where it is, if the
                    # object bulged up
                    p0 = place(shape, q, b, f, local, x_before)
                    start = wp.transpose(turn_before[b, j]) * (p0 - origin_before[b, j])
                    stop = wp.transpose(turn[b, j]) * (p0 - origin[b, j])
                    g0 = wp.max(probe.gap(bodies, j, start), real(0.0))
                    g1 = probe.gap(bodies, j, stop)
                    if g1 < real(0.0):
                        anchor_out[b, f, q] = start + (g0 / (g0 - g1)) * (stop - start)
                    else:
                        p1 = place(shape, q, b, f, local, x_in)
                        anchor_out[b, f, q] = wp.transpose(turn[b, j]) * (p1 - origin[b, j])
                    owner_out[b, f, q] = -2 - j
            limit, damping, change, miss = relaxed(limit, limit_out[b, f, q], damping_out[b, f, q], change_out[b, f, q])
            limit_out[b, f, q] = limit
            damping_out[b, f, q] = damping
            change_out[b, f, q] = change
            miss_out[b, f, q] = miss

    @wp.kernel(module=module, enable_backward=False)
    def settle(
        # model
        shape: wp.array3d(dtype=real),
        columns: wp.array(dtype=wp.int32),
        local: wp.array3d(dtype=wp.int32),
        stiffness: wp.array3d(dtype=real),
        stick: real,
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        gap_in: wp.array3d(dtype=real),
        body_in: wp.array3d(dtype=wp.int32),
        limit_in: wp.array3d(dtype=real),
        across_in: wp.array3d(dtype=vec3),
        # state out
        anchor_out: wp.array3d(dtype=vec3),
        owner_out: wp.array3d(dtype=wp.int32),
    ):
        # the frame is done: points that slipped drag their anchor along, points that left forget it
        f, k = wp.tid()
        b = columns[k]
        for q in range(6):
            owner = owner_out[b, f, q]
            if gap_in[b, f, q] >= real(0.0):
                owner_out[b, f, q] = -1
            elif owner != -1:
                if owner < -1:
                    owner = -2 - owner
                j = body_in[b, f, q]
                if owner != j:
                    owner_out[b, f, q] = -1
                else:
                    owner_out[b, f, q] = j
                    m = across_in[b, f, q]
                    at = origin[b, j] + turn[b, j] * anchor_out[b, f, q]
                    d = place(shape, q, b, f, local, x_in) - at
                    d = d - wp.dot(d, m) * m
                    way = wp.length(d)
                    v = stick * stiffness[b, f, q]
                    limit = limit_in[b, f, q]
                    if v * way > limit:
                        at = at + (real(1.0) - limit / (v * way)) * d
                        anchor_out[b, f, q] = wp.transpose(turn[b, j]) * (at - origin[b, j])

    @wp.kernel(module=module, enable_backward=False)
    def nearest(
        # model
        bodies: probe.Bodies,
        count: int,
        # state in
        origin: wp.array3d(dtype=vec3),
        turn: wp.array3d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        # state out
        gap_out: wp.array2d(dtype=real),
    ):
        # least gap of every point over all poses (T, B, K) and bodies; x_in (s, 1) serves all touches, (s, B) each its
        # own
        i, b = wp.tid()
        p = x_in[i, wp.min(b, x_in.shape[1] - 1)]
        least = real(1e30)
        for t in range(origin.shape[0]):
            for j in range(count):
                least = wp.min(least, probe.gap(bodies, j, wp.transpose(turn[t, b, j]) * (p - origin[t, b, j])))
        gap_out[i, b] = least

    class Kernels:
        pass

    out = Kernels()
    out.evaluate, out.lag, out.settle, out.nearest = evaluate, lag, settle, nearest
    out.vec3, out.mat33, out.sdf = vec3, mat33, probe
    return out


@dataclass(frozen=True)
class Patch:
    """The part of the surface that one touch can reach.

    faces: boundary triangles (f,), increasing. nodes: their nodes (s,). local: position of the nodes of each part of a
    face in ``nodes``, parts of one face together (f parts, 6); a linear face has three, and any number in the other
    columns.
    stiffness: w_q of each Gauss point (f parts, 6) [N/m].
    """

    faces: np.ndarray
    nodes: np.ndarray
    local: np.ndarray
    stiffness: np.ndarray


def make_patch(mesh: QuadraticMesh, faces: np.ndarray, area: np.ndarray, modulus: np.ndarray, *, parts: int = 1,
               factor: float = 1.0) -> Patch:
    """The patch of some boundary triangles.

    Args:
        mesh: the mesh; its faces have six nodes, or three. faces: their indices (f,). area: their areas (f,) [m^2].
        modulus: Young's modulus under them (f,) [Pa]. parts: that each face is cut into, see `shape_table`.
        factor: on the stiffness.
    """
    corners = mesh.faces.shape[1]
    nodes, local = np.unique(mesh.faces[faces], return_inverse=True)
    padded = np.zeros((len(faces), 6), np.int64)
    padded[:, :corners] = local.reshape(len(faces), corners)
    pressure_per_metre = factor * PENALTY * modulus / np.sqrt(area)
    stiffness = (area / parts * pressure_per_metre)[:, None] * WEIGHTS[None, :]
    return Patch(faces, nodes, np.repeat(padded, parts, axis=0), np.repeat(stiffness, parts, axis=0))
