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
from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import torch
import warp as wp

from vsfsim.physics.contact import friction, sdf
from vsfsim.physics.runtime import mat33, real, vec3

STICK = 0.1
"""Tangential stiffness of a stuck point over the normal one [-]: softer, since stick and slip meet in a kink of that
width."""
FACING = 0.5
"""Cosine between the object's and the body's outward normal above which a point inside the body is on its wrong
side."""


def views(cut: tuple[int, int, int], scalars: Mapping[str, torch.Tensor], vectors: Mapping[str, torch.Tensor],
          matrices: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    """Values at contact points, their number in the second dimension of a tensor, as Warp arrays of the form ``cut``
    (touches, parts, 6)."""
    k = kernels()
    return ({name: wp.from_torch(t.view(cut)) for name, t in scalars.items()}
            | {name: wp.from_torch(t.view(*cut, 3), dtype=k.vec3) for name, t in vectors.items()}
            | {name: wp.from_torch(t.view(*cut, 3, 3), dtype=k.mat33) for name, t in matrices.items()})


@functools.cache
def kernels() -> Any:
    """The contact kernels, their types, and the signed distances that they use (``sdf``).

    The owner of an anchor is a code: -1 is none, j >= 0 is body j, and -2 - j is body j with an anchor that this step
    made and may still move.
    """
    module = "vsfsim_contact"
    # loops over the points of a part end at a variable: unrolled, their six copies take Warp seconds to compile
    probe = sdf.functions(real, module)
    most_anchorings = wp.constant(friction.ANCHORINGS)
    facing = wp.constant(real(FACING))

    @wp.func(module=module)
    def place(shape: wp.array3d(dtype=real), part: wp.array2d(dtype=wp.int32), q: int, b: int, f: int,
              local: wp.array3d(dtype=wp.int32), x: wp.array2d(dtype=vec3)):
        # Gauss point q of part f of touch b; part: its row of the table of shape values
        out = vec3()
        for a in range(6):
            out += shape[part[b, f], q, a] * x[b, local[b, f, a]]
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
    def evaluate(
        # model
        shape: wp.array3d(dtype=real),
        part: wp.array2d(dtype=wp.int32),
        bodies: probe.Bodies,
        count: int,
        columns: wp.array(dtype=wp.int32),
        local: wp.array3d(dtype=wp.int32),
        stiffness: wp.array3d(dtype=real),
        share: wp.array3d(dtype=real),
        soft: wp.array2d(dtype=real),
        host: wp.array2d(dtype=wp.int32),
        spot: wp.array2d(dtype=vec3),
        leave: wp.array2d(dtype=vec3),
        softening: wp.array(dtype=real),
        onset: real,
        coefficient: wp.array(dtype=real),
        coulomb: wp.array(dtype=real),
        stick: real,
        # state in
        origin: wp.array2d(dtype=vec3),
        turn: wp.array2d(dtype=mat33),
        x_in: wp.array2d(dtype=vec3),
        anchor_in: wp.array3d(dtype=vec3),
        owner_in: wp.array3d(dtype=wp.int32),
        limit_in: wp.array3d(dtype=real),
        across_in: wp.array3d(dtype=vec3),
        relief: wp.array(dtype=real),
        # state out
        gap_out: wp.array3d(dtype=real),
        body_out: wp.array3d(dtype=wp.int32),
        normal_out: wp.array3d(dtype=vec3),
        force_out: wp.array3d(dtype=vec3),
        rows_out: wp.array3d(dtype=mat33),
        geometric_out: wp.array3d(dtype=mat33),
        coupling_out: wp.array3d(dtype=mat33),
        slips_out: wp.array3d(dtype=wp.int32),
        held_out: wp.array3d(dtype=vec3),
        wrong_side_out: wp.array2d(dtype=wp.int32),
        energy_out: wp.array2d(dtype=real),
    ):
        f, k = wp.tid()
        b = columns[k]
        energy = real(0.0)
        wrong = int(0)  # noqa: UP018, RUF046
        corner = x_in[b, local[b, f, 0]]
        outward = wp.cross(x_in[b, local[b, f, 1]] - corner, x_in[b, local[b, f, 2]] - corner)
        outward = outward / wp.max(wp.length(outward), real(1e-30))
        for q in range(shape.shape[1]):
            force = vec3()
            rows = mat33()
            geometric = mat33()
            coupling = mat33()
            gap = real(1e30)
            held = vec3()
            slips = int(0)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
            w = softening[b] * stiffness[b, f, q]
            if w > real(0.0):
                p = place(shape, part, q, b, f, local, x_in)
                near = host[b, f]
                n = -leave[b, f]
                if near >= 0:  # a point of body ``near`` against the face
                    gap = wp.dot(n, p - (origin[b, near] + turn[b, near] * spot[b, f]))
                else:
                    near = int(0)  # noqa: UP018, RUF046
                    for j in range(count):
                        g = probe.gap(bodies, j, wp.transpose(turn[b, j]) * (p - origin[b, j]))
                        if g < gap:
                            gap = g
                            near = j
                    if gap < real(0.0):
                        r = turn[b, near]
                        inside = wp.transpose(r) * (p - origin[b, near])
                        n = r * probe.normal(bodies, near, inside)
                        geometric = -(r * probe.curvature(bodies, near, inside) * wp.transpose(r))
                        if wp.dot(n, outward) > facing:
                            # the nearest way out leads through the object: the surface has passed the body's middle
                            wrong += 1
                            gap = real(0.0)
                body_out[b, f, q] = near
                limit = limit_in[b, f, q]
                slope = real(0.0)
                if gap < real(0.0):
                    normal_out[b, f, q] = n
                    size, slope, work = push(w, share[b, f, q], soft[b, f], onset, -gap)
                    force = size * n
                    root = wp.sqrt(slope)
                    for c in range(3):
                        rows[0, c] = root * n[c]
                    geometric = size * geometric
                    energy += work
                    if coulomb[b] > real(0.0) and limit > real(0.0):
                        limit = coefficient[near] * size
                else:
                    geometric = mat33()
                    # the limit that was found last acts on points that have left since, too: only so there is a
                    # potential
                    limit = (real(1.0) - coulomb[b]) * limit
                if limit > real(0.0):
                    owner = owner_in[b, f, q]
                    if owner < -1:
                        owner = -2 - owner
                    m = across_in[b, f, q]
                    d = friction.tangential(p - (origin[b, owner] + turn[b, owner] * anchor_in[b, f, q]), m)
                    v = stick * w
                    energy += friction.energy(wp.length(d), v, limit)
                    held = friction.force(d, v, limit)
                    along, sideways = friction.hessian_roots(d, m, v, limit)
                    way = d
                    slides = not friction.sticks(wp.length(d), v, limit)
                    if relief[b] < real(1.0):
                        way = friction.trial(d, held_out[b, f, q], v, relief[b])
                        slides = not friction.sticks(wp.length(way), v, limit)
                        held, along, sideways = friction.linearised(d, held_out[b, f, q], m, v, limit, relief[b])
                    force -= held
                    for c in range(3):
                        rows[1, c] = along[c]
                        rows[2, c] = sideways[c]
                    if slides:
                        slips = 1
                        # of a limit that follows the normal force
                        coupling = (-coulomb[b] * coefficient[near] * slope) * wp.outer(way / wp.length(way), n)
            gap_out[b, f, q] = gap
            force_out[b, f, q] = force
            rows_out[b, f, q] = rows
            geometric_out[b, f, q] = geometric
            coupling_out[b, f, q] = coupling
            slips_out[b, f, q] = slips
            held_out[b, f, q] = held
        energy_out[b, f] = energy
        wrong_side_out[b, f] = wrong

    @wp.kernel(module=module, enable_backward=False)
    def update_friction(
        # model
        shape: wp.array3d(dtype=real),
        part: wp.array2d(dtype=wp.int32),
        bodies: probe.Bodies,
        columns: wp.array(dtype=wp.int32),
        local: wp.array3d(dtype=wp.int32),
        stiffness: wp.array3d(dtype=real),
        share: wp.array3d(dtype=real),
        soft: wp.array2d(dtype=real),
        host: wp.array2d(dtype=wp.int32),
        spot: wp.array2d(dtype=vec3),
        softening: wp.array(dtype=real),
        onset: real,
        coefficient: wp.array(dtype=real),
        coulomb: wp.array(dtype=real),
        renewals: wp.array(dtype=wp.int32),
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
        residual_out: wp.array3d(dtype=real),
    ):
        # the limit and the tangent plane of the next iteration; anchors of points that came into contact in this step
        f, k = wp.tid()
        b = columns[k]
        for q in range(shape.shape[1]):
            limit = real(0.0)
            g = gap_in[b, f, q]
            if g < real(0.0):
                j = body_in[b, f, q]
                size, _slope, _work = push(softening[b] * stiffness[b, f, q], share[b, f, q],
                                          soft[b, f], onset, -g)
                limit = coefficient[j] * size
                across_out[b, f, q] = wp.normalize(normal_in[b, f, q])
                owner = owner_out[b, f, q]
                if owner != j and (owner != -2 - j or anchorings_out[b, f, q] < most_anchorings):
                    anchorings_out[b, f, q] = anchorings_out[b, f, q] + 1
                    # where the body's surface met the point in this step if the point had stood still; where the point
                    # is now if it did not, because the object bulged up
                    p0 = place(shape, part, q, b, f, local, x_before)
                    start = wp.transpose(turn_before[b, j]) * (p0 - origin_before[b, j])
                    stop = wp.transpose(turn[b, j]) * (p0 - origin[b, j])
                    g0 = wp.max(probe.gap(bodies, j, start), real(0.0))
                    g1 = probe.gap(bodies, j, stop)
                    if host[b, f] >= 0:
                        anchor_out[b, f, q] = spot[b, f]
                    elif g1 < real(0.0):
                        anchor_out[b, f, q] = start + (g0 / (g0 - g1)) * (stop - start)
                    else:
                        p1 = place(shape, part, q, b, f, local, x_in)
                        anchor_out[b, f, q] = wp.transpose(turn[b, j]) * (p1 - origin[b, j])
                    owner_out[b, f, q] = -2 - j
            residual = real(0.0)
            if coulomb[b] == real(0.0):
                limit, damping, change, residual = friction.relaxed(limit, limit_out[b, f, q], damping_out[b, f, q],
                                                                    change_out[b, f, q], renewals[b])
                damping_out[b, f, q] = damping
                change_out[b, f, q] = change
            limit_out[b, f, q] = limit
            residual_out[b, f, q] = residual

    @wp.kernel(module=module, enable_backward=False)
    def end_step(
        # model
        shape: wp.array3d(dtype=real),
        part: wp.array2d(dtype=wp.int32),
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
        # points that slipped drag their anchor along, points that left lose it
        f, k = wp.tid()
        b = columns[k]
        for q in range(shape.shape[1]):
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
                    d = friction.tangential(place(shape, part, q, b, f, local, x_in) - at, m)
                    way = wp.length(d)
                    v = stick * stiffness[b, f, q]
                    limit = limit_in[b, f, q]
                    if not friction.sticks(way, v, limit):
                        at = at + (real(1.0) - limit / (v * way)) * d
                        anchor_out[b, f, q] = wp.transpose(turn[b, j]) * (at - origin[b, j])

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

    return SimpleNamespace(evaluate=evaluate, update_friction=update_friction, end_step=end_step, nearest=nearest,
                           vec3=vec3, mat33=mat33, sdf=probe)
