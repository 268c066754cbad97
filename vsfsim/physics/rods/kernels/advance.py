"""A touch: frame after frame, each in strides that nothing can be jumped in, retried in shorter ones, its forces
written out.

A launch goes on until every touch has used up its share of Newton iterations, on a GPU until its time is up, so that no
touch waits long for a harder one, and the next launch goes on where it stopped,
in the middle of a frame if need be: the bits do not depend on it. On a GPU one warp works on a touch, see `lanes`.
Where the arm is in a frame, and when it turns back, says `guard`.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.guard import HOPELESS, capsules_at, copy_all, watch, where_to
from vsfsim.physics.rods.kernels.lanes import LANES, count_all, late, meet, most, total
from vsfsim.physics.rods.kernels.newton import balance
from vsfsim.physics.rods.kernels.search import ride, surface_point
from vsfsim.physics.rods.kernels.segment import ONE, ZERO, energy, gradient, real, six, strain, vec3
from vsfsim.physics.rods.kernels.touching import friction_force, gap_of, normal_force, point_at, slip
from vsfsim.physics.rods.state import Here, Results, Touches, Trees, Work

# the block that a GPU's launches have, so that compiling ahead compiles what is launched
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "block_dim": LANES})

STRIDE = wp.constant(wp.float64(0.004))  # longest way of a capsule between two equilibria [m]
SHORTER = wp.constant(wp.float64(1.0 / 64.0))  # of it: where retries end
DEEP = wp.constant(wp.float64(1e-3))  # m: what is further inside a link may come out on its wrong side
WRONG_SIDE = wp.constant(6)  # frames.Reason
# of a thread on a GPU: 16 warps a multiprocessor instead of the 8 of the compiler's 255; 1.6 times the readings a
# second of easy touches on an H200
REGISTERS = 128
WHOLE = wp.constant(wp.float64(1.0 - 1e-9))  # of a frame, but for rounding


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
                    # a soft leaf, bent by less than the tolerance, would go back through a link: it stays as it is
                    through = 1
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
    """Forces on the capsules and the pot, and the audit of a frame. The sum of the contact forces [N], the deepest
    penetration [m] and how many samples touch."""
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
            # the share of it that the clamp takes without bending anything
            at_root = wp.where(p == 0, ONE - tree.along[j], ZERO)
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
        out.force[b, t, k] = force
        out.moment[b, t, k] = moment
    everything = total(pressed)
    stored = total(stored)
    deepest = most(deepest)
    touching = count_all(touching)
    slipping = count_all(slipping)
    root = six(vec3(total(root_f[0]), total(root_f[1]), total(root_f[2])),
               vec3(total(root_m[0]), total(root_m[1]), total(root_m[2])))
    if at.lane == 0:
        out.reaction[b, t] = root
        out.energy[b, t] = stored
        out.penetration[b, t] = deepest
        out.contacts[b, t] = touching
        out.slipping[b, t] = real(slipping) / real(wp.max(touching, 1))
    if out.x.shape[1] > 0:
        for i in range(at.lane, at.n, at.lanes):
            out.x[b, t, i] = w.x[b, i]
            out.q[b, t, i] = w.q[b, i]
    meet()
    return everything, deepest, touching


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def advance(
    # model
    tree: Trees,
    touch: Touches,
    live: wp.array(dtype=wp.int32),
    lanes: int,
    share: int,
    slot: wp.int64,
    weighs: int,
    # state in and out
    clock: wp.array(dtype=wp.uint64),
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
    frames = touch.frames[b]
    t = w.next[b]
    ended = w.ended[b]
    side = w.side[b]
    astray = w.astray[b]
    go = int(1)
    while go == 1 and ended == 0 and t < frames:
        goal = where_to(touch, w, at, t)
        way = capsules_at(touch, w, at, w.at[b], goal, ZERO, ONE)
        base = ONE / wp.ceil(wp.max(way / STRIDE, ONE))
        part = w.part[b]
        h = w.stride[b]
        used = w.used[b]
        work = touch.work
        if touch.guarded == 1 and w.fails[b] >= HOPELESS:
            work = 0
        if h == ZERO:
            h = base
        reason = int(0)
        residual = ZERO
        count = int(0)
        lost = int(0)
        while go == 1 and part < WHOLE:
            if taken >= share or late(clock, slot) == 1:
                go = 0
            else:
                to = wp.min(part + h, ONE)
                if to > WHOLE:
                    to = ONE
                way = capsules_at(touch, w, at, w.at[b], goal, part, to)
                copy_all(at, w.x, w.q, w.x_start, w.q_start)
                reason, its, residual, count = balance(tree, touch, w, at, side, 1 - side, weighs, load)
                used = used + its
                taken = taken + its + 1
                if reason == 4 or (reason != 0 and h > real(1.5) * base * SHORTER and used < work):
                    copy_all(at, w.x_start, w.q_start, w.x, w.q)
                    h = real(0.25) * h
                    if reason == 4 and (h < base * SHORTER or used >= work):
                        # the state that was not finite is given up: what is kept is the one before
                        part = ONE
                else:
                    if reason != 5:
                        side = 1 - side
                        settle(tree, touch, w, at, side, count, weighs, wp.where(reason == 0, 1, 0))
                    part = to
                    h = wp.min(real(2.0) * h, base)
                    if touch.guarded == 1 and reason != 0 and work > 0 and used >= 2 * work:
                        part = ONE  # the rest of the frame is not worth it
                        lost = 1
        if part < WHOLE:
            # the launch is over: the next one goes on here
            meet()
            if at.lane == 0:
                w.part[b] = part
                w.stride[b] = h
                w.used[b] = used
                w.side[b] = side
        else:
            pressed, deepest, touching = report(tree, touch, w, out, at, t, side, count)
            # a frame that failed may leave a leaf in a link, where it can find an equilibrium pierced, or come out on
            # the other side: such frames are marked until nothing touches any more
            if deepest > DEEP or lost == 1:
                astray = 1
            elif touching == 0 and reason == 0:
                astray = 0
            if astray == 1 and reason == 0:
                reason = WRONG_SIDE
            kept, restored, stopped = watch(touch, w, at, t, goal, side, pressed, touching, reason, astray)
            if restored == 1:
                astray = 0
            if stopped == 1 or (pressed > touch.force_limit and touch.guarded == 0):
                ended = t + 1  # this frame is not kept
            total_used = w.total[b] + used
            if total_used > touch.patience and kept == 1 and ended == 0:
                ended = t + 2  # this one is
            meet()
            if at.lane == 0:
                if kept == 1:
                    out.residual[b, t] = residual
                    out.iterations[b, t] = used
                    out.reason[b, t] = reason
                    out.where[b, t] = goal
                w.part[b] = ZERO
                w.stride[b] = ZERO
                w.used[b] = wp.where(kept == 1, 0, used)
                w.total[b] = wp.where(kept == 1, total_used, w.total[b])
                w.next[b] = t + kept
                w.ended[b] = ended
                w.side[b] = side
                w.astray[b] = astray
            t = t + kept
            meet()
