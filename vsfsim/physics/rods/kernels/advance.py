"""The kernel that advances touches: frame after frame, each in strides short enough that no branch can be jumped over.

A stride that finds no equilibrium is divided. A launch ends when every touch has used its share of Newton iterations,
on a GPU also when its time is up, so that no touch waits long for a harder one. The next launch continues where it
stopped, if need be in the middle of a frame; the bits do not depend on where launches end. On a GPU one warp works on a
touch, see `lanes`. The module `guard` decides where the arm is in a frame and when it turns back.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.contact_law import capsule_gap, friction_force, normal_force, slip
from vsfsim.physics.rods.kernels.contact_search import carry_unloaded
from vsfsim.physics.rods.kernels.crossing import crossing
from vsfsim.physics.rods.kernels.fibre import POINTS, child_share, fibre_point, parent_offset
from vsfsim.physics.rods.kernels.geometry import fibre_patch, segment_strain, surface_point
from vsfsim.physics.rods.kernels.guard import HOPELESS, copy_nodes, frame_target, guard_frame, place_capsules
from vsfsim.physics.rods.kernels.lanes import LANES, lane_count, lane_max, lane_sum, sync, time_is_up
from vsfsim.physics.rods.kernels.newton import equilibrate
from vsfsim.physics.rods.kernels.segment import ONE, ZERO, gradient, real, spatial, vec3
from vsfsim.physics.rods.kernels.yielding import has_yielded, segment_energy, segment_moment, yield_segment
from vsfsim.physics.rods.structs import Results, Stick, Thread, Touches, Trees, Work
from vsfsim.physics.solve.frames import Reason

# the block that a GPU's launches have, so that compiling ahead compiles what is launched
wp.set_module_options({"enable_backward": False, "max_unroll": 1, "block_dim": LANES})

STRIDE = wp.constant(wp.float64(0.004))  # longest way of a capsule between two equilibria [m]
SHORTEST = wp.constant(wp.float64(1.0 / 64.0))  # least length of a divided stride, as a part of the undivided one
DEEP = wp.constant(wp.float64(1e-3))  # a point further inside a link may come out on its wrong side [m]
# The same as a share of the way from a link's surface to its axis, for thin ones, where it is less [-].
DEEP_SHARE = wp.constant(wp.float64(0.5))
PASSED = wp.constant(2)  # `Progress.wrong_side`: a capsule went through the plant
# Registers of a thread on a GPU. 128 allow 16 warps a multiprocessor, the compiler's 255 only 8; on an H200 the solver
# then gives 1.6 times as many readings a second of easy touches.
REGISTERS = 128
WHOLE = wp.constant(wp.float64(1.0 - 1e-9))  # a frame, up to rounding


@wp.func
def capsules_cross(tree: Trees, touch: Touches, w: Work, me: Thread):
    """Number of segments of the plant, which stands still, that the capsules pass through in a stride."""
    return crossing(tree, touch.half, w.nodes.order, me, 0, w.nodes.x, w.nodes.q, w.capsules.x_start,
                    w.capsules.q_start, w.nodes.x, w.nodes.q, w.capsules.x, w.capsules.q)


@wp.func
def commit_stride(tree: Trees, touch: Touches, w: Work, me: Thread, side: int, count: int, weighs: int, found: int):
    """Ends a stride: stores what friction has stretched, how far wires have yielded in an equilibrium, and which
    segments are strained.

    Args:
        side: list of the contacts. count: of active nodes. weighs: whether the plants have weight. found: whether an
        equilibrium was found.
    """
    b = me.b
    o = me.o
    for c in range(me.lane, w.contacts.count[side, b], me.lanes):
        i = w.contacts.node[side, b, c]
        k = w.contacts.capsule[side, b, c]
        j = w.contacts.fibre[side, b, c]
        s = w.contacts.place[side, b, c]
        p = tree.parent[o + i]
        cq = w.capsules.q[b, k]
        y = fibre_point(tree, b, o, p, i, j, s, w.nodes.x, w.nodes.q)
        gap = capsule_gap(y, tree.radius[j], w.capsules.x[b, k], cq, touch.half[k], touch.radius[k])
        w.contacts.stuck[side, b, c] = wp.where(gap.value < ZERO, int(Stick.STUCK), int(Stick.FREE))
        tau = w.contacts.friction_limit[side, b, c]
        w.contacts.stretch[side, b, c] = vec3()
        if gap.value < ZERO and tau > ZERO:
            ys = surface_point(tree, w, b, o, p, i, j, s, w.contacts.lever[side, b, c], w.nodes.x, w.nodes.q)
            u = slip(w.contacts.normal[side, b, c], ys, w.contacts.anchor[side, b, c])
            kn = w.contacts.stiffness[side, b, c]
            w.contacts.stretch[side, b, c] = wp.quat_rotate_inv(cq, friction_force(u, kn, tau) / kn)
    if found == 1:
        for a in range(1 + me.lane, count, me.lanes):
            i = w.nodes.order[b, a]
            strains = segment_strain(tree, b, o, tree.parent[o + i], i, w.nodes.x, w.nodes.q)
            yield_segment(tree, w, b, o, i, strains)
    sync()
    kept = int(1)  # 0: the unloaded parts returned to their shape at rest
    if found == 1 and weighs == 0:
        # a part of the tree without contacts is unloaded: it moves rigidly with its joint, to the last bit; a segment
        # that has yielded has another shape at rest, and its bending remains an unknown
        for back in range(me.high):
            d = me.high - 1 - back
            for r in range(tree.level[me.low + d] + me.lane, tree.level[me.low + d + 1], me.lanes):
                i = tree.rank[r]
                on = has_yielded(w, b, i)
                first = w.segments.first_contact[b, i]
                for c in range(first, first + w.segments.contact_count[b, i]):
                    if w.contacts.stuck[side, b, c] == Stick.STUCK:
                        on = 1
                kid = tree.child[o + i]
                while kid >= 0:
                    on = wp.max(on, w.nodes.strained[b, kid])
                    kid = tree.next[o + kid]
                w.nodes.strained[b, i] = on
                w.nodes.active[b, i] = wp.where(i == 0, 1, on)
            sync()
        copy_nodes(me, w.nodes.x, w.nodes.q, w.nodes.x_saved, w.nodes.q_saved)
        carry_unloaded(tree, w, me)
        through = int(0)
        for pair in range(me.lane, w.contacts.count[side, b] / POINTS, me.lanes):
            if w.contacts.stuck[side, b, POINTS * pair] == Stick.FREE:
                i = w.contacts.node[side, b, POINTS * pair]
                k = w.contacts.capsule[side, b, POINTS * pair]
                j = w.contacts.fibre[side, b, POINTS * pair]
                patch = fibre_patch(tree, touch, b, o, tree.parent[o + i], i, j, k, w.nodes.x, w.nodes.q,
                                    w.capsules.x[b, k], w.capsules.q[b, k])
                if patch.gap < ZERO:
                    # a soft leaf, bent by less than the tolerance, would return through a link: it stays bent
                    through = 1
        if lane_count(through) == 0 and crossing(
            tree, touch.half, w.nodes.order, me, 0, w.nodes.x_saved, w.nodes.q_saved, w.capsules.x, w.capsules.q,
            w.nodes.x, w.nodes.q, w.capsules.x, w.capsules.q
        ) == 0:
            kept = 0
        else:
            copy_nodes(me, w.nodes.x_saved, w.nodes.q_saved, w.nodes.x, w.nodes.q)
    if kept == 1:
        for i in range(me.lane, me.n, me.lanes):
            w.nodes.active[b, i] = wp.where(i == 0, 1, 0)
            w.nodes.strained[b, i] = 0
        sync()
        for a in range(1 + me.lane, count, me.lanes):
            w.nodes.active[b, w.nodes.order[b, a]] = 1
            w.nodes.strained[b, w.nodes.order[b, a]] = 1
    sync()


@wp.func
def write_frame(tree: Trees, touch: Touches, w: Work, out: Results, me: Thread, t: int, side: int, count: int):
    """Writes the forces on the capsules and the pot and the audit of frame ``t``.

    Returns:
        The sum of the contact forces [N], the deepest penetration over the depth at which a point may come out on the
        wrong side [-], and the number of patches that touch.
    """
    b = me.b
    o = me.o
    pressed = ZERO
    deepest = ZERO
    sunk = ZERO
    touching = int(0)
    slipping = int(0)
    pressing = int(0)
    root_f = vec3()
    root_m = vec3()
    for c in range(me.lane, w.contacts.count[side, b], me.lanes):
        i = w.contacts.node[side, b, c]
        k = w.contacts.capsule[side, b, c]
        j = w.contacts.fibre[side, b, c]
        s = w.contacts.place[side, b, c]
        kn = w.contacts.stiffness[side, b, c]
        p = tree.parent[o + i]
        cx = w.capsules.x[b, k]
        cq = w.capsules.q[b, k]
        force = vec3()
        moment = vec3()
        if c % POINTS == 0:
            patch = fibre_patch(tree, touch, b, o, p, i, j, k, w.nodes.x, w.nodes.q, cx, cq)
            deepest = wp.max(deepest, -patch.gap)
            sunk = wp.max(sunk, -patch.gap / wp.min(DEEP, DEEP_SHARE * (touch.radius[k] + tree.radius[j])))
            if patch.gap < ZERO:
                touching = touching + 1
        y = fibre_point(tree, b, o, p, i, j, s, w.nodes.x, w.nodes.q)
        gap = capsule_gap(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            fn = -normal_force(-gap.value, kn) * gap.normal
            # the share that the clamp bears without bending anything
            at_root = wp.where(p == 0, ONE - child_share(s), ZERO)
            lp = wp.quat_rotate(w.nodes.q[b, p], parent_offset(tree, o, p, i, j, s))
            root_f = root_f + at_root * fn
            root_m = root_m + at_root * wp.cross(lp, fn)
            force = fn
            moment = wp.cross(y - cx, fn)
            pressing = pressing + 1
            tau = w.contacts.friction_limit[side, b, c]
            if tau > ZERO:
                ys = surface_point(tree, w, b, o, p, i, j, s, w.contacts.lever[side, b, c], w.nodes.x, w.nodes.q)
                u = slip(w.contacts.normal[side, b, c], ys, w.contacts.anchor[side, b, c])
                ft = friction_force(u, kn, tau)
                lever = wp.quat_rotate_inv(w.nodes.q_start[b, p], w.contacts.lever[side, b, c])
                lps = lp + wp.quat_rotate(w.nodes.q[b, p], lever)
                root_f = root_f + at_root * ft
                root_m = root_m + at_root * wp.cross(lps, ft)
                force = force + ft
                moment = moment + wp.cross(ys - cx, ft)
                if kn * wp.length(u) > tau:
                    slipping = slipping + 1
            pressed = pressed + wp.length(force)
        w.contacts.force[b, c] = force
        w.contacts.moment[b, c] = moment
    stored = ZERO
    heat = ZERO
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        p = tree.parent[o + i]
        strains = segment_strain(tree, b, o, p, i, w.nodes.x, w.nodes.q)
        stored = stored + segment_energy(tree, w, b, o, i, strains)
        heat = heat + w.nodes.heat[b, i]
        if p == 0:
            f, _mc, mp = gradient(strains, tree.kd[o + i], segment_moment(tree, w, b, o, i, strains))
            root_f = root_f - f
            root_m = root_m + mp
    sync()
    for k in range(me.lane, touch.half.shape[0], me.lanes):
        force = vec3()
        moment = vec3()
        for c in range(w.contacts.count[side, b]):
            if w.contacts.capsule[side, b, c] == k:
                force = force + w.contacts.force[b, c]
                moment = moment + w.contacts.moment[b, c]
        out.force[b, t, k] = force
        out.moment[b, t, k] = moment
    pressed = lane_sum(pressed)
    stored = lane_sum(stored)
    heat = lane_sum(heat)
    deepest = lane_max(deepest)
    sunk = lane_max(sunk)
    touching = lane_count(touching)
    slipping = lane_count(slipping)
    pressing = lane_count(pressing)
    root = spatial(vec3(lane_sum(root_f[0]), lane_sum(root_f[1]), lane_sum(root_f[2])),
                   vec3(lane_sum(root_m[0]), lane_sum(root_m[1]), lane_sum(root_m[2])))
    if me.lane == 0:
        out.reaction[b, t] = root
        out.energy[b, t] = stored
        out.heat[b, t] = heat
        out.penetration[b, t] = deepest
        out.contacts[b, t] = touching
        out.slipping[b, t] = real(slipping) / real(wp.max(pressing, 1))
    if out.x.shape[1] > 0:
        for i in range(me.lane, me.n, me.lanes):
            out.x[b, t, i] = w.nodes.x[b, i]
            out.q[b, t, i] = w.nodes.q[b, i]
    sync()
    return pressed, sunk, touching


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def advance(
    # model
    tree: Trees,
    touch: Touches,
    live: wp.array(dtype=wp.int32),
    lanes: int,
    share: int,
    span: wp.int64,
    weighs: int,
    # state in and out
    clock: wp.array(dtype=wp.uint64),
    w: Work,
    # state out
    out: Results,
):
    """Advances the touches ``live`` with ``lanes`` threads each, until each has used ``share`` Newton iterations or
    ``span`` [ns] have passed; ``weighs``: whether any plant has weight."""
    thread = wp.tid()
    me = Thread()
    b = live[thread / lanes]
    plant = touch.plant[b]
    me.b = b
    me.lane = thread % lanes
    me.lanes = lanes
    me.o = tree.first[plant]
    me.n = tree.first[plant + 1] - me.o
    me.low = tree.levels[plant]
    me.high = tree.levels[plant + 1] - me.low - 1
    load = ZERO
    if weighs == 1:
        for i in range(me.n):
            load = load + wp.length(tree.load[me.o + i])
    taken = int(0)
    frames = touch.frames[b]
    t = w.progress.next[b]
    ended = w.progress.ended[b]
    side = w.progress.list[b]
    wrong_side = w.progress.wrong_side[b]
    go = int(1)
    while go == 1 and ended == 0 and t < frames:
        goal = frame_target(touch, w, me, t)
        way = place_capsules(touch, w, me, w.guard.position[b], goal, ZERO, ONE)
        base = ONE / wp.ceil(wp.max(way / STRIDE, ONE))
        part = w.progress.part[b]
        h = w.progress.stride[b]
        used = w.progress.used[b]
        broken = w.progress.broken[b]
        work = touch.work
        if touch.guarded == 1 and w.guard.failures[b] >= HOPELESS:
            work = 0
        if h == ZERO:
            h = base
        reason = int(Reason.NONE)
        residual = ZERO
        count = int(0)
        lost = int(0)
        skipped = int(0)
        while go == 1 and part < WHOLE:
            if taken >= share or time_is_up(clock, span) == 1:
                go = 0
            else:
                to = wp.min(part + h, ONE)
                if to > WHOLE:
                    to = ONE
                way = place_capsules(touch, w, me, w.guard.position[b], goal, part, to)
                copy_nodes(me, w.nodes.x, w.nodes.q, w.nodes.x_start, w.nodes.q_start)
                reason = int(Reason.WRONG_SIDE)
                its = int(0)
                if capsules_cross(tree, touch, w, me) == 0:
                    reason, its, residual, count = equilibrate(tree, touch, w, me, side, 1 - side, weighs, load)
                used = used + its
                taken = taken + its + 1
                if reason == Reason.NOT_FINITE or (
                    reason != Reason.NONE and h > real(1.5) * base * SHORTEST
                    and (used < work or reason == Reason.WRONG_SIDE)
                ):
                    copy_nodes(me, w.nodes.x_start, w.nodes.q_start, w.nodes.x, w.nodes.q)
                    h = real(0.25) * h
                    if reason == Reason.NOT_FINITE and (h < base * SHORTEST or used >= work):
                        skipped = 1  # the state before this stride is kept
                elif reason == Reason.WRONG_SIDE:
                    wrong_side = PASSED  # the capsules go on, and what they passed is lost
                    part = to
                    h = wp.min(real(2.0) * h, base)
                else:
                    if reason != Reason.PATCH:
                        side = 1 - side
                        commit_stride(tree, touch, w, me, side, count, weighs, wp.where(reason == Reason.NONE, 1, 0))
                    if reason != Reason.NONE:
                        broken = 1
                    part = to
                    h = wp.min(real(2.0) * h, base)
                    if touch.guarded == 1 and reason != Reason.NONE and work > 0 and used >= 2 * work:
                        skipped = 1  # the guard restarts from the last equilibrium, the rest of the frame is skipped
                        lost = 1
                if skipped == 1 and part < WHOLE:
                    place_capsules(touch, w, me, w.guard.position[b], goal, part, ONE)
                    if capsules_cross(tree, touch, w, me) > 0:
                        wrong_side = PASSED
                    place_capsules(touch, w, me, w.guard.position[b], goal, part, to)
                    part = ONE
        if part < WHOLE:
            # the launch is over; the next one continues here
            sync()
            if me.lane == 0:
                w.progress.part[b] = part
                w.progress.stride[b] = h
                w.progress.used[b] = used
                w.progress.broken[b] = broken
                w.progress.list[b] = side
                w.progress.wrong_side[b] = wrong_side
        else:
            pressed, sunk, touching = write_frame(tree, touch, w, out, me, t, side, count)
            # After a failed frame a leaf may be inside a link, where it can find an equilibrium pierced by it, or come
            # out on the other side. Such frames are marked until nothing touches any more.
            # What a capsule went through stays on its wrong side, touching or not, to the end of the touch.
            if sunk > ONE or lost == 1:
                wrong_side = wp.max(wrong_side, 1)
            elif touching == 0 and reason == Reason.NONE and wrong_side < PASSED:
                wrong_side = 0
            if wrong_side > 0 and reason == Reason.NONE:
                reason = Reason.WRONG_SIDE
            kept, restored, stopped = guard_frame(touch, w, me, t, goal, side, pressed, touching, reason,
                                                  wp.min(wrong_side, 1))
            if restored == 1:
                wrong_side = 0
            if stopped == 1 or (pressed > touch.force_limit and touch.guarded == 0):
                ended = t + 1  # this frame is not kept
            total_used = w.progress.total[b] + used
            if total_used > touch.patience and kept == 1 and ended == 0:
                ended = t + 2  # this frame is kept
            sync()
            if me.lane == 0:
                if kept == 1:
                    out.residual[b, t] = residual
                    out.iterations[b, t] = used
                    # the guard goes by the end of the frame alone: what it does next needs no path
                    out.reason[b, t] = wp.where(reason == Reason.NONE and broken == 1, int(Reason.PATH), reason)
                    out.where[b, t] = goal
                w.progress.part[b] = ZERO
                w.progress.stride[b] = ZERO
                w.progress.used[b] = wp.where(kept == 1, 0, used)
                w.progress.broken[b] = 0
                w.progress.total[b] = wp.where(kept == 1, total_used, w.progress.total[b])
                w.progress.next[b] = t + kept
                w.progress.ended[b] = ended
                w.progress.list[b] = side
                w.progress.wrong_side[b] = wrong_side
            t = t + kept
            sync()
