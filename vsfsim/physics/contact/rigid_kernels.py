"""The contact points of an object's surface with rigid bodies, as a source of `kernels`.

g is the distance to the nearest rigid body at a Gauss point of the surface (`patch`); or that of a point on an edge of
a body to a face (`body_points`: part f then has one point, on body ``host``). An anchor is a place in the frame of its
body.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.contact import mount, sdf
from vsfsim.physics.contact.kernels import contact_kernels
from vsfsim.physics.contact.law import ContactLaw
from vsfsim.physics.runtime import mat33, real, vec3

_ADVANCES = wp.constant(24)  # of a point along its way, each as far as it surely meets nothing


@functools.cache
def kernels(law: ContactLaw) -> Any:
    """The contact kernels under a law, and their types."""
    module = f"vsfsim_contact_{law.name}"

    class Rigid:
        host: wp.array2d(dtype=wp.int32)  # body whose point a part is, see `body_points`; -1 for parts of faces
        spot: wp.array2d(dtype=vec3)  # that point, in its body's frame [m]
        leave: wp.array2d(dtype=vec3)  # direction in which it leaves the object [-]
        anchor: wp.array3d(dtype=vec3)
        bodies: sdf.Bodies
        count: int  # of bodies, K
        # bodies (B, K), now and when the step began
        origin: wp.array2d(dtype=vec3)
        turn: wp.array2d(dtype=mat33)
        origin_before: wp.array2d(dtype=vec3)
        turn_before: wp.array2d(dtype=mat33)

    found = contact_kernels(module, Rigid, functools.partial(_source, module), law.push(module), on_faces=False)
    Points = found.Points
    exact, touch, trials = wp.constant(real(mount.EXACT)), wp.constant(real(mount.TOUCH)), wp.constant(mount.TRIALS + 1)

    @wp.kernel(module=module, enable_backward=False)
    def settle(c: Points, columns: wp.array(dtype=wp.int32), s: mount.Arrays):
        # evaluate all parts of a touch, by the threads of one block, until its spring is in balance; every thread finds
        # the same and writes where the bodies go
        k, lane = wp.tid()
        b = columns[k]
        e = s.axis[b]
        w = s.give[b]
        for _trial in range(trials):
            for j in range(c.origin.shape[1]):
                c.origin[b, j] = s.origin[b, j] - w * e
            pull, slope, gap = real(0.0), real(0.0), real(1e30)
            f = lane
            while f < c.gap.shape[1]:
                found.find(c, b, f)
                for q in range(c.gap.shape[2]):
                    pull += wp.dot(e, c.force[b, f, q])
                    slope += wp.dot(e, c.stiff[b, f, q] * e)
                    gap = wp.min(gap, c.gap[b, f, q])
                f += wp.block_dim()
            pull = wp.tile_extract(wp.tile_sum(wp.tile(pull)), 0)
            slope = wp.tile_extract(wp.tile_sum(wp.tile(slope)), 0)
            gap = wp.tile_extract(wp.tile_min(wp.tile(gap)), 0)
            over = pull - s.stiffness * w
            s.give[b] = w
            s.excess[b] = over
            if wp.abs(over) <= exact * wp.max(wp.abs(pull), wp.abs(s.stiffness * w)):
                return
            # where contact is lost the bodies go in by the gap
            w += wp.where(gap < real(0.0), over / (slope + s.stiffness), wp.max(-gap - touch, -w))

    @wp.kernel(module=module, enable_backward=False)
    def reach(
        # model
        c: Points,
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
                p = found.place(c, c.x, b, f, q)
                d = vec3()
                for a in range(6):
                    d += c.shape[b, f, q, a] * move_in[k, c.local[b, f, a]]
                speed = wp.length(d)
                for j in range(c.count):
                    t = real(0.0)
                    ends = int(0)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
                    while ends < _ADVANCES and t < part:
                        at = wp.transpose(c.turn[b, j]) * (p + t * d - c.origin[b, j])
                        room = sdf.gap(c.bodies, j, at) + core[j]
                        ends += 1
                        if room <= real(0.0):
                            ends = int(_ADVANCES)
                        else:
                            t += room / wp.max(speed, real(1e-30))
                    if t > real(0.0):
                        part = wp.min(part, t)
        part_out[k, f] = part

    return SimpleNamespace(**vars(found), settle=settle, reach=reach)


def _source(module: str, Points: Any, place: Any) -> Any:
    """The functions of rigid bodies, see `kernels.contact_kernels`."""

    @wp.func(module=module)
    def meet(c: Points, b: int, f: int, q: int, p: vec3):
        near = int(0)  # noqa: UP018, RUF046
        gap = real(1e30)
        n = -c.leave[b, f]
        bend = mat33()
        if c.host[b, f] >= 0:  # a point of a body against the face
            near = c.host[b, f]
            gap = wp.dot(n, p - (c.origin[b, near] + c.turn[b, near] * c.spot[b, f]))
            return near, gap, n, n, bend
        for j in range(c.count):
            g = sdf.gap(c.bodies, j, wp.transpose(c.turn[b, j]) * (p - c.origin[b, j]))
            if g < gap:
                gap = g
                near = j
        if gap < real(0.0):
            r = c.turn[b, near]
            inside = wp.transpose(r) * (p - c.origin[b, near])
            n = r * sdf.normal(c.bodies, near, inside)
            bend = -(r * sdf.curvature(c.bodies, near, inside) * wp.transpose(r))
        return near, gap, n, n, bend

    @wp.func(module=module)
    def held(c: Points, b: int, f: int, q: int, owner: int):
        return c.origin[b, owner] + c.turn[b, owner] * c.anchor[b, f, q]

    @wp.func(module=module)
    def anchors(c: Points, b: int, f: int, q: int, j: int):
        # where the body's surface met the point in this step if the point had stood still; where the point is now if it
        # did not, because the object bulged up
        p0 = place(c, c.x_before, b, f, q)
        start = wp.transpose(c.turn_before[b, j]) * (p0 - c.origin_before[b, j])
        stop = wp.transpose(c.turn[b, j]) * (p0 - c.origin[b, j])
        g0 = wp.max(sdf.gap(c.bodies, j, start), real(0.0))
        g1 = sdf.gap(c.bodies, j, stop)
        if c.host[b, f] >= 0:
            c.anchor[b, f, q] = c.spot[b, f]
        elif g1 < real(0.0):
            c.anchor[b, f, q] = start + (g0 / (g0 - g1)) * (stop - start)
        else:
            c.anchor[b, f, q] = wp.transpose(c.turn[b, j]) * (place(c, c.x, b, f, q) - c.origin[b, j])
        c.owner[b, f, q] = -2 - j

    @wp.func(module=module)
    def drags(c: Points, b: int, f: int, q: int, at: vec3, d: vec3, left: real):
        j = c.body[b, f, q]
        there = at + (real(1.0) - left / wp.length(d)) * d
        c.anchor[b, f, q] = wp.transpose(c.turn[b, j]) * (there - c.origin[b, j])

    return SimpleNamespace(place=place, meet=meet, held=held, anchors=anchors, drags=drags)
