"""Contact search, and the part of the tree that can be loaded: only that part is solved.

A sub-tree that no capsule has come close to since nothing touched carries no load, so it moves rigidly with its joint.
This is exact for a plant without weight.
"""

import warp as wp

from vsfsim.physics.rods.kernels.fibre import POINTS, fibre_patch
from vsfsim.physics.rods.kernels.lanes import lane_count, lanes_before, sync
from vsfsim.physics.rods.kernels.segment import HALF, ZERO, real, vec3
from vsfsim.physics.rods.structs import Contact, Memory, State, Stick, Thread, Touches, Trees, Work

KEYS = wp.constant(4096)  # stride of the keys of contacts; the fibres of a segment have fewer points


@wp.func
def copy_state(w: Work, me: Thread, count: int, a: State, b: State):
    """Copies the state ``a`` of the ``count`` active nodes to ``b``; 0 for all nodes."""
    last = wp.where(count > 0, count, me.n)
    for r in range(me.lane, last, me.lanes):
        i = r
        if count > 0:
            i = w.nodes.order[me.b, r]
        b.x[me.b, i] = a.x[me.b, i]
        b.q[me.b, i] = a.q[me.b, i]
    sync()


@wp.func
def carry_unloaded(tree: Trees, w: Work, me: Thread):
    """Moves the nodes of unloaded sub-trees rigidly with their joints."""
    b = me.b
    o = me.o
    for d in range(1, me.high):
        for r in range(tree.level[me.low + d] + me.lane, tree.level[me.low + d + 1], me.lanes):
            i = tree.rank[r]
            if w.nodes.active[b, i] == 0:
                p = tree.parent[o + i]
                qp = w.now.q[b, p]
                w.now.q[b, i] = qp
                w.now.x[b, i] = w.now.x[b, p] + wp.quat_rotate(qp, tree.rest[o + i] - tree.rest[o + p])
        sync()


@wp.func
def find_contact(w: Work, old: int, b: int, key: int):
    """Place of ``key`` in the sorted list ``old``, or -1."""
    low = int(0)
    high = w.count[old, b]
    while low < high:
        mid = (low + high) / 2
        if w.contacts[old, b, mid].memory.key < key:
            low = mid + 1
        else:
            high = mid
    if low < w.count[old, b] and w.contacts[old, b, low].memory.key == key:
        return low
    return -1


@wp.func
def nearby_capsules(tree: Trees, touch: Touches, w: Work, me: Thread, i: int, margin: real):
    """The capsules that may be closer than ``margin`` to a fibre of segment ``i``, a bit each. Sets
    `Nodes.segment_clearance`."""
    b = me.b
    p = tree.parent[me.o + i]
    xp = w.now.x[b, p]
    xc = w.now.x[b, i]
    mid = HALF * (xp + xc)
    # the control points of the cubic (Bezier) bound it; the middle line is close to it
    third = (tree.rest[me.o + i] - tree.rest[me.o + p]) / real(3.0)
    leave = wp.length(xp + wp.quat_rotate(w.now.q[b, p], third) - mid)
    come = wp.length(xc - wp.quat_rotate(w.now.q[b, i], third) - mid)
    around = wp.max(HALF * wp.length(xc - xp), wp.max(leave, come)) + tree.bound[me.o + i]
    clear = real(1.0)
    which = int(0)
    for k in range(touch.half.shape[0]):
        cx = w.capsules.x[b, k]
        far = around + touch.radius[k]
        if wp.length(mid - cx) - far - touch.half[k] < clear:
            local = wp.quat_rotate_inv(w.capsules.q[b, k], mid - cx)
            along = wp.clamp(local[2], -touch.half[k], touch.half[k])
            apart = wp.length(vec3(local[0], local[1], local[2] - along)) - far
            clear = wp.min(clear, apart)
            if apart < margin:
                which = which | (1 << k)
    w.nodes.segment_clearance[b, i] = clear
    return which


@wp.func
def append_contacts(tree: Trees, touch: Touches, w: Work, me: Thread, i: int, k: int, margin: real, old: int, new: int,
                    begin: int):
    """Appends the points of the fibres of segment ``i`` closer than ``margin`` to capsule ``k`` to the list ``new``
    from ``begin`` on, as far as there is room. Returns their number. The lanes share the fibres: a leaf has many."""
    b = me.b
    m = begin
    start = tree.fibre[me.o + i]
    stop = tree.fibre[me.o + i + 1]
    for base in range(start, stop, me.lanes):
        j = base + me.lane
        hit = int(0)
        if j < stop:
            patch = fibre_patch(tree, touch, me, i, j, k, w.now, w.capsules)
            if patch.gap < margin:
                hit = 1
        place = m + POINTS * lanes_before(hit)
        if hit == 1 and place + POINTS <= w.contacts.shape[2]:
            begun = fibre_patch(tree, touch, me, i, j, k, w.start, w.capsules_start)
            at = Contact()
            at.fibre = j
            at.node = i
            at.capsule = k
            at.gap_start = wp.max(begun.gap, ZERO)
            first = (i * touch.half.shape[0] + k) * KEYS + POINTS * (j - start)
            there = find_contact(w, old, b, first)
            for n in range(POINTS):
                at.memory = Memory()
                if there >= 0:
                    at.memory = w.contacts[old, b, there + n].memory
                    at.memory.stuck = wp.min(at.memory.stuck, int(Stick.STUCK))
                at.memory.key = first + n
                w.contacts[new, b, place + n] = at
        m = m + POINTS * lane_count(hit)
    return m - begin


@wp.func
def list_contacts(tree: Trees, touch: Touches, w: Work, me: Thread, margin: real, old: int, new: int):
    """Lists the points of all pairs of a fibre and a capsule closer than ``margin``, sorted by their keys, in the list
    ``new``; those of the list ``old`` keep what friction has stretched.

    Returns:
        The number of points, or -1 if there is no room for them.
    """
    b = me.b
    for i in range(1 + me.lane, me.n, me.lanes):
        w.segments.contact_count[b, i] = nearby_capsules(tree, touch, w, me, i, margin)
    sync()
    m = int(0)
    for i in range(1, me.n):
        which = w.segments.contact_count[b, i]
        if which == 0:
            continue
        begin = m
        for k in range(touch.half.shape[0]):
            if (which >> k) & 1 == 1:
                m = m + append_contacts(tree, touch, w, me, i, k, margin, old, new, m)
        sync()
        if me.lane == 0:
            w.segments.first_contact[b, i] = begin
            w.segments.contact_count[b, i] = m - begin
        if m > w.contacts.shape[2]:
            break
    sync()
    if m > w.contacts.shape[2]:
        return -1
    if me.lane == 0:
        w.count[new, b] = m
    sync()
    return m


@wp.func
def activate_nodes(tree: Trees, w: Work, me: Thread, load: real):
    """Marks and lists the active nodes: those that were, and those between the root and a segment that is close to a
    capsule or heavy (``load``, the sum of the plant's weights [N]). Returns their number and the number of their
    levels."""
    b = me.b
    o = me.o
    for back in range(1, me.high + 1):
        d = me.high - back
        for r in range(tree.level[me.low + d] + me.lane, tree.level[me.low + d + 1], me.lanes):
            i = tree.rank[r]
            on = wp.where(load > ZERO, 1, w.nodes.active[b, i])
            clear = real(1.0)
            if i == 0:
                on = 1
            else:
                clear = w.nodes.segment_clearance[b, i]
                if w.segments.contact_count[b, i] > 0:
                    on = 1
            room = real(1.0)
            rider = ZERO
            kid = tree.child[o + i]
            while kid >= 0:
                if w.nodes.active[b, kid] == 1:
                    on = 1
                    room = wp.min(room, w.nodes.segment_clearance[b, kid])
                else:
                    clear = wp.min(clear, w.nodes.segment_clearance[b, kid])  # the node carries the child's branch
                    rider = wp.max(rider, tree.length[o + kid] + tree.reach[o + kid])
                kid = tree.next[o + kid]
            w.nodes.active[b, i] = on
            w.nodes.segment_clearance[b, i] = clear
            w.nodes.node_clearance[b, i] = wp.min(clear, room)  # a node moves its own segment and its children's
            w.nodes.unloaded_reach[b, i] = wp.where(on == 1, rider, ZERO)
        sync()
    count = int(0)
    levels = int(0)
    for d in range(me.high):
        begin = tree.level[me.low + d]
        stop = tree.level[me.low + d + 1]
        if me.lane == 0:
            w.nodes.level[b, d] = count
        before = count
        for base in range(begin, stop, me.lanes):
            r = base + me.lane
            i = int(0)
            on = int(0)
            if r < stop:
                i = tree.rank[r]
                on = w.nodes.active[b, i]
            place = count + lanes_before(on)
            if on == 1:
                w.nodes.order[b, place] = i
            count = count + lane_count(on)
        if count == before:
            break
        levels = d + 1
    if me.lane == 0:
        w.nodes.level[b, levels] = count
    sync()
    return count, levels
