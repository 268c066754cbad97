"""A touch in one thread: frame after frame, each in strides that nothing can be jumped in, retried in shorter ones, its forces written out.

A launch goes on until every touch has used up its share of Newton iterations, so that no touch waits long for a harder one, and the next launch goes on where it stopped: the bits do not
depend on the shares. On a GPU one thread of every ``lanes`` works: touches that share a warp wait for one another wherever they part.
"""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Results, Touches, Trees, Work
from vsfsim.physics.rods.assembly import vec6
from vsfsim.physics.rods.newton import balance
from vsfsim.physics.rods.search import ride, surface_point
from vsfsim.physics.rods.segment import ONE, ZERO, energy, gradient, real, six, strain, vec3
from vsfsim.physics.rods.touching import friction_force, gap_of, normal_force, point_at, slip

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

STRIDE = wp.constant(wp.float64(0.004))  # longest way of a capsule between two equilibria [m]
SHORTER = wp.constant(wp.float64(1.0 / 64.0))  # of it: where retries end
WORK = wp.constant(800)  # Newton iterations that one frame may take, retries included


@wp.func
def capsules_at(touch: Touches, w: Work, b: int, t: int, from_part: real, part: real):
    """Poses of the capsules a part of the way from frame t - 1 to frame t, and of the step's start. Their longest way of all, frame to frame [m]."""
    way = ZERO
    before = wp.max(t - 1, 0)
    for k in range(touch.half.shape[0]):
        x0 = touch.place[before, b, k]
        x1 = touch.place[t, b, k]
        q0 = touch.turn[before, b, k]
        q1 = touch.turn[t, b, k]
        if wp.dot(q0, q1) < ZERO:
            q1 = -q1
        w.cap_x_start[b, k] = x0 + from_part * (x1 - x0)
        w.cap_q_start[b, k] = wp.normalize(q0 + from_part * (q1 - q0))
        w.cap_x[b, k] = x0 + part * (x1 - x0)
        w.cap_q[b, k] = wp.normalize(q0 + part * (q1 - q0))
        turn = real(2.0) * wp.length(q1 - q0)
        way = wp.max(way, wp.length(x1 - x0) + turn * (touch.half[k] + touch.radius[k]))
    return way


@wp.func
def settle(tree: Trees, touch: Touches, w: Work, b: int, o: int, n: int, side: int, count: int, weighs: int, found: int):
    """The step is done: contacts remember where they stick, segments whether they are strained."""
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        cx = w.cap_x[b, k]
        cq = w.cap_q[b, k]
        y = point_at(tree.along[j], tree.offset[j], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
        gap = gap_of(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            ys = surface_point(tree, w, b, p, i, j, w.lever[side, b, c], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
            u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
            held = friction_force(u, tree.penalty[j], w.tau[side, b, c]) / tree.penalty[j]
            w.anchor[side, b, c] = wp.quat_rotate_inv(cq, y - tree.radius[j] * gap.normal - held - cx)
            w.stuck[side, b, c] = 1
        else:
            w.stuck[side, b, c] = 0
    for i in range(n):
        w.strained[b, i] = 0
    kept = int(1)  # 0: unloaded parts went back to their shape
    through = int(0)
    if found == 1 and weighs == 0:
        # what nothing presses any more is unloaded: it is put where its joint carries it, to the last bit
        for c in range(w.count[side, b]):
            if w.stuck[side, b, c] == 1:
                w.strained[b, w.node[side, b, c]] = 1
        for up in range(1, n):
            i = n - up
            if w.strained[b, i] == 1:
                w.strained[b, tree.parent[o + i]] = 1
        for i in range(n):
            w.x_keep[b, i] = w.x[b, i]
            w.q_keep[b, i] = w.q[b, i]
            w.active[b, i] = wp.where(i == 0, 1, w.strained[b, i])
        ride(tree, w, b, o, n)
        for c in range(w.count[side, b]):
            if w.stuck[side, b, c] == 0:
                i = w.node[side, b, c]
                k = w.body[side, b, c]
                j = w.sample[side, b, c]
                p = tree.parent[o + i]
                y = point_at(tree.along[j], tree.offset[j], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
                gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
                if gap.value < ZERO:
                    through = 1  # a soft leaf, bent by less than the tolerance, would go back through a link: it stays as it is
        if through == 0:
            kept = 0
        else:
            for i in range(n):
                w.x[b, i] = w.x_keep[b, i]
                w.q[b, i] = w.q_keep[b, i]
                w.active[b, i] = 0
                w.strained[b, i] = 0
            w.active[b, 0] = 1
    if kept == 1:
        for a in range(1, count):
            w.active[b, w.order[b, a]] = 1
            w.strained[b, w.order[b, a]] = 1


@wp.func
def report(tree: Trees, touch: Touches, w: Work, out: Results, b: int, o: int, n: int, t: int, side: int, count: int):
    """Forces on the capsules and the pot, and the audit of a frame. The sum of the contact forces [N]."""
    for k in range(touch.half.shape[0]):
        out.force[t, b, k] = vec3()
        out.moment[t, b, k] = vec3()
    total = ZERO
    deepest = ZERO
    touching = int(0)
    slipping = int(0)
    root = vec6()
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        cx = w.cap_x[b, k]
        y = point_at(tree.along[j], tree.offset[j], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
        gap = gap_of(y, tree.radius[j], cx, w.cap_q[b, k], touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            fn = -normal_force(-gap.value, tree.penalty[j]) * gap.normal
            at_root = wp.where(p == 0, ONE - tree.along[j], ZERO)  # the share of it that the clamp takes without bending anything
            lp = wp.quat_rotate(w.q[b, p], tree.offset[j])
            root = root + at_root * six(fn, wp.cross(lp, fn))
            force = fn
            moment = wp.cross(y - cx, fn)
            tau = w.tau[side, b, c]
            if tau > ZERO:
                ys = surface_point(tree, w, b, p, i, j, w.lever[side, b, c], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
                u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
                ft = friction_force(u, tree.penalty[j], tau)
                lps = lp + wp.quat_rotate(w.q[b, p], wp.quat_rotate_inv(w.q_start[b, p], w.lever[side, b, c]))
                root = root + at_root * six(ft, wp.cross(lps, ft))
                force = force + ft
                moment = moment + wp.cross(ys - cx, ft)
                if tree.penalty[j] * wp.length(u) > tau:
                    slipping = slipping + 1
            out.force[t, b, k] = out.force[t, b, k] + force
            out.moment[t, b, k] = out.moment[t, b, k] + moment
            total = total + wp.length(force)
            deepest = wp.max(deepest, -gap.value)
            touching = touching + 1
    stored = ZERO
    for a in range(1, count):
        i = w.order[b, a]
        p = tree.parent[o + i]
        s = strain(w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i], tree.frame[o + i], tree.length[o + i])
        stored = stored + energy(s, tree.kd[o + i], tree.kphi[o + i])
        if p == 0:
            f, _mc, mp = gradient(s, tree.kd[o + i], tree.kphi[o + i])
            root = root + six(-f, mp)
    out.reaction[t, b] = root
    out.energy[t, b] = stored
    out.penetration[t, b] = deepest
    out.contacts[t, b] = touching
    out.slipping[t, b] = real(slipping) / real(wp.max(touching, 1))
    if out.x.shape[0] > 0:
        for i in range(n):
            out.x[t, b, i] = w.x[b, i]
            out.q[t, b, i] = w.q[b, i]
    return total


@wp.kernel(enable_backward=False)
def advance(
    # model
    tree: Trees,
    touch: Touches,
    live: wp.array(dtype=wp.int32),
    lanes: int,
    share: int,
    weighs: int,
    # state in and out
    w: Work,
    # state out
    out: Results,
):
    thread = wp.tid()
    if thread % lanes != 0:
        return
    b = live[thread / lanes]
    plant = touch.plant[b]
    o = tree.first[plant]
    n = tree.first[plant + 1] - o
    load = ZERO
    if weighs == 1:
        for i in range(n):
            load = load + wp.length(tree.load[o + i])
    taken = int(0)
    for t in range(w.next[b], touch.frames[b]):
        if w.ended[b] == 0 and taken < share:
            way = capsules_at(touch, w, b, t, ZERO, ONE)
            base = ONE / wp.ceil(wp.max(way / STRIDE, ONE))
            h = base
            part = ZERO
            used = int(0)
            reason = int(0)
            residual = ZERO
            count = int(0)
            while part < real(1.0 - 1e-9):
                goal = wp.min(part + h, ONE)
                if goal > real(1.0 - 1e-9):
                    goal = ONE
                way = capsules_at(touch, w, b, t, part, goal)
                for i in range(n):
                    w.x_start[b, i] = w.x[b, i]
                    w.q_start[b, i] = w.q[b, i]
                old = w.side[b]
                new = 1 - old
                reason, its, residual, count = balance(tree, touch, w, b, o, n, old, new, weighs, load)
                used = used + its
                if reason != 0 and (reason == 4 or (h > base * SHORTER and used < WORK)):
                    for i in range(n):
                        w.x[b, i] = w.x_start[b, i]
                        w.q[b, i] = w.q_start[b, i]
                    h = real(0.25) * h
                    if h <= base * SHORTER or used >= WORK:
                        # the state that was not finite is given up: what is kept is the one before
                        part = ONE
                else:
                    if reason != 5:
                        settle(tree, touch, w, b, o, n, new, count, weighs, wp.where(reason == 0, 1, 0))
                        w.side[b] = new
                    part = goal
                    h = wp.min(real(2.0) * h, base)
            total = report(tree, touch, w, out, b, o, n, t, w.side[b], count)
            out.residual[t, b] = residual
            out.iterations[t, b] = used
            out.reason[t, b] = reason
            taken = taken + used + 1
            w.next[b] = t + 1
            if total > touch.force_limit:
                w.ended[b] = t + 1  # this frame is not kept
