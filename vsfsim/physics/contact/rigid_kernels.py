"""The kernels of the contact of an object's surface with rigid bodies: a stiff penalty, and Coulomb friction.

    Pi_n = sum_q w_q/2 <-g(x_q)>^2,     f_n = -w_q g n     where g < 0

g is the distance to the nearest rigid body at a Gauss point of the surface, w_q its stiffness (`patch`); or that of a
point on an edge of a body to a face (`body_points`: part f then has one point, on body ``host``). Under round bodies,
edges and corners the first part of the penetration is softer: it stands for the indentation that the mesh is too
coarse for (`local_indentation`). On a sheet under bodies with edges the stiffness grows with the depth down to h
(`patch.sheet_contact`), and the force is w_q g^2 / (2 h) there. Friction acts as `friction` says, with the tangential
stiffness STICK w_q: a stuck point gives way by a thousandth of an element at most. Slipping points drag their anchor
along when the frame is done: stick-slip with history. Where ``coulomb`` is 1 the limit of a point is mu f_n as it is
now, so that the stiffness couples friction to the gap and is not symmetric; it has no potential.

A point that the body would push out through the object is on the wrong side of the body. It is not pushed, and a state
with such a point is no solution. All numbers are float64: a contact force is a stiff spring on a small difference of
positions.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.contact import friction, sdf
from vsfsim.physics.runtime import mat33, real, vec3

STICK = 0.1
"""Tangential stiffness of a stuck point over the normal one [-]: softer, since stick and slip meet in a kink of that
width."""
FACING = 0.5
"""Cosine between the object's and the body's outward normal above which a point inside the body is on its wrong
side."""

_ADVANCES = wp.constant(24)  # of a point along its way, each as far as it surely meets nothing


@functools.cache
def kernels() -> Any:
    """The contact kernels, their types, and the signed distances that they use (``sdf``).

    ``Points`` are the contact points of B touches, six for each of f parts; arrays are written in place.
    The owner of an anchor is a code: -1 is none, j >= 0 is body j, and -2 - j is body j with an anchor that this step
    made and may still move.
    """
    module = "vsfsim_contact"
    # loops over the points of a part end at a variable: unrolled, their six copies take Warp seconds to compile
    probe = sdf.functions(real, module)
    most_anchorings = wp.constant(friction.ANCHORINGS)
    facing, stick = wp.constant(real(FACING)), wp.constant(real(STICK))

    class Points:
        # model
        shape: wp.array4d(dtype=real)  # shape values of the points of each part (B, f, 6, 6)
        local: wp.array3d(dtype=wp.int32)  # nodes of each part (B, f, 6)
        stiffness: wp.array3d(dtype=real)  # w_q (B, f, 6) [N/m]
        share: wp.array3d(dtype=real)  # of it that acts down to the depth `soft`, see `local_indentation` [-]
        soft: wp.array2d(dtype=real)  # (B, f) [m]
        host: wp.array2d(dtype=wp.int32)  # body whose point a part is, see `body_points`; -1 for parts of faces
        spot: wp.array2d(dtype=vec3)  # that point, in its body's frame [m]
        leave: wp.array2d(dtype=vec3)  # direction in which it leaves the object [-]
        coulomb: wp.array(dtype=real)  # (B,), see `rigid_contact`
        coefficient: wp.array(dtype=real)  # of friction, of each body (K,) [-]
        onset: real  # of a sheet, see `patch.sheet_contact` [m]
        # bodies (B, K) and nodes of the patches (B, s), now and when the step began
        origin: wp.array2d(dtype=vec3)
        turn: wp.array2d(dtype=mat33)
        origin_before: wp.array2d(dtype=vec3)
        turn_before: wp.array2d(dtype=mat33)
        x: wp.array2d(dtype=vec3)
        x_before: wp.array2d(dtype=vec3)
        # memory of friction, and its iteration in a step, see `friction`
        anchor: wp.array3d(dtype=vec3)
        owner: wp.array3d(dtype=wp.int32)
        limit: wp.array3d(dtype=real)
        across: wp.array3d(dtype=vec3)
        renewals: wp.array(dtype=wp.int32)
        anchorings: wp.array3d(dtype=wp.int32)
        residual: wp.array3d(dtype=real)
        # what `evaluate` finds
        gap: wp.array3d(dtype=real)
        body: wp.array3d(dtype=wp.int32)
        normal: wp.array3d(dtype=vec3)
        force: wp.array3d(dtype=vec3)
        stiff: wp.array3d(dtype=mat33)  # [N/m], without its geometric term
        geometric: wp.array3d(dtype=mat33)
        slips: wp.array3d(dtype=wp.int32)
        wrong_side: wp.array2d(dtype=wp.int32)
        energy: wp.array2d(dtype=real)

    Points = wp.struct(Points, module=module)

    @wp.func(module=module)
    def place(c: Points, x: wp.array2d(dtype=vec3), b: int, f: int, q: int):
        # Gauss point q of part f of touch b
        out = vec3()
        for a in range(6):
            out += c.shape[b, f, q, a] * x[b, c.local[b, f, a]]
        return out

    @wp.func(module=module)
    def push(w: real, share: real, soft: real, onset: real, depth: real):
        # normal force, stiffness and energy of a point at a depth >= 0; the stiffness is share w down to the depth soft
        # or, on a sheet, grows from 0 to w down to the depth onset
        if depth < onset:
            slope = w * depth / onset
            return real(0.5) * slope * depth, slope, slope * depth * depth / real(6.0)
        if onset > real(0.0):
            more = depth - onset
            force = real(0.5) * w * onset
            return (force + w * more, w, w * onset * onset / real(6.0) + force * more + real(0.5) * w * more * more)
        if depth <= soft:
            return share * w * depth, share * w, real(0.5) * share * w * depth * depth
        more = depth - soft
        force = share * w * soft
        return (force + w * more, w, real(0.5) * force * soft + force * more + real(0.5) * w * more * more)

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(c: Points, bodies: probe.Bodies, count: int, columns: wp.array(dtype=wp.int32)):
        f, k = wp.tid()
        b = columns[k]
        energy = real(0.0)
        wrong = int(0)  # noqa: UP018, RUF046
        corner = c.x[b, c.local[b, f, 0]]
        outward = wp.cross(c.x[b, c.local[b, f, 1]] - corner, c.x[b, c.local[b, f, 2]] - corner)
        outward = outward / wp.max(wp.length(outward), real(1e-30))
        for q in range(c.shape.shape[2]):
            force = vec3()
            stiff = mat33()
            geometric = mat33()
            gap = real(1e30)
            slips = int(0)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
            w = c.stiffness[b, f, q]
            if w > real(0.0):
                p = place(c, c.x, b, f, q)
                near = c.host[b, f]
                n = -c.leave[b, f]
                if near >= 0:  # a point of body ``near`` against the face
                    gap = wp.dot(n, p - (c.origin[b, near] + c.turn[b, near] * c.spot[b, f]))
                else:
                    near = int(0)  # noqa: UP018, RUF046
                    for j in range(count):
                        g = probe.gap(bodies, j, wp.transpose(c.turn[b, j]) * (p - c.origin[b, j]))
                        if g < gap:
                            gap = g
                            near = j
                    if gap < real(0.0):
                        r = c.turn[b, near]
                        inside = wp.transpose(r) * (p - c.origin[b, near])
                        n = r * probe.normal(bodies, near, inside)
                        geometric = -(r * probe.curvature(bodies, near, inside) * wp.transpose(r))
                        if wp.dot(n, outward) > facing:
                            # the nearest way out leads through the object: the surface has passed the body's middle
                            wrong += 1
                            gap = real(0.0)
                c.body[b, f, q] = near
                limit = c.limit[b, f, q]
                slope = real(0.0)
                if gap < real(0.0):
                    c.normal[b, f, q] = n
                    size, slope, work = push(w, c.share[b, f, q], c.soft[b, f], c.onset, -gap)
                    force = size * n
                    stiff = slope * wp.outer(n, n)
                    geometric = size * geometric
                    energy += work
                    if c.coulomb[b] > real(0.0) and limit > real(0.0):
                        limit = c.coefficient[near] * size
                else:
                    geometric = mat33()
                    # the limit that was found last acts on points that have left since, too: only so there is a
                    # potential
                    limit = (real(1.0) - c.coulomb[b]) * limit
                if limit > real(0.0):
                    owner = c.owner[b, f, q]
                    if owner < -1:
                        owner = -2 - owner
                    m = c.across[b, f, q]
                    d = friction.tangential(p - (c.origin[b, owner] + c.turn[b, owner] * c.anchor[b, f, q]), m)
                    v = stick * w
                    energy += friction.energy(wp.length(d), v, limit)
                    along, sideways = friction.hessian_roots(d, m, v, limit)
                    force -= friction.force(d, v, limit)
                    stiff += wp.outer(along, along) + wp.outer(sideways, sideways)
                    if not friction.sticks(wp.length(d), v, limit):
                        slips = 1
                        # of a limit that follows the normal force
                        stiff -= (c.coulomb[b] * c.coefficient[near] * slope) * wp.outer(d / wp.length(d), n)
            c.gap[b, f, q] = gap
            c.force[b, f, q] = force
            c.stiff[b, f, q] = stiff
            c.geometric[b, f, q] = geometric
            c.slips[b, f, q] = slips
        c.energy[b, f] = energy
        c.wrong_side[b, f] = wrong

    @wp.kernel(module=module, enable_backward=False)
    def reach(
        # model
        c: Points,
        bodies: probe.Bodies,
        count: int,
        columns: wp.array(dtype=wp.int32),
        core: wp.array(dtype=real),
        # state in
        move_in: wp.array2d(dtype=vec3),
        # state out
        part_out: wp.array2d(dtype=real),
    ):
        # part of the move (k, s) of the nodes after which the first point of a part meets the inner body of any body,
        # which begins at the depth `core`; 1 where none does, and for points that are in it already
        f, k = wp.tid()
        b = columns[k]
        part = real(1.0)
        for q in range(c.shape.shape[2]):
            if c.stiffness[b, f, q] > real(0.0) and c.host[b, f] < 0:
                p = place(c, c.x, b, f, q)
                d = vec3()
                for a in range(6):
                    d += c.shape[b, f, q, a] * move_in[k, c.local[b, f, a]]
                speed = wp.length(d)
                for j in range(count):
                    t = real(0.0)
                    ends = int(0)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
                    while ends < _ADVANCES and t < part:
                        at = wp.transpose(c.turn[b, j]) * (p + t * d - c.origin[b, j])
                        room = probe.gap(bodies, j, at) + core[j]
                        ends += 1
                        if room <= real(0.0):
                            ends = int(_ADVANCES)
                        else:
                            t += room / wp.max(speed, real(1e-30))
                    if t > real(0.0):
                        part = wp.min(part, t)
        part_out[k, f] = part

    @wp.kernel(module=module, enable_backward=False)
    def update_friction(c: Points, bodies: probe.Bodies, count: int, columns: wp.array(dtype=wp.int32)):
        # the limit and the tangent plane of the next iteration; anchors of points that came into contact in this step
        f, k = wp.tid()
        b = columns[k]
        for q in range(c.shape.shape[2]):
            limit = real(0.0)
            g = c.gap[b, f, q]
            if g < real(0.0):
                j = c.body[b, f, q]
                size, _slope, _work = push(c.stiffness[b, f, q], c.share[b, f, q], c.soft[b, f], c.onset, -g)
                limit = c.coefficient[j] * size
                c.across[b, f, q] = wp.normalize(c.normal[b, f, q])
                owner = c.owner[b, f, q]
                if owner != j and (owner != -2 - j or c.anchorings[b, f, q] < most_anchorings):
                    c.anchorings[b, f, q] = c.anchorings[b, f, q] + 1
                    # where the body's surface met the point in this step if the point had stood still; where the point
                    # is now if it did not, because the object bulged up
                    p0 = place(c, c.x_before, b, f, q)
                    start = wp.transpose(c.turn_before[b, j]) * (p0 - c.origin_before[b, j])
                    stop = wp.transpose(c.turn[b, j]) * (p0 - c.origin[b, j])
                    g0 = wp.max(probe.gap(bodies, j, start), real(0.0))
                    g1 = probe.gap(bodies, j, stop)
                    if c.host[b, f] >= 0:
                        c.anchor[b, f, q] = c.spot[b, f]
                    elif g1 < real(0.0):
                        c.anchor[b, f, q] = start + (g0 / (g0 - g1)) * (stop - start)
                    else:
                        p1 = place(c, c.x, b, f, q)
                        c.anchor[b, f, q] = wp.transpose(c.turn[b, j]) * (p1 - c.origin[b, j])
                    c.owner[b, f, q] = -2 - j
            residual = real(0.0)
            if c.coulomb[b] == real(0.0):
                limit, residual = friction.relaxed(limit, c.limit[b, f, q], c.renewals[b])
            c.limit[b, f, q] = limit
            c.residual[b, f, q] = residual

    @wp.kernel(module=module, enable_backward=False)
    def end_step(c: Points, bodies: probe.Bodies, count: int, columns: wp.array(dtype=wp.int32)):
        # points that slipped drag their anchor along, points that left lose it
        f, k = wp.tid()
        b = columns[k]
        for q in range(c.shape.shape[2]):
            owner = c.owner[b, f, q]
            if owner < -1:
                owner = -2 - owner
            j = c.body[b, f, q]
            if c.gap[b, f, q] >= real(0.0) or owner != j:
                c.owner[b, f, q] = -1
                c.limit[b, f, q] = real(0.0)
            else:
                c.owner[b, f, q] = j
                m = c.across[b, f, q]
                at = c.origin[b, j] + c.turn[b, j] * c.anchor[b, f, q]
                d = friction.tangential(place(c, c.x, b, f, q) - at, m)
                way = wp.length(d)
                v = stick * c.stiffness[b, f, q]
                limit = c.limit[b, f, q]
                if not friction.sticks(way, v, limit):
                    at = at + (real(1.0) - limit / (v * way)) * d
                    c.anchor[b, f, q] = wp.transpose(c.turn[b, j]) * (at - c.origin[b, j])

    @wp.kernel(module=module, enable_backward=False)
    def nearest(
        # model
        bodies: probe.Bodies,
        first: int,
        count: int,
        # state in
        origin: wp.array3d(dtype=vec3),
        turn: wp.array3d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        # state out
        gap_out: wp.array2d(dtype=real),
    ):
        # least gap of every point over all poses (T, B, K) and the bodies first to count - 1; x_in (s, 1) serves all
        # touches, (s, B) each one
        i, b = wp.tid()
        p = x_in[i, wp.min(b, x_in.shape[1] - 1)]
        least = real(1e30)
        for t in range(origin.shape[0]):
            for j in range(first, count):
                least = wp.min(least, probe.gap(bodies, j, wp.transpose(turn[t, b, j]) * (p - origin[t, b, j])))
        gap_out[i, b] = least

    return SimpleNamespace(evaluate=evaluate, reach=reach, update_friction=update_friction, end_step=end_step,
                           nearest=nearest, Points=Points, vec3=vec3, mat33=mat33, sdf=probe)
