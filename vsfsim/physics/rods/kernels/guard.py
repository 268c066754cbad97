"""Where the arm is in each frame, and what a guarded arm does before the force limit.

The way in is given by poses, numbered along it. A frame is at a position in numbers of poses, which may be fractional:
between poses the capsules follow the cubic through four of them. A planned frame is at the position of the plan.

A guarded touch (`Touches.guarded`) whose next frame would exceed the force limit returns to the last equilibrium below
it and creeps on from there at a quarter of its pace, and again, down to a 64th; the pace doubles again while the force
is below half the limit. Then the arm stands still, and goes back the way it came to where it first touched the plant,
in the frames that are left: their number is fixed, and the distance between them follows from it.

The arm also turns back, from the last equilibrium, after several consecutive frames without an equilibrium. On the way
back such frames are marked and kept, and strides are not divided. After a frame that left a link inside the plant, or
took too many iterations, the next one starts from the last equilibrium as well, five times in a row at most. On the way
back the arm cannot turn: if it catches a branch there, it makes a protective stop, and the touch ends before the frame
that exceeds its force.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.lanes import lane_max, sync
from vsfsim.physics.rods.kernels.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.structs import Phase, Thread, Touches, Work
from vsfsim.physics.solve.frames import Reason

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

SLOWER = wp.constant(wp.float64(0.25))  # factor on the pace when the limit was exceeded
SLOWEST = wp.constant(wp.float64(1.0 / 64.0))  # least pace [poses]: 0.04 mm a frame where poses are 2.3 mm apart
HOPELESS = wp.constant(5)  # consecutive frames without an equilibrium after which the arm turns back
# Force of the protective stop over the force limit. Friction that reverses on the way back takes a regular touch up to
# 1.1 times the limit.
PROTECTIVE = wp.constant(wp.float64(1.25))


@wp.func(inline=False)
def pose_at(position: wp.array3d(dtype=vec3), rotation: wp.array3d(dtype=quat), last: int, b: int, k: int, s: real):
    """Position and rotation of capsule ``k`` at position ``s`` of the way: at a pose exactly that pose, between two the
    cubic through the four around them (Lagrange). The arguments are those of `Touches`."""
    i = int(wp.floor(s))
    x = position[b, i, k]
    q = rotation[b, i, k]
    if s > real(i):
        if last < 3:
            f = s - real(i)
            other = rotation[b, i + 1, k]
            if wp.dot(q, other) < ZERO:
                other = -other
            x = x + f * (position[b, i + 1, k] - x)
            q = q + f * (other - q)
        else:
            first = wp.clamp(i - 1, 0, last - 3)
            u = s - real(first)
            near = q
            x = vec3()
            q = quat(ZERO, ZERO, ZERO, ZERO)
            for j in range(4):
                weight = ONE
                for m in range(4):
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
        x0, q0 = pose_at(touch.position, touch.rotation, touch.last_pose[b], b, k, before)
        x1, q1 = pose_at(touch.position, touch.rotation, touch.last_pose[b], b, k, goal)
        if wp.dot(q0, q1) < ZERO:
            q1 = -q1
        w.capsules.x_start[b, k] = x0 + from_part * (x1 - x0)
        w.capsules.q_start[b, k] = wp.normalize(q0 + from_part * (q1 - q0))
        w.capsules.x[b, k] = x0 + part * (x1 - x0)
        w.capsules.q[b, k] = wp.normalize(q0 + part * (q1 - q0))
        turn = real(2.0) * wp.length(q1 - q0)
        way = wp.max(way, wp.length(x1 - x0) + turn * (touch.half[k] + touch.radius[k]))
    sync()
    return lane_max(way)


@wp.func
def copy_nodes(me: Thread, x_in: wp.array2d(dtype=vec3), q_in: wp.array2d(dtype=quat), x_out: wp.array2d(dtype=vec3),
             q_out: wp.array2d(dtype=quat)):
    """Copies the state of all nodes."""
    for i in range(me.lane, me.n, me.lanes):
        x_out[me.b, i] = x_in[me.b, i]
        q_out[me.b, i] = q_in[me.b, i]
    sync()


@wp.func
def frame_target(touch: Touches, w: Work, me: Thread, t: int):
    """Position of frame ``t``. A creeping arm turns back here when the way, or the number of frames for it, is used
    up."""
    b = me.b
    frames = touch.frames[b]
    phase = w.guard.phase[b]
    here = w.guard.position[b]
    end = real(touch.last_pose[b])
    if phase == Phase.CREEPING and (t >= frames - touch.hold - touch.out or here >= end):
        phase = Phase.BACK
        sync()
        if me.lane == 0:
            w.guard.phase[b] = Phase.BACK
            w.guard.turning_frame[b] = t
            w.guard.turning_position[b] = here
        sync()
    goal = touch.plan[b, t]
    if phase == Phase.CREEPING:
        goal = wp.min(here + w.guard.pace[b], end)
    if phase == Phase.BACK:
        goal = w.guard.turning_position[b]
        gone = t - w.guard.turning_frame[b] - touch.hold
        if gone >= 0:
            left = frames - w.guard.turning_frame[b] - touch.hold
            goal = wp.max(goal - (goal - w.guard.clear_position[b]) * real(gone + 1) / real(left), ZERO)
    return goal


@wp.func
def save_equilibrium(w: Work, me: Thread, side: int):
    """Stores the present equilibrium."""
    b = me.b
    copy_nodes(me, w.nodes.x, w.nodes.q, w.guard.x, w.guard.q)
    for i in range(me.lane, me.n, me.lanes):
        w.guard.strained[b, i] = w.nodes.strained[b, i]
        w.guard.plastic[b, i] = w.nodes.plastic[b, i]
        w.guard.heat[b, i] = w.nodes.heat[b, i]
    for c in range(me.lane, w.contacts.count[side, b], me.lanes):
        w.guard.key[b, c] = w.contacts.key[side, b, c]
        w.guard.stuck[b, c] = w.contacts.stuck[side, b, c]
        w.guard.stretch[b, c] = w.contacts.stretch[side, b, c]
    if me.lane == 0:
        w.guard.count[b] = w.contacts.count[side, b]
    sync()


@wp.func
def restore_equilibrium(w: Work, me: Thread, side: int):
    """Returns to the stored equilibrium: nodes, strained and yielded segments, and contacts."""
    b = me.b
    copy_nodes(me, w.guard.x, w.guard.q, w.nodes.x, w.nodes.q)
    for i in range(me.lane, me.n, me.lanes):
        w.nodes.strained[b, i] = w.guard.strained[b, i]
        w.nodes.plastic[b, i] = w.guard.plastic[b, i]
        w.nodes.heat[b, i] = w.guard.heat[b, i]
        w.nodes.active[b, i] = wp.where(i == 0, 1, w.guard.strained[b, i])
    for c in range(me.lane, w.guard.count[b], me.lanes):
        w.contacts.key[side, b, c] = w.guard.key[b, c]
        w.contacts.stuck[side, b, c] = w.guard.stuck[b, c]
        w.contacts.stretch[side, b, c] = w.guard.stretch[b, c]
    if me.lane == 0:
        w.contacts.count[side, b] = w.guard.count[b]
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
    phase = w.guard.phase[b]
    kept = int(1)
    restored = int(0)
    stopped = int(0)
    lost = wrong_side
    here = goal
    good = w.guard.good_position[b]
    pace = w.guard.pace[b]
    top = w.guard.turning_position[b]
    low = w.guard.clear_position[b]
    turned = w.guard.turning_frame[b]
    met = w.guard.touched[b]
    fails = w.guard.failures[b]
    if touch.guarded == 1:
        fails = wp.where(reason == Reason.NONE, 0, fails + 1)
        inward = int(0)
        if phase == Phase.CREEPING or (phase == Phase.AS_PLANNED and t < touch.inward[b]):
            inward = 1
        if inward == 1 and pressed > touch.force_limit and t > 0:
            pace = SLOWER * pace
            phase = Phase.CREEPING
            kept = 0
            if pace < SLOWEST:
                phase = Phase.BACK
                turned = t
                top = good
        elif (inward == 0 and t > 0 and pressed > PROTECTIVE * touch.force_limit
              and (reason == Reason.NONE or fails >= HOPELESS)):
            stopped = 1
        elif reason == Reason.NONE or t == 0:
            good = goal
            if phase == Phase.CREEPING and pressed < HALF * touch.force_limit:
                pace = wp.min(real(2.0) * pace, ONE)
            if touching > 0:
                met = 1
            elif met == 0:
                low = goal
            save_equilibrium(w, me, side)
        elif inward == 1 and fails >= HOPELESS:
            phase = Phase.BACK
            turned = t + 1
            top = good
            fails = 0
            lost = 1
        elif fails > HOPELESS:
            lost = 0  # far from the last equilibrium by now: it continues from here
        if stopped == 0 and (kept == 0 or lost == 1):
            restored = 1
            here = good
            restore_equilibrium(w, me, side)
    sync()
    if me.lane == 0:
        w.guard.position[b] = here
        w.guard.good_position[b] = good
        w.guard.pace[b] = pace
        w.guard.turning_position[b] = top
        w.guard.clear_position[b] = low
        w.guard.phase[b] = phase
        w.guard.turning_frame[b] = turned
        w.guard.touched[b] = met
        w.guard.failures[b] = fails
    sync()
    return kept, restored, stopped
