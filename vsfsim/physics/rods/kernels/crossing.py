"""Whether a fibre passes through a capsule between two states: a check by geometry that no force can talk out of.

Each of `PIECES` straight pieces of a fibre has one shortest way d from the capsule's axis (both are convex, so it is
unique) and d changes continuously with the state. A piece that goes from one side of the axis to the other takes d
through zero, and its direction to the opposite. So a step is refused in which d turns by more than a right angle; a
short enough part of it never does, unless the piece lies on the axis. The same holds for a ball, whose axis is a point.

Functions that are not inlined take no `Work`: CUDA passes structs by value, and copies of its 130 arrays at five calls
were two fifths of the kernel's instructions.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.fibre import Fibre, fibre_in_capsule
from vsfsim.physics.rods.kernels.lanes import lane_count
from vsfsim.physics.rods.kernels.segment import HALF, ONE, TINY, ZERO, quat, real, vec3
from vsfsim.physics.rods.structs import Thread, Trees

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

PIECES = wp.constant(4)  # straight pieces of a fibre


@wp.func
def fibre_place(f: Fibre, s: real):
    """The place ``s`` of a fibre in the frame of its capsule [m]."""
    return f.a + s * (f.b + s * (f.c + s * f.d))


@wp.func
def from_axis(a: vec3, b: vec3, half: real):
    """The shortest way from a capsule's axis, of the half length ``half``, to the straight piece from ``a`` to ``b`` in
    the capsule's frame [m]. Source: Ericson, Real-Time Collision Detection (2005), 5.1.9."""
    along = b - a
    aa = wp.dot(along, along)
    flat = along[0] * along[0] + along[1] * along[1]
    s = ZERO
    if flat > TINY * aa:
        # closest to the line of the axis
        s = wp.clamp(-(a[0] * along[0] + a[1] * along[1]) / flat, ZERO, ONE)
    z = wp.clamp(a[2] + s * along[2], -half, half)
    if aa > ZERO:
        # the place closest to that point of the axis, and the point of the axis closest to that place
        s = wp.clamp(-(a[0] * along[0] + a[1] * along[1] + (a[2] - z) * along[2]) / aa, ZERO, ONE)
        z = wp.clamp(a[2] + s * along[2], -half, half)
    y = a + s * along
    return vec3(y[0], y[1], y[2] - z)


@wp.func
def segment_reach(tree: Trees, me: Thread, i: int, p: int, x0: wp.array2d(dtype=vec3), q0: wp.array2d(dtype=quat),
                  x1: wp.array2d(dtype=vec3), q1: wp.array2d(dtype=quat)):
    """Radius around the middle of a segment's ends in the second state within which all its fibres are, plus the way
    that they move from the first state, at most [m]."""
    b = me.b
    length = tree.length[me.o + i]
    wide = tree.bound[me.o + i]
    turn = real(2.0) * wp.max(wp.length(q1[b, p] - q0[b, p]), wp.length(q1[b, i] - q0[b, i]))
    way = wp.max(wp.length(x1[b, p] - x0[b, p]), wp.length(x1[b, i] - x0[b, i]))
    # the control points of the cubic bound it
    return HALF * wp.length(x1[b, i] - x1[b, p]) + length / real(3.0) + wide + way + turn * (length / real(3.0) + wide)


@wp.func(inline=False)
def passes(tree: Trees, half: real, me: Thread, i: int, p: int, x0: wp.array2d(dtype=vec3), q0: wp.array2d(dtype=quat),
           cx0: vec3, cq0: quat, x1: wp.array2d(dtype=vec3), q1: wp.array2d(dtype=quat), cx1: vec3, cq1: quat):
    """1 if a fibre of segment ``i`` passes through a capsule of the half length ``half`` from the state (x0, q0), with
    the capsule at (cx0, cq0), to the state (x1, q1), with the capsule at (cx1, cq1)."""
    for j in range(tree.fibre[me.o + i], tree.fibre[me.o + i + 1]):
        if tree.tip[j] == 0:
            f0 = fibre_in_capsule(tree, me.b, me.o, p, i, j, x0, q0, cx0, cq0)
            f1 = fibre_in_capsule(tree, me.b, me.o, p, i, j, x1, q1, cx1, cq1)
            a0 = f0.a
            a1 = f1.a
            for n in range(PIECES):
                s = real(n + 1) / real(PIECES)
                b0 = fibre_place(f0, s)
                b1 = fibre_place(f1, s)
                if wp.dot(from_axis(a0, b0, half), from_axis(a1, b1, half)) < ZERO:
                    return 1
                a0 = b0
                a1 = b1
    return 0


@wp.func(inline=False)
def crossing(tree: Trees, length: wp.array(dtype=real), order: wp.array2d(dtype=wp.int32), me: Thread, count: int,
             x0: wp.array2d(dtype=vec3), q0: wp.array2d(dtype=quat), cx0: wp.array2d(dtype=vec3),
             cq0: wp.array2d(dtype=quat), x1: wp.array2d(dtype=vec3), q1: wp.array2d(dtype=quat),
             cx1: wp.array2d(dtype=vec3), cq1: wp.array2d(dtype=quat)):
    """Number of segments that pass through a capsule between two states, see `passes`.

    Args:
        length: half length of each capsule (K,) [m].
        order: `Nodes.order` (B, N).
        count: number of active nodes, whose segments are looked at; 0 for all of them.
    """
    b = me.b
    found = int(0)
    last = wp.where(count > 0, count, me.n)
    for r in range(1 + me.lane, last, me.lanes):
        i = r
        if count > 0:
            i = order[b, r]
        p = tree.parent[me.o + i]
        reach = segment_reach(tree, me, i, p, x0, q0, x1, q1)
        middle = HALF * (x1[b, p] + x1[b, i])
        for k in range(length.shape[0]):
            half = length[k]
            turn = real(2.0) * wp.min(wp.length(cq1[b, k] - cq0[b, k]), wp.length(cq1[b, k] + cq0[b, k]))
            near = reach + wp.length(cx1[b, k] - cx0[b, k]) + turn * (half + reach)
            away = middle - cx1[b, k]
            if wp.length(away) < near + half:
                local = wp.quat_rotate_inv(cq1[b, k], away)
                z = local[2] - wp.clamp(local[2], -half, half)
                if local[0] * local[0] + local[1] * local[1] + z * z < near * near:
                    found = found + passes(tree, half, me, i, p, x0, q0, cx0[b, k], cq0[b, k], x1, q1, cx1[b, k],
                                           cq1[b, k])
    return lane_count(found)
