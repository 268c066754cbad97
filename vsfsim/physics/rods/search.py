"""Which samples are near which capsules, and which part of the tree can be loaded: only that part is solved.

A sub-tree that nothing touches carries no load, so it rides on its joint undeformed: exact, not an approximation, where the plant weighs nothing.
"""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Here, Touches, Trees, Work
from vsfsim.physics.rods.lanes import ahead, count_all, meet
from vsfsim.physics.rods.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.touching import gap_of, point_at

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

SAMPLES = wp.constant(4096)  # more than a segment can have: a contact's key counts in it


@wp.func
def ride(tree: Trees, w: Work, at: Here):
    """Puts the nodes of unloaded sub-trees where their joints carry them."""
    b = at.b
    o = at.o
    for d in range(1, at.high):
        for r in range(tree.level[at.low + d] + at.lane, tree.level[at.low + d + 1], at.lanes):
            i = tree.rank[r]
            if w.active[b, i] == 0:
                p = tree.parent[o + i]
                qp = w.q[b, p]
                w.q[b, i] = qp
                w.x[b, i] = w.x[b, p] + wp.quat_rotate(qp, tree.rest[o + i] - tree.rest[o + p])
        meet()


@wp.func
def surface_point(tree: Trees, w: Work, b: int, p: int, i: int, j: int, lever: vec3, xp: vec3, qp: quat, xc: vec3, qc: quat):
    """The sample's point on the branch's surface, ``lever`` from it at the step's start, carried along by both nodes."""
    s = tree.along[j]
    lp = wp.quat_rotate(qp, wp.quat_rotate_inv(w.q_start[b, p], lever))
    lc = wp.quat_rotate(qc, wp.quat_rotate_inv(w.q_start[b, i], lever))
    return point_at(s, tree.offset[j], xp, qp, xc, qc) + (ONE - s) * lp + s * lc


@wp.func
def found_in(w: Work, old: int, b: int, key: int):
    """Place of ``key`` in the list ``old``, which is sorted, or -1."""
    low = int(0)
    high = w.count[old, b]
    while low < high:
        mid = (low + high) / 2
        if w.key[old, b, mid] < key:
            low = mid + 1
        else:
            high = mid
    if low < w.count[old, b] and w.key[old, b, low] == key:
        return low
    return -1


@wp.func
def near(tree: Trees, touch: Touches, w: Work, at: Here, i: int, margin: real, old: int, new: int, begin: int, write: int):
    """Samples of segment ``i`` nearer to a capsule than ``margin``: how many, and with ``write`` they are put into the list from ``begin`` on. Sets ``w.clear``."""
    b = at.b
    o = at.o
    m = begin
    room = w.key.shape[2]
    bodies = touch.half.shape[0]
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
                start = tree.sample[o + i]
                for j in range(start, tree.sample[o + i + 1]):
                    y = point_at(tree.along[j], tree.offset[j], xp, qp, xc, qc)
                    gap = gap_of(y, tree.radius[j], cx, w.cap_q[b, k], touch.half[k], touch.radius[k])
                    if gap.value < margin:
                        if write == 1 and m < room:
                            key = (i * bodies + k) * SAMPLES + (j - start)
                            w.key[new, b, m] = key
                            w.sample[new, b, m] = j
                            w.node[new, b, m] = i
                            w.body[new, b, m] = k
                            stuck = int(0)
                            there = found_in(w, old, b, key)
                            if there >= 0:
                                stuck = wp.min(w.stuck[old, b, there], 1)
                                w.anchor[new, b, m] = w.anchor[old, b, there]
                            w.stuck[new, b, m] = stuck
                            y0 = point_at(tree.along[j], tree.offset[j], w.x_start[b, p], w.q_start[b, p], w.x_start[b, i], w.q_start[b, i])
                            gap0 = gap_of(y0, tree.radius[j], w.cap_x_start[b, k], w.cap_q_start[b, k], touch.half[k], touch.radius[k])
                            lever = -tree.radius[j] * gap0.normal
                            w.lever[new, b, m] = lever
                            w.gap0[new, b, m] = wp.max(gap0.value, ZERO)
                            w.local0[new, b, m] = wp.quat_rotate_inv(w.cap_q_start[b, k], y0 + lever - w.cap_x_start[b, k])
                            w.tau[new, b, m] = ZERO
                        m = m + 1
    w.clear[b, i] = clear
    return m - begin


@wp.func
def gather(tree: Trees, touch: Touches, w: Work, at: Here, margin: real, old: int, new: int):
    """Lists all pairs of sample and capsule nearer than ``margin``, in the order of their keys; those of the list ``old`` keep their anchors. ``w.clear``: how far each segment is from all
    capsules, a lower bound. The number of pairs, or -1 if there is no room."""
    b = at.b
    m = int(0)
    full = int(0)
    for base in range(1, at.n, at.lanes):
        i = base + at.lane
        found = int(0)
        begin = m
        # several lanes count first, so that each knows where its own go
        for turn in range(wp.where(at.lanes > 1, 0, 1), 2):
            if turn == 1:
                begin = m + ahead(found)
            if i < at.n and (turn == 0 or at.lanes == 1 or found > 0):
                found = near(tree, touch, w, at, i, margin, old, new, begin, turn)
        if i < at.n:
            w.first[b, i] = begin
            w.many[b, i] = found
        m = m + count_all(found)
        if m > w.key.shape[2]:
            full = 1
            break
    meet()
    if full == 1:
        return -1
    if at.lane == 0:
        w.count[new, b] = m
    meet()
    return m


@wp.func
def activate(tree: Trees, w: Work, at: Here, weighs: int):
    """Marks the nodes between the root and whatever is near a capsule, strained, or heavy; lists them level by level. How many, and how many levels."""
    b = at.b
    o = at.o
    for back in range(1, at.high + 1):
        d = at.high - back
        for r in range(tree.level[at.low + d] + at.lane, tree.level[at.low + d + 1], at.lanes):
            i = tree.rank[r]
            on = wp.max(w.strained[b, i], weighs)
            clear = real(1.0)
            if i == 0:
                on = 1
            else:
                clear = w.clear[b, i]
                if w.many[b, i] > 0:
                    on = 1
            room = real(1.0)
            rider = ZERO
            kid = tree.child[o + i]
            while kid >= 0:
                if w.active[b, kid] == 1:
                    on = 1
                    room = wp.min(room, w.clear[b, kid])
                else:
                    clear = wp.min(clear, w.clear[b, kid])  # what rides on a node goes with it
                    rider = wp.max(rider, tree.length[o + kid] + tree.reach[o + kid])
                kid = tree.next[o + kid]
            w.active[b, i] = on
            w.clear[b, i] = clear
            w.room[b, i] = wp.min(clear, room)  # a node moves its own segment and those above it
            w.rider[b, i] = wp.where(on == 1, rider, ZERO)
        meet()
    count = int(0)
    tall = int(0)
    for d in range(at.high):
        begin = tree.level[at.low + d]
        stop = tree.level[at.low + d + 1]
        if at.lane == 0:
            w.level[b, d] = count
        before = count
        for base in range(begin, stop, at.lanes):
            r = base + at.lane
            i = int(0)
            on = int(0)
            if r < stop:
                i = tree.rank[r]
                on = w.active[b, i]
            place = count + ahead(on)
            if on == 1:
                w.order[b, place] = i
            count = count + count_all(on)
        if count == before:
            break
        tall = d + 1
    if at.lane == 0:
        w.level[b, tall] = count
    meet()
    return count, tall
