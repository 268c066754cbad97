"""Where the arm is in each frame, and what a guarded arm does before the force limit.

The way in is given by poses, numbered along it. A frame is at a position in numbers of poses, which may be fractional:
between poses the capsules follow the cubic through four of them. A planned frame is at the position of the plan.

A guarded touch (`RodOptions.guarded`) whose next frame would exceed the force limit returns to the last equilibrium
below it and creeps on from there at a quarter of its pace, and again, down to a 64th; the pace doubles again while the
force is below half the limit. Then the arm stands still, and goes back the way it came to where it first touched the
plant, in the frames that are left: their number is fixed, and the distance between them follows from it.

The arm also turns back, from the last equilibrium, after several consecutive frames without an equilibrium. On the way
back such frames are marked and kept, and strides are not divided. After a frame that left a link inside the plant, or
took too many iterations, the next one starts from the last equilibrium as well, five times in a row at most. On the way
back the arm cannot turn: if it catches a branch there, it makes a protective stop, and the touch ends before the frame
that exceeds its force.
"""

import warp as wp

from vsfsim.physics.rods.kernels.contact_search import copy_state
from vsfsim.physics.rods.kernels.lanes import lane_max, sync
from vsfsim.physics.rods.kernels.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.structs import Phase, Thread, Touches, Work
from vsfsim.physics.solve.frames import Reason

SLOWER = wp.constant(wp.float64(0.25))  # factor on the pace when the limit was exceeded
SLOWEST = wp.constant(wp.float64(1.0 / 64.0))  # least pace [poses]: 0.04 mm a frame where poses are 2.3 mm apart
HOPELESS = wp.constant(5)  # consecutive frames without an equilibrium after which the arm turns back
# Force of the protective stop over the force limit. Friction that reverses on the way back takes a regular touch up to
# 1.1 times the limit.
PROTECTIVE = wp.constant(wp.float64(1.25))


@wp.func(inline=False)
def pose_at(position: wp.array3d(dtype=vec3), rotation: wp.array3d(dtype=quat), b: int, k: int, s: real):
    """Position and rotation of capsule ``k`` at position ``s`` of the way: at a pose exactly that pose, between two the
    cubic through the four around them (Lagrange), or the polynomial through all if there are fewer. The arguments are
    those of `Touches`."""
    i = int(wp.floor(s))
    x = position[b, i, k]
    q = rotation[b, i, k]
    if s > real(i):
        count = wp.min(4, position.shape[1])
        first = wp.clamp(i - 1, 0, position.shape[1] - count)
        u = s - real(first)
        near = q
        x = vec3()
        q = quat(ZERO, ZERO, ZERO, ZERO)
        for j in range(count):
            weight = ONE
            for m in range(count):
                if m != j:
                    weight = weight * (u - real(m)) / (real(j) - real(m))
            other = rotation[b, first + j, k]
            if wp.dot(near, other) < ZERO:
                other = -other
            x = x + weight * position[b, first + j, k]
            q = q + weight * other
        q = wp.normalize(q)
    return x, q


@wp.func
def place_capsules(touch: Touches, w: Work, me: Thread, before: real, goal: real, from_part: real, part: real):
    """Places the capsules at the start and the end of a stride, which are the parts ``from_part`` and ``part`` of the
    way from position ``before`` to ``goal``. Returns the longest way of a capsule from ``before`` to ``goal`` [m]."""
    b = me.b
    way = ZERO
    for k in range(me.lane, touch.half.shape[0], me.lanes):
        x0, q0 = pose_at(touch.position, touch.rotation, b, k, before)
        x1, q1 = pose_at(touch.position, touch.rotation, b, k, goal)
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
def frame_target(touch: Touches, w: Work, me: Thread, t: int):
    """Position of frame ``t``. A creeping arm turns back here when the way, or the number of frames for it, is used
    up."""
    b = me.b
    frames = touch.plan.shape[1]
    hold = touch.limits.hold
    g = w.guard[b]
    end = real(touch.position.shape[1] - 1)
    if g.phase == Phase.CREEPING and (t >= frames - hold - touch.limits.out or g.position >= end):
        g.phase = int(Phase.BACK)
        g.turning_frame = t
        g.turning_position = g.position
        sync()
        if me.lane == 0:
            w.guard[b] = g
        sync()
    goal = touch.plan[b, t]
    if g.phase == Phase.CREEPING:
        goal = wp.min(g.position + g.pace, end)
    if g.phase == Phase.BACK:
        goal = g.turning_position
        gone = t - g.turning_frame - hold
        if gone >= 0:
            left = frames - g.turning_frame - hold
            goal = wp.max(goal - (goal - g.clear_position) * real(gone + 1) / real(left), ZERO)
    return goal


@wp.func
def save_equilibrium(w: Work, me: Thread, side: int):
    """Stores the present equilibrium."""
    b = me.b
    copy_state(w, me, 0, w.now, w.kept.nodes)
    for i in range(me.lane, me.n, me.lanes):
        w.kept.strained[b, i] = w.nodes.strained[b, i]
        w.kept.plastic[b, i] = w.nodes.plastic[b, i]
        w.kept.heat[b, i] = w.nodes.heat[b, i]
    for c in range(me.lane, w.count[side, b], me.lanes):
        w.kept.memory[b, c] = w.contacts[side, b, c].memory
    if me.lane == 0:
        w.kept.count[b] = w.count[side, b]
    sync()


@wp.func
def restore_equilibrium(w: Work, me: Thread, side: int):
    """Returns to the stored equilibrium: nodes, strained and yielded segments, and contacts."""
    b = me.b
    copy_state(w, me, 0, w.kept.nodes, w.now)
    for i in range(me.lane, me.n, me.lanes):
        w.nodes.strained[b, i] = w.kept.strained[b, i]
        w.nodes.plastic[b, i] = w.kept.plastic[b, i]
        w.nodes.heat[b, i] = w.kept.heat[b, i]
        w.nodes.active[b, i] = wp.where(i == 0, 1, w.kept.strained[b, i])
    for c in range(me.lane, w.kept.count[b], me.lanes):
        w.contacts[side, b, c].memory = w.kept.memory[b, c]
    if me.lane == 0:
        w.count[side, b] = w.kept.count[b]
    sync()


@wp.func
def guard_frame(touch: Touches, w: Work, me: Thread, t: int, goal: real, side: int, pressed: real, touching: int,
                reason: int, wrong_side: int):
    """What the guard does after frame ``t`` at the position ``goal``.

    The first frame counts as an equilibrium: the arm starts clear of the plant. A frame without an equilibrium has no
    force to stop at, so it is only marked; the arm stops where several in a row exceed the force of the stop.

    Args:
        side: list of the contacts. pressed: sum of the contact forces [N]. touching: number of patches that touch.
        reason: `frames.Reason`. wrong_side: whether a link may be inside the plant.

    Returns:
        Whether the frame is kept (else it is done again elsewhere), whether the state returned to the stored
        equilibrium, and whether the arm stops for good.
    """
    b = me.b
    kept = int(1)
    restored = int(0)
    stopped = int(0)
    lost = wrong_side
    limit = touch.limits.force_limit
    g = w.guard[b]
    g.position = goal
    if touch.limits.guarded == 1:
        g.failures = wp.where(reason == Reason.NONE, 0, g.failures + 1)
        inward = int(0)
        if g.phase == Phase.CREEPING or (g.phase == Phase.AS_PLANNED and t < touch.inward[b]):
            inward = 1
        if inward == 1 and pressed > limit and t > 0:
            g.pace = SLOWER * g.pace
            g.phase = int(Phase.CREEPING)
            kept = 0
            if g.pace < SLOWEST:
                g.phase = int(Phase.BACK)
                g.turning_frame = t
                g.turning_position = g.good_position
        elif (inward == 0 and t > 0 and pressed > PROTECTIVE * limit
              and (reason == Reason.NONE or g.failures >= HOPELESS)):
            stopped = 1
        elif reason == Reason.NONE or t == 0:
            g.good_position = goal
            if g.phase == Phase.CREEPING and pressed < HALF * limit:
                g.pace = wp.min(real(2.0) * g.pace, ONE)
            if touching > 0:
                g.touched = 1
            elif g.touched == 0:
                g.clear_position = goal
            save_equilibrium(w, me, side)
        elif inward == 1 and g.failures >= HOPELESS:
            g.phase = int(Phase.BACK)
            g.turning_frame = t + 1
            g.turning_position = g.good_position
            g.failures = 0
            lost = 1
        elif g.failures > HOPELESS:
            lost = 0  # far from the last equilibrium by now: it continues from here
        if stopped == 0 and (kept == 0 or lost == 1):
            restored = 1
            g.position = g.good_position
            restore_equilibrium(w, me, side)
    sync()
    if me.lane == 0:
        w.guard[b] = g
    sync()
    return kept, restored, stopped
