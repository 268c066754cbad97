"""Which samples are near which capsules, and which part of the tree can be loaded: only that part is solved.

A sub-tree that nothing touches carries no load, so it rides on its joint undeformed: exact, not an approximation, where the plant weighs nothing.
"""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Touches, Trees, Work
from vsfsim.physics.rods.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.touching import gap_of, point_at

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

SAMPLES = wp.constant(4096)  # more than a segment can have: a contact's key counts in it


@wp.func
def ride(tree: Trees, w: Work, b: int, o: int, n: int):
    """Puts the nodes of unloaded sub-trees where their joints carry them."""
    for i in range(1, n):
        if w.active[b, i] == 0:
            p = tree.parent[o + i]
            qp = w.q[b, p]
            w.q[b, i] = qp
            w.x[b, i] = w.x[b, p] + wp.quat_rotate(qp, tree.rest[o + i] - tree.rest[o + p])


@wp.func
def surface_point(tree: Trees, w: Work, b: int, p: int, i: int, j: int, lever: vec3, xp: vec3, qp: quat, xc: vec3, qc: quat):
    """The sample's point on the branch's surface, ``lever`` from it at the step's start, carried along by both nodes."""
    s = tree.along[j]
    lp = wp.quat_rotate(qp, wp.quat_rotate_inv(w.q_start[b, p], lever))
    lc = wp.quat_rotate(qc, wp.quat_rotate_inv(w.q_start[b, i], lever))
    return point_at(s, tree.offset[j], xp, qp, xc, qc) + (ONE - s) * lp + s * lc


@wp.func
def gather(tree: Trees, touch: Touches, w: Work, b: int, o: int, n: int, margin: real, old: int, new: int):
    """Lists all pairs of sample and capsule nearer than ``margin``; those of the list ``old`` keep their anchors. ``w.clear``: how far each segment is from all capsules, a lower bound. The
    number of pairs, or -1 if there is no room."""
    m = int(0)
    at = int(0)
    last = w.count[old, b]
    room = w.key.shape[2]
    bodies = touch.half.shape[0]
    for i in range(1, n):
        p = tree.parent[o + i]
        xp = w.x[b, p]
        xc = w.x[b, i]
        qp = w.q[b, p]
        qc = w.q[b, i]
        mid = HALF * (xp + xc)
        around = HALF * wp.length(xc - xp) + tree.bound[o + i]
        clear = real(1.0)
        for k in range(bodies):
            cx = w.cap_x[b, k]
            far = around + touch.radius[k]
            if wp.length(mid - cx) - far - touch.half[k] < clear:
                local = wp.quat_rotate_inv(w.cap_q[b, k], mid - cx)
                apart = wp.length(vec3(local[0], local[1], local[2] - wp.clamp(local[2], -touch.half[k], touch.half[k]))) - far
                clear = wp.min(clear, apart)
                if apart < margin:
                    begin = tree.sample[o + i]
                    for j in range(begin, tree.sample[o + i + 1]):
                        y = point_at(tree.along[j], tree.offset[j], xp, qp, xc, qc)
                        gap = gap_of(y, tree.radius[j], cx, w.cap_q[b, k], touch.half[k], touch.radius[k])
                        if gap.value < margin:
                            if m >= room:
                                return -1
                            key = (i * bodies + k) * SAMPLES + (j - begin)
                            while at < last and w.key[old, b, at] < key:
                                at = at + 1
                            w.key[new, b, m] = key
                            w.sample[new, b, m] = j
                            w.node[new, b, m] = i
                            w.body[new, b, m] = k
                            stuck = int(0)
                            if at < last and w.key[old, b, at] == key:
                                stuck = wp.min(w.stuck[old, b, at], 1)
                                w.anchor[new, b, m] = w.anchor[old, b, at]
                            w.stuck[new, b, m] = stuck
                            x0p = w.x_start[b, p]
                            x0c = w.x_start[b, i]
                            q0p = w.q_start[b, p]
                            q0c = w.q_start[b, i]
                            y0 = point_at(tree.along[j], tree.offset[j], x0p, q0p, x0c, q0c)
                            gap0 = gap_of(y0, tree.radius[j], w.cap_x_start[b, k], w.cap_q_start[b, k], touch.half[k], touch.radius[k])
                            lever = -tree.radius[j] * gap0.normal
                            w.lever[new, b, m] = lever
                            w.gap0[new, b, m] = wp.max(gap0.value, ZERO)
                            w.local0[new, b, m] = wp.quat_rotate_inv(w.cap_q_start[b, k], y0 + lever - w.cap_x_start[b, k])
                            w.tau[new, b, m] = ZERO
                            m = m + 1
        w.clear[b, i] = clear
    w.count[new, b] = m
    return m


@wp.func
def activate(tree: Trees, w: Work, b: int, o: int, n: int, side: int, weighs: int):
    """Marks the nodes between the root and whatever is near a capsule, strained, or heavy; lists them upwards. How many."""
    for i in range(n):
        w.active[b, i] = wp.max(w.strained[b, i], weighs)
        w.rider[b, i] = ZERO
    for c in range(w.count[side, b]):
        w.active[b, w.node[side, b, c]] = 1
    w.active[b, 0] = 1
    w.clear[b, 0] = real(1.0)
    for back in range(1, n):
        i = n - back
        p = tree.parent[o + i]
        if w.active[b, i] == 1:
            w.active[b, p] = 1
        else:
            w.clear[b, p] = wp.min(w.clear[b, p], w.clear[b, i])  # what rides on a node goes with it
    # a node moves its own segment and those above it
    for i in range(1, n):
        p = tree.parent[o + i]
        w.room[b, i] = w.clear[b, i]
        if w.active[b, i] == 1:
            w.room[b, p] = wp.min(w.room[b, p], w.clear[b, i])
        if w.active[b, i] == 0 and w.active[b, p] == 1:
            w.rider[b, p] = wp.max(w.rider[b, p], tree.length[o + i] + tree.reach[o + i])
    count = int(0)
    for i in range(n):
        if w.active[b, i] == 1:
            w.order[b, count] = i
            count = count + 1
    return count
