"""The kernel that advances touches: frame after frame, each in strides short enough that no branch can be jumped over.

A stride that finds no equilibrium is divided. A launch ends when every touch has used its share of Newton iterations,
so that no touch waits long for a harder one, and the next launch continues there; bits do not depend on where launches
end. On a GPU one warp works on a touch, see `lanes`. A touch ends before the frame that exceeds the force limit.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels import fibre, segment
from vsfsim.physics.rods.kernels.contact_search import carry_unloaded, copy_state
from vsfsim.physics.rods.kernels.crossing import crossing
from vsfsim.physics.rods.kernels.fibre import POINTS
from vsfsim.physics.rods.kernels.lanes import LANES, lane_count, lane_max, lane_sum, sync
from vsfsim.physics.rods.kernels.newton import equilibrate
from vsfsim.physics.rods.kernels.segment import ONE, ZERO, real, vec3
from vsfsim.physics.rods.structs import Frame, Results, Stick, Thread, Touches, Trees, Work
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
vec6 = wp.spatial_vectord
WHOLE = wp.constant(wp.float64(1.0 - 1e-9))  # a frame, up to rounding


@wp.func
def place_capsules(touch: Touches, w: Work, me: Thread, before: int, goal: int, from_part: real, part: real):
    """Places the capsules at the start and the end of a stride, which are the parts ``from_part`` and ``part`` of the
    way from pose ``before`` to pose ``goal``. Returns the longest way of a capsule from ``before`` to ``goal`` [m]."""
    b = me.b
    way = ZERO
    for k in range(me.lane, touch.half.shape[0], me.lanes):
        x0 = touch.position[b, before, k]
        q0 = touch.rotation[b, before, k]
        x1 = touch.position[b, goal, k]
        q1 = touch.rotation[b, goal, k]
        if wp.dot(q0, q1) < ZERO:
            q1 = -q1
        w.capsules_start.x[b, k] = x0 + from_part * (x1 - x0)
        w.capsules_start.q[b, k] = wp.normalize(q0 + from_part * (q1 - q0))
        w.capsules.x[b, k] = x0 + part * (x1 - x0)
        w.capsules.q[b, k] = wp.normalize(q0 + part * (q1 - q0))
        turn = real(2.0) * wp.length(q1 - q0)
        way = wp.max(way, wp.length(x1 - x0) + turn * (touch.half[k] + touch.radius[k]))
    sync()
    return lane_max(way)


@wp.func
def capsules_cross(tree: Trees, touch: Touches, w: Work, me: Thread):
    """Number of segments of the plant, which stands still, that the capsules pass through in a stride."""
    return crossing(tree, touch.half, w.nodes.order, me, 0, w.now, w.capsules_start, w.now, w.capsules)


@wp.func
def commit_stride(tree: Trees, touch: Touches, w: Work, me: Thread, side: int, count: int, load: real, found: int):
    """Ends a stride: stores what friction has stretched and how far wires have yielded in an equilibrium.

    Args:
        side: list of the contacts. count: of active nodes. load: sum of the plant's weights [N]. found: whether an
        equilibrium was found.
    """
    b = me.b
    o = me.o
    loaded = int(0)  # whether a point presses or a wire has yielded
    for c in range(me.lane, w.count[side, b], me.lanes):
        at = w.contacts[side, b, c]
        at = fibre.pressed(tree, touch, me, at, w.now, w.capsules)
        at.memory.stuck = int(Stick.FREE)
        at.memory.stretch = vec3()
        if at.gap.value < ZERO:
            loaded = 1
            at.memory.stuck = int(Stick.STUCK)
            if at.friction_limit > ZERO:
                at = fibre.rubbed(tree, w, me, at, w.now)
                at.memory.stretch = wp.quat_rotate_inv(w.capsules.q[b, at.capsule], at.friction_gradient / at.stiffness)
        w.contacts[side, b, c].memory = at.memory
    if found == 1:
        for a in range(1 + me.lane, count, me.lanes):
            i = w.nodes.order[b, a]
            wire = tree.wire[o + i]
            if wire[1] > ZERO:
                strains = fibre.segment_strain(tree, me, i, w.now)
                _phi, e = segment.plastic_bending(strains.phi, w.nodes.plastic[b, i])
                lost = ONE - segment.elastic_share(e, wire)
                w.nodes.plastic[b, i] = w.nodes.plastic[b, i] + lost * e
                w.nodes.heat[b, i] = w.nodes.heat[b, i] + wire[1] * lost * wp.length(e)
                if wp.length_sq(w.nodes.plastic[b, i]) > ZERO:
                    loaded = 1
    sync()
    if lane_count(loaded) == 0 and found == 1 and load == ZERO:
        # Nothing touches: the plant returns to rest to the last bit, unless a soft leaf, bent by less than the
        # tolerance, would return through a link.
        copy_state(w, me, 0, w.now, w.saved)
        for i in range(me.lane, me.n, me.lanes):
            w.nodes.active[b, i] = wp.where(i == 0, 1, 0)
        sync()
        carry_unloaded(tree, w, me)
        through = int(0)
        for pair in range(me.lane, w.count[side, b] / POINTS, me.lanes):
            at = w.contacts[side, b, POINTS * pair]
            patch = fibre.fibre_patch(tree, touch, me, at.node, at.fibre, at.capsule, w.now, w.capsules)
            if patch.gap < ZERO:
                through = 1
        if lane_count(through) > 0 or crossing(
            tree, touch.half, w.nodes.order, me, 0, w.saved, w.capsules, w.now, w.capsules
        ) > 0:
            copy_state(w, me, 0, w.saved, w.now)
            for a in range(1 + me.lane, count, me.lanes):
                w.nodes.active[b, w.nodes.order[b, a]] = 1
    sync()


@wp.func
def write_frame(tree: Trees, touch: Touches, w: Work, out: Results, me: Thread, t: int, side: int, count: int):
    """Writes the forces on the capsules and the nodes of frame ``t``.

    Returns:
        The frame, the sum of the contact forces [N], and the deepest penetration over the depth at which a point may
        come out on the wrong side [-].
    """
    b = me.b
    o = me.o
    frame = Frame()
    total = ZERO
    sunk = ZERO
    root = vec6()
    for c in range(me.lane, w.count[side, b], me.lanes):
        at = w.contacts[side, b, c]
        cx = w.capsules.x[b, at.capsule]
        if c % POINTS == 0:
            patch = fibre.fibre_patch(tree, touch, me, at.node, at.fibre, at.capsule, w.now, w.capsules)
            thick = touch.radius[at.capsule] + tree.radius[at.fibre]
            frame.penetration = wp.max(frame.penetration, -patch.gap)
            sunk = wp.max(sunk, -patch.gap / wp.min(DEEP, DEEP_SHARE * thick))
            if patch.gap < ZERO:
                frame.contacts = frame.contacts + 1
        at = fibre.pressed(tree, touch, me, at, w.now, w.capsules)
        at.force = vec3()
        at.moment = vec3()
        if at.gap.value < ZERO:
            if at.friction_limit > ZERO:
                at = fibre.rubbed(tree, w, me, at, w.now)
            at.force = at.normal_gradient + at.friction_gradient
            at.moment = (wp.cross(at.point - cx, at.normal_gradient) + wp.cross(at.surface - cx, at.friction_gradient))
            if tree.parent[o + at.node] == 0:
                root = root + fibre.end_force(at, at.parent)  # what the clamp bears without bending anything
            total = total + wp.length(at.force)
        w.contacts[side, b, c].force = at.force
        w.contacts[side, b, c].moment = at.moment
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        strains = fibre.segment_strain(tree, me, i, w.now)
        plastic = w.nodes.plastic[b, i]
        stored = segment.energy(strains, tree.kd[o + i], tree.kphi[o + i], tree.wire[o + i], plastic)
        frame.energy = frame.energy + stored
        frame.heat = frame.heat + w.nodes.heat[b, i]
        if tree.parent[o + i] == 0:
            mu = segment.moment(strains, tree.kphi[o + i], tree.wire[o + i], plastic)
            f, _mc, mp = segment.gradient(strains, tree.kd[o + i], mu)
            root = root + segment.spatial(-f, mp)
    sync()
    for k in range(me.lane, touch.half.shape[0], me.lanes):
        force = vec3()
        moment = vec3()
        for c in range(w.count[side, b]):
            if w.contacts[side, b, c].capsule == k:
                force = force + w.contacts[side, b, c].force
                moment = moment + w.contacts[side, b, c].moment
        out.force[b, t, k] = force
        out.moment[b, t, k] = moment
    for r in range(6):
        root[r] = lane_sum(root[r])
    frame.reaction = root
    frame.energy = lane_sum(frame.energy)
    frame.heat = lane_sum(frame.heat)
    frame.penetration = lane_max(frame.penetration)
    frame.contacts = lane_count(frame.contacts)
    if out.x.shape[1] > 0:
        for i in range(me.lane, me.n, me.lanes):
            out.x[b, t, i] = w.now.x[b, i]
            out.q[b, t, i] = w.now.q[b, i]
    sync()
    return frame, lane_sum(total), lane_max(sunk)


@wp.kernel(enable_backward=False, cuda_max_registers=REGISTERS)
def advance(
    # model
    tree: Trees,
    touch: Touches,
    live: wp.array(dtype=wp.int32),
    lanes: int,
    # state in and out
    w: Work,
    # state out
    out: Results,
):
    """Advances the touches ``live`` with ``lanes`` threads each, until each has used its share of Newton iterations."""
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
    for i in range(me.n):
        load = load + wp.length(tree.load[me.o + i])
    taken = int(0)
    p = w.progress[b]
    while taken < touch.limits.share and p.ended == 0 and p.next < touch.plan.shape[1]:
        t = p.next
        here = touch.plan[b, wp.max(t - 1, 0)]
        goal = touch.plan[b, t]
        base = ONE / wp.ceil(wp.max(place_capsules(touch, w, me, here, goal, ZERO, ONE) / STRIDE, ONE))
        part = ZERO  # of the frame that is done
        stride = base  # the next one, as a part of the frame
        used = int(0)  # Newton iterations of the frame
        broken = int(0)  # 1 if a stride ended without an equilibrium
        reason = int(Reason.NONE)
        residual = ZERO
        count = int(0)
        while part < WHOLE:
            to = wp.min(part + stride, ONE)
            if to > WHOLE:
                to = ONE
            place_capsules(touch, w, me, here, goal, part, to)
            copy_state(w, me, 0, w.now, w.start)
            reason = int(Reason.WRONG_SIDE)
            its = int(0)
            if capsules_cross(tree, touch, w, me) == 0:
                reason, its, residual, count = equilibrate(tree, touch, w, me, p.list, 1 - p.list, load)
            used = used + its
            taken = taken + its + 1
            if reason == Reason.NOT_FINITE or (
                reason != Reason.NONE and stride > real(1.5) * base * SHORTEST
                and (used < touch.limits.work or reason == Reason.WRONG_SIDE)
            ):
                copy_state(w, me, 0, w.start, w.now)
                stride = real(0.25) * stride
                if reason == Reason.NOT_FINITE and (stride < base * SHORTEST or used >= touch.limits.work):
                    # the state before this stride is kept, and the rest of the frame is skipped
                    place_capsules(touch, w, me, here, goal, part, ONE)
                    if capsules_cross(tree, touch, w, me) > 0:
                        p.wrong_side = PASSED
                    place_capsules(touch, w, me, here, goal, part, to)
                    part = ONE
            else:
                part = to
                stride = wp.min(real(2.0) * stride, base)
                if reason == Reason.WRONG_SIDE:
                    p.wrong_side = PASSED  # the capsules go on, and what they passed is lost
                else:
                    if reason != Reason.PATCH:
                        p.list = 1 - p.list
                        found = wp.where(reason == Reason.NONE, 1, 0)
                        commit_stride(tree, touch, w, me, p.list, count, load, found)
                    if reason != Reason.NONE:
                        broken = 1
        frame, pressed_by, sunk = write_frame(tree, touch, w, out, me, t, p.list, count)
        # After a failed frame a leaf may be inside a link, where it can find an equilibrium pierced by it, or come out
        # on the other side. Such frames are marked until nothing touches any more. What a capsule went through stays on
        # its wrong side, touching or not, to the end of the touch.
        if sunk > ONE:
            p.wrong_side = wp.max(p.wrong_side, 1)
        elif frame.contacts == 0 and reason == Reason.NONE and p.wrong_side < PASSED:
            p.wrong_side = 0
        if p.wrong_side > 0 and reason == Reason.NONE:
            reason = Reason.WRONG_SIDE
        elif reason == Reason.NONE and broken == 1:
            reason = Reason.PATH
        frame.reason = reason
        frame.residual = residual
        frame.iterations = used
        if me.lane == 0:
            out.frame[b, t] = frame
        if pressed_by > touch.limits.force_limit:
            p.ended = 1
        p.next = t + 1
    sync()
    if me.lane == 0:
        w.progress[b] = p
