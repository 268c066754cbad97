"""Which samples are near which capsules, and which part of the tree can be loaded: only that part is solved.

A sub-tree that nothing touches carries no load, so it rides on its joint undeformed: exact, not an approximation, where
the plant weighs nothing.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.lanes import ahead, count_all, meet
from vsfsim.physics.rods.kernels.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.kernels.touching import gap_of, point_at
from vsfsim.physics.rods.state import Here, Touches, Trees, Work

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
def surface_point(tree: Trees, w: Work, b: int, p: int, i: int, j: int, lever: vec3, xp: vec3, qp: quat, xc: vec3,
                  qc: quat):
    """The sample's point on the branch's surface, ``lever`` from it at the step's start, carried along by both
    nodes."""
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
def capsules_near(tree: Trees, touch: Touches, w: Work, at: Here, i: int, margin: real):
    """The capsules that a sample of segment ``i`` may be nearer to than ``margin``, a bit each. Sets ``w.clear``."""
    b = at.b
    p = tree.parent[at.o + i]
    xp = w.x[b, p]
    xc = w.x[b, i]
    mid = HALF * (xp + xc)
    around = HALF * wp.length(xc - xp) + tree.bound[at.o + i]
    clear = real(1.0)
    which = int(0)
    for k in range(touch.half.shape[0]):
        cx = w.cap_x[b, k]
        far = around + touch.radius[k]
        if wp.length(mid - cx) - far - touch.half[k] < clear:
            local = wp.quat_rotate_inv(w.cap_q[b, k], mid - cx)
            apart = wp.length(vec3(local[0], local[1], local[2] - wp.clamp(local[2], -touch.half[k],
                                                                           touch.half[k]))) - far
            clear = wp.min(clear, apart)
            if apart < margin:
                which = which | (1 << k)
    w.clear[b, i] = clear
    return which


@wp.func
def enlist(tree: Trees, touch: Touches, w: Work, at: Here, i: int, k: int, margin: real, old: int, new: int,
           begin: int):
    """Puts the samples of segment ``i`` nearer to capsule ``k`` than ``margin`` into the list from ``begin`` on, as far
    as there is room; how many they are. The lanes share the samples: a leaf has hundreds."""
    b = at.b
    m = begin
    p = tree.parent[at.o + i]
    xp = w.x[b, p]
    xc = w.x[b, i]
    qp = w.q[b, p]
    qc = w.q[b, i]
    cx = w.cap_x[b, k]
    cq = w.cap_q[b, k]
    start = tree.sample[at.o + i]
    stop = tree.sample[at.o + i + 1]
    for base in range(start, stop, at.lanes):
        j = base + at.lane
        hit = int(0)
        if j < stop:
            y = point_at(tree.along[j], tree.offset[j], xp, qp, xc, qc)
            gap = gap_of(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
            if gap.value < margin:
                hit = 1
        place = m + ahead(hit)
        if hit == 1 and place < w.key.shape[2]:
            key = (i * touch.half.shape[0] + k) * SAMPLES + (j - start)
            w.key[new, b, place] = key
            w.sample[new, b, place] = j
            w.node[new, b, place] = i
            w.body[new, b, place] = k
            stuck = int(0)
            there = found_in(w, old, b, key)
            if there >= 0:
                stuck = wp.min(w.stuck[old, b, there], 1)
                w.anchor[new, b, place] = w.anchor[old, b, there]
            w.stuck[new, b, place] = stuck
            y0 = point_at(tree.along[j], tree.offset[j], w.x_start[b, p], w.q_start[b, p], w.x_start[b, i],
                          w.q_start[b, i])
            gap0 = gap_of(y0, tree.radius[j], w.cap_x_start[b, k], w.cap_q_start[b, k], touch.half[k], touch.radius[k])
            lever = -tree.radius[j] * gap0.normal
            w.lever[new, b, place] = lever
            w.gap0[new, b, place] = wp.max(gap0.value, ZERO)
            w.local0[new, b, place] = wp.quat_rotate_inv(w.cap_q_start[b, k], y0 + lever - w.cap_x_start[b, k])
            w.tau[new, b, place] = ZERO
        m = m + count_all(hit)
    return m - begin


@wp.func
def gather(tree: Trees, touch: Touches, w: Work, at: Here, margin: real, old: int, new: int):
    """Lists all pairs of sample and capsule nearer than ``margin``, in the order of their keys; those of the list
    ``old`` keep their anchors. ``w.clear``: how far each segment is from all capsules, a lower bound. The number of
    pairs, or -1 if there is no room."""
    b = at.b
    for i in range(1 + at.lane, at.n, at.lanes):
        w.many[b, i] = capsules_near(tree, touch, w, at, i, margin)
    meet()
    m = int(0)
    for i in range(1, at.n):
        which = w.many[b, i]
        if which == 0:
            continue
        begin = m
        for k in range(touch.half.shape[0]):
            if (which >> k) & 1 == 1:
                m = m + enlist(tree, touch, w, at, i, k, margin, old, new, m)
        meet()
        if at.lane == 0:
            w.first[b, i] = begin
            w.many[b, i] = m - begin
        if m > w.key.shape[2]:
            break
    meet()
    if m > w.key.shape[2]:
        return -1
    if at.lane == 0:
        w.count[new, b] = m
    meet()
    return m


@wp.func
def activate(tree: Trees, w: Work, at: Here, weighs: int):
    """Marks the nodes between the root and whatever is near a capsule, strained, or heavy; lists them level by level.
    How many, and how many levels."""
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
