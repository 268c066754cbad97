"""A touch: frame after frame, each in strides that nothing can be jumped in, retried in shorter ones, its forces written out.

A launch goes on until every touch has used up its share of Newton iterations, so that no touch waits long for a harder one, and the next launch goes on where it stopped: the bits do not
depend on the shares. On a GPU one warp works on a touch, see `lanes`.
"""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Here, Results, Touches, Trees, Work
from vsfsim.physics.rods.lanes import count_all, meet, most, total
from vsfsim.physics.rods.newton import balance
from vsfsim.physics.rods.search import ride, surface_point
from vsfsim.physics.rods.segment import ONE, ZERO, energy, gradient, quat, real, six, strain, vec3
from vsfsim.physics.rods.touching import friction_force, gap_of, normal_force, point_at, slip

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

STRIDE = wp.constant(wp.float64(0.004))  # longest way of a capsule between two equilibria [m]
SHORTER = wp.constant(wp.float64(1.0 / 64.0))  # of it: where retries end
WORK = wp.constant(800)  # Newton iterations that one frame may take, retries included
DEEP = wp.constant(wp.float64(1e-3))  # m: what is further inside a link may come out on its wrong side
ASTRAY = wp.constant(6)  # frames.Reason


@wp.func
def capsules_at(touch: Touches, w: Work, at: Here, t: int, from_part: real, part: real):
    """Poses of the capsules a part of the way from frame t - 1 to frame t, and of the step's start. Their longest way of all, frame to frame [m]."""
    b = at.b
    way = ZERO
    before = wp.max(t - 1, 0)
    for k in range(at.lane, touch.half.shape[0], at.lanes):
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
    meet()
    return most(way)


@wp.func
def copy_all(at: Here, x_in: wp.array2d(dtype=vec3), q_in: wp.array2d(dtype=quat), x_out: wp.array2d(dtype=vec3), q_out: wp.array2d(dtype=quat)):
    """All nodes of one state to another."""
    for i in range(at.lane, at.n, at.lanes):
        x_out[at.b, i] = x_in[at.b, i]
        q_out[at.b, i] = q_in[at.b, i]
    meet()


@wp.func
def settle(tree: Trees, touch: Touches, w: Work, at: Here, side: int, count: int, weighs: int, found: int):
    """The step is done: contacts remember where they stick, segments whether they are strained."""
    b = at.b
    o = at.o
    for c in range(at.lane, w.count[side, b], at.lanes):
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
    meet()
    kept = int(1)  # 0: unloaded parts went back to their shape
    if found == 1 and weighs == 0:
        # what nothing presses any more is unloaded: it is put where its joint carries it, to the last bit
        for back in range(at.high):
            d = at.high - 1 - back
            for r in range(tree.level[at.low + d] + at.lane, tree.level[at.low + d + 1], at.lanes):
                i = tree.rank[r]
                on = int(0)
                for c in range(w.first[b, i], w.first[b, i] + w.many[b, i]):
                    if w.stuck[side, b, c] == 1:
                        on = 1
                kid = tree.child[o + i]
                while kid >= 0:
                    on = wp.max(on, w.strained[b, kid])
                    kid = tree.next[o + kid]
                w.strained[b, i] = on
                w.active[b, i] = wp.where(i == 0, 1, on)
            meet()
        copy_all(at, w.x, w.q, w.x_keep, w.q_keep)
        ride(tree, w, at)
        through = int(0)
        for c in range(at.lane, w.count[side, b], at.lanes):
            if w.stuck[side, b, c] == 0:
                i = w.node[side, b, c]
                k = w.body[side, b, c]
                j = w.sample[side, b, c]
                p = tree.parent[o + i]
                y = point_at(tree.along[j], tree.offset[j], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
                gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
                if gap.value < ZERO:
                    through = 1  # a soft leaf, bent by less than the tolerance, would go back through a link: it stays as it is
        if count_all(through) == 0:
            kept = 0
        else:
            copy_all(at, w.x_keep, w.q_keep, w.x, w.q)
    if kept == 1:
        for i in range(at.lane, at.n, at.lanes):
            w.active[b, i] = wp.where(i == 0, 1, 0)
            w.strained[b, i] = 0
        meet()
        for a in range(1 + at.lane, count, at.lanes):
            w.active[b, w.order[b, a]] = 1
            w.strained[b, w.order[b, a]] = 1
    meet()


@wp.func
def report(tree: Trees, touch: Touches, w: Work, out: Results, at: Here, t: int, side: int, count: int):
    """Forces on the capsules and the pot, and the audit of a frame. The sum of the contact forces [N], the deepest penetration [m] and how many samples touch."""
    b = at.b
    o = at.o
    pressed = ZERO
    deepest = ZERO
    touching = int(0)
    slipping = int(0)
    root_f = vec3()
    root_m = vec3()
    for c in range(at.lane, w.count[side, b], at.lanes):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        cx = w.cap_x[b, k]
        force = vec3()
        moment = vec3()
        y = point_at(tree.along[j], tree.offset[j], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
        gap = gap_of(y, tree.radius[j], cx, w.cap_q[b, k], touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            fn = -normal_force(-gap.value, tree.penalty[j]) * gap.normal
            at_root = wp.where(p == 0, ONE - tree.along[j], ZERO)  # the share of it that the clamp takes without bending anything
            lp = wp.quat_rotate(w.q[b, p], tree.offset[j])
            root_f = root_f + at_root * fn
            root_m = root_m + at_root * wp.cross(lp, fn)
            force = fn
            moment = wp.cross(y - cx, fn)
            tau = w.tau[side, b, c]
            if tau > ZERO:
                ys = surface_point(tree, w, b, p, i, j, w.lever[side, b, c], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
                u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
                ft = friction_force(u, tree.penalty[j], tau)
                lps = lp + wp.quat_rotate(w.q[b, p], wp.quat_rotate_inv(w.q_start[b, p], w.lever[side, b, c]))
                root_f = root_f + at_root * ft
                root_m = root_m + at_root * wp.cross(lps, ft)
                force = force + ft
                moment = moment + wp.cross(ys - cx, ft)
                if tree.penalty[j] * wp.length(u) > tau:
                    slipping = slipping + 1
            pressed = pressed + wp.length(force)
            deepest = wp.max(deepest, -gap.value)
            touching = touching + 1
        w.out_f[b, c] = force
        w.out_m[b, c] = moment
    stored = ZERO
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        p = tree.parent[o + i]
        s = strain(w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i], tree.frame[o + i], tree.length[o + i])
        stored = stored + energy(s, tree.kd[o + i], tree.kphi[o + i])
        if p == 0:
            f, _mc, mp = gradient(s, tree.kd[o + i], tree.kphi[o + i])
            root_f = root_f - f
            root_m = root_m + mp
    meet()
    for k in range(at.lane, touch.half.shape[0], at.lanes):
        force = vec3()
        moment = vec3()
        for c in range(w.count[side, b]):
            if w.body[side, b, c] == k:
                force = force + w.out_f[b, c]
                moment = moment + w.out_m[b, c]
        out.force[t, b, k] = force
        out.moment[t, b, k] = moment
    everything = total(pressed)
    stored = total(stored)
    deepest = most(deepest)
    touching = count_all(touching)
    slipping = count_all(slipping)
    root = six(vec3(total(root_f[0]), total(root_f[1]), total(root_f[2])), vec3(total(root_m[0]), total(root_m[1]), total(root_m[2])))
    if at.lane == 0:
        out.reaction[t, b] = root
        out.energy[t, b] = stored
        out.penetration[t, b] = deepest
        out.contacts[t, b] = touching
        out.slipping[t, b] = real(slipping) / real(wp.max(touching, 1))
    if out.x.shape[0] > 0:
        for i in range(at.lane, at.n, at.lanes):
            out.x[t, b, i] = w.x[b, i]
            out.q[t, b, i] = w.q[b, i]
    meet()
    return everything, deepest, touching


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
    at = Here()
    b = live[thread / lanes]
    plant = touch.plant[b]
    at.b = b
    at.lane = thread % lanes
    at.lanes = lanes
    at.o = tree.first[plant]
    at.n = tree.first[plant + 1] - at.o
    at.low = tree.levels[plant]
    at.high = tree.levels[plant + 1] - at.low - 1
    load = ZERO
    if weighs == 1:
        for i in range(at.n):
            load = load + wp.length(tree.load[at.o + i])
    taken = int(0)
    ended = w.ended[b]
    side = w.side[b]
    astray = w.astray[b]
    for t in range(w.next[b], touch.frames[b]):
        if ended == 0 and taken < share:
            way = capsules_at(touch, w, at, t, ZERO, ONE)
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
                way = capsules_at(touch, w, at, t, part, goal)
                copy_all(at, w.x, w.q, w.x_start, w.q_start)
                reason, its, residual, count = balance(tree, touch, w, at, side, 1 - side, weighs, load)
                used = used + its
                if reason == 4 or (reason != 0 and h > real(1.5) * base * SHORTER and used < WORK):
                    copy_all(at, w.x_start, w.q_start, w.x, w.q)
                    h = real(0.25) * h
                    if reason == 4 and (h < base * SHORTER or used >= WORK):
                        # the state that was not finite is given up: what is kept is the one before
                        part = ONE
                else:
                    if reason != 5:
                        side = 1 - side
                        settle(tree, touch, w, at, side, count, weighs, wp.where(reason == 0, 1, 0))
                    part = goal
                    h = wp.min(real(2.0) * h, base)
            pressed, deepest, touching = report(tree, touch, w, out, at, t, side, count)
            taken = taken + used + 1
            # a frame that failed may leave a leaf in a link, where it can find an equilibrium pierced, or come out on the other side: such frames are marked until nothing touches any more
            if deepest > DEEP:
                astray = 1
            elif touching == 0 and reason == 0:
                astray = 0
            if astray == 1 and reason == 0:
                reason = ASTRAY
            if pressed > touch.force_limit:
                ended = t + 1  # this frame is not kept
            if at.lane == 0:
                out.residual[t, b] = residual
                out.iterations[t, b] = used
                out.reason[t, b] = reason
                w.next[b] = t + 1
                w.ended[b] = ended
                w.side[b] = side
                w.astray[b] = astray
            meet()
