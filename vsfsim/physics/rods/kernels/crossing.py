"""Whether a fibre passes through a capsule between two states: a check by geometry that no force can talk out of.

Each of `PIECES` straight pieces of a fibre has one shortest way d from the capsule's axis (both are convex, so it is
unique) and d changes continuously with the state. A piece that goes from one side of the axis to the other takes d
through zero, and its direction to the opposite. So a step is refused in which d turns by more than a right angle; a
short enough part of it never does, unless the piece lies on the axis. The same holds for a ball, whose axis is a point.

Functions that are not inlined take no `Work`: CUDA passes structs by value, and copies of its arrays at five calls were
two fifths of the kernel's instructions.
"""

import warp as wp

from vsfsim.physics.rods.kernels.fibre import Fibre, fibre_in_capsule
from vsfsim.physics.rods.kernels.lanes import lane_count
from vsfsim.physics.rods.kernels.segment import HALF, ONE, TINY, ZERO, real, vec3
from vsfsim.physics.rods.structs import State, Thread, Trees

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
def segment_reach(tree: Trees, me: Thread, i: int, p: int, before: State, after: State):
    """Radius around the middle of a segment's ends in the second state within which all its fibres are, plus the way
    that they move from the first state, at most [m]."""
    b = me.b
    length = tree.length[me.o + i]
    wide = tree.bound[me.o + i]
    turn = real(2.0) * wp.max(wp.length(after.q[b, p] - before.q[b, p]), wp.length(after.q[b, i] - before.q[b, i]))
    way = wp.max(wp.length(after.x[b, p] - before.x[b, p]), wp.length(after.x[b, i] - before.x[b, i]))
    # the control points of the cubic bound it
    span = HALF * wp.length(after.x[b, i] - after.x[b, p])
    return span + length / real(3.0) + wide + way + turn * (length / real(3.0) + wide)


@wp.func(inline=False)
def passes(tree: Trees, half: real, me: Thread, i: int, k: int, before: State, capsules_before: State, after: State,
           capsules_after: State):
    """1 if a fibre of segment ``i`` passes through capsule ``k`` of the half length ``half`` from one state to the
    other, else 0."""
    for j in range(tree.fibre[me.o + i], tree.fibre[me.o + i + 1]):
        if tree.tip[j] == 0:
            f0 = fibre_in_capsule(tree, me, i, j, k, before, capsules_before)
            f1 = fibre_in_capsule(tree, me, i, j, k, after, capsules_after)
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
             before: State, capsules_before: State, after: State, capsules_after: State):
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
        reach = segment_reach(tree, me, i, p, before, after)
        middle = HALF * (after.x[b, p] + after.x[b, i])
        for k in range(length.shape[0]):
            half = length[k]
            q0 = capsules_before.q[b, k]
            q1 = capsules_after.q[b, k]
            turn = real(2.0) * wp.min(wp.length(q1 - q0), wp.length(q1 + q0))
            near = reach + wp.length(capsules_after.x[b, k] - capsules_before.x[b, k]) + turn * (half + reach)
            away = middle - capsules_after.x[b, k]
            if wp.length(away) < near + half:
                local = wp.quat_rotate_inv(q1, away)
                z = local[2] - wp.clamp(local[2], -half, half)
                if local[0] * local[0] + local[1] * local[1] + z * z < near * near:
                    found = found + passes(tree, half, me, i, k, before, capsules_before, after, capsules_after)
    return lane_count(found)
