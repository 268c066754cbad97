"""Where the arm is in each frame, and what it does before the force limit.

Poses stand along the way in; a frame is at a number of them, `at`, which may be a fraction: between poses the tool goes
along the cubic through four of them. A planned frame is at the plan's number. A guarded touch (`Touches.guarded`) whose
next frame would pass the force limit goes back to the last equilibrium under it and creeps on from there, a quarter as
far a frame, and again, down to a 64th; it speeds up again while the force is under half the limit. Then it stands still
and goes back the way it came to where it first met the plant, in as many frames as are left: how far frames are apart
follows from their number, which stays.
The same is done where several frames on end found no equilibrium: from there on nothing can be told, and the arm goes
back from the last one. On the way back such frames go on, marked, each stride tried once. After a frame that left a
link inside the plant, or took too long, the next one begins at the last equilibrium, too, five times on end at most.
On the way back there is nowhere to turn to: an arm that hooks a branch there comes to its protective stop, and the
touch ends before the frame past it.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.lanes import meet, most
from vsfsim.physics.rods.kernels.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.state import Here, Touches, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

AS_PLANNED, CREEPING, BACK = (wp.constant(k) for k in range(3))  # phases
SLOWER = wp.constant(wp.float64(0.25))  # pace after the limit was passed
SLOWEST = wp.constant(wp.float64(1.0 / 64.0))  # pace: 0.04 mm a frame where poses are 2.3 mm apart
HOPELESS = wp.constant(5)  # frames on end without an equilibrium, after which the arm turns back
# of the force limit: the arm's protective stop on the way back; friction that turns round there takes an honest touch
# up to 1.1 of it
PROTECTIVE = wp.constant(wp.float64(1.25))


@wp.func
def pose_at(touch: Touches, b: int, k: int, s: real):
    """Place and turn of capsule ``k`` at number ``s`` of the way: at a pose its own bits, between two the cubic through
    the four around them (Lagrange)."""
    i = int(wp.floor(s))
    x = touch.place[b, i, k]
    q = touch.turn[b, i, k]
    last = touch.last[b]
    if s > real(i):
        if last < 3:
            f = s - real(i)
            other = touch.turn[b, i + 1, k]
            if wp.dot(q, other) < ZERO:
                other = -other
            x = x + f * (touch.place[b, i + 1, k] - x)
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
                other = touch.turn[b, first + j, k]
                if wp.dot(near, other) < ZERO:
                    other = -other
                x = x + weight * touch.place[b, first + j, k]
                q = q + weight * other
        q = wp.normalize(q)
    return x, q


@wp.func
def capsules_at(touch: Touches, w: Work, at: Here, before: real, goal: real, from_part: real, part: real):
    """Poses of the capsules a part of the way from ``before`` to ``goal``, and of the step's start. Their longest way
    of all, from the one to the other [m]."""
    b = at.b
    way = ZERO
    for k in range(at.lane, touch.half.shape[0], at.lanes):
        x0, q0 = pose_at(touch, b, k, before)
        x1, q1 = pose_at(touch, b, k, goal)
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
def copy_all(at: Here, x_in: wp.array2d(dtype=vec3), q_in: wp.array2d(dtype=quat), x_out: wp.array2d(dtype=vec3),
             q_out: wp.array2d(dtype=quat)):
    """All nodes of one state to another."""
    for i in range(at.lane, at.n, at.lanes):
        x_out[at.b, i] = x_in[at.b, i]
        q_out[at.b, i] = q_in[at.b, i]
    meet()


@wp.func
def where_to(touch: Touches, w: Work, at: Here, t: int):
    """Number on the way at which frame ``t`` is; one that creeps turns back here when the way, or the frames for it,
    are over."""
    b = at.b
    frames = touch.frames[b]
    phase = w.phase[b]
    here = w.at[b]
    end = real(touch.last[b])
    if phase == CREEPING and (t >= frames - touch.hold - touch.out or here >= end):
        phase = BACK
        meet()
        if at.lane == 0:
            w.phase[b] = BACK
            w.turned[b] = t
            w.top[b] = here
        meet()
    goal = touch.plan[b, t]
    if phase == CREEPING:
        goal = wp.min(here + w.pace[b], end)
    if phase == BACK:
        goal = w.top[b]
        gone = t - w.turned[b] - touch.hold
        if gone >= 0:
            goal = wp.max(goal - (goal - w.low[b]) * real(gone + 1) / real(frames - w.turned[b] - touch.hold), ZERO)
    return goal


@wp.func
def keep(w: Work, at: Here, side: int):
    """Keeps the state, to come back to."""
    b = at.b
    copy_all(at, w.x, w.q, w.x_good, w.q_good)
    for i in range(at.lane, at.n, at.lanes):
        w.strained_good[b, i] = w.strained[b, i]
    for c in range(at.lane, w.count[side, b], at.lanes):
        w.key_good[b, c] = w.key[side, b, c]
        w.stuck_good[b, c] = w.stuck[side, b, c]
        w.anchor_good[b, c] = w.anchor[side, b, c]
    if at.lane == 0:
        w.count_good[b] = w.count[side, b]
    meet()


@wp.func
def restore(w: Work, at: Here, side: int):
    """Goes back to the state that was kept: nodes, what is strained, and where contacts stick."""
    b = at.b
    copy_all(at, w.x_good, w.q_good, w.x, w.q)
    for i in range(at.lane, at.n, at.lanes):
        w.strained[b, i] = w.strained_good[b, i]
        w.active[b, i] = wp.where(i == 0, 1, w.strained_good[b, i])
    for c in range(at.lane, w.count_good[b], at.lanes):
        w.key[side, b, c] = w.key_good[b, c]
        w.stuck[side, b, c] = w.stuck_good[b, c]
        w.anchor[side, b, c] = w.anchor_good[b, c]
    if at.lane == 0:
        w.count[side, b] = w.count_good[b]
    meet()


@wp.func
def watch(touch: Touches, w: Work, at: Here, t: int, goal: real, side: int, pressed: real, touching: int, reason: int,
          astray: int):
    """After frame ``t`` at ``goal``: what the guard does. 1 if the frame is kept, 0 if it is done again elsewhere; 1 if
    the state went back to one that was good, as it does where a link got into the plant (``astray``); 1 if the arm
    stops for good.

    The first frame is taken as good: the arm starts clear of the plant. A frame that found no equilibrium has no force
    that a stop could be told from; it is marked, and only where several on end are past the stop's force the arm does
    stop.
    """
    b = at.b
    phase = w.phase[b]
    kept = int(1)
    restored = int(0)
    stopped = int(0)
    lost = astray
    here = goal
    good = w.good[b]
    pace = w.pace[b]
    top = w.top[b]
    low = w.low[b]
    turned = w.turned[b]
    met = w.met[b]
    fails = w.fails[b]
    if touch.guarded == 1:
        fails = wp.where(reason == 0, 0, fails + 1)
        inward = int(0)
        if phase == CREEPING or (phase == AS_PLANNED and t < touch.inward[b]):
            inward = 1
        if inward == 1 and pressed > touch.force_limit and t > 0:
            pace = SLOWER * pace
            phase = CREEPING
            kept = 0
            if pace < SLOWEST:
                phase = BACK
                turned = t
                top = good
        elif inward == 0 and t > 0 and pressed > PROTECTIVE * touch.force_limit and (reason == 0 or fails >= HOPELESS):
            stopped = 1
        elif reason == 0 or t == 0:
            good = goal
            if phase == CREEPING and pressed < HALF * touch.force_limit:
                pace = wp.min(real(2.0) * pace, ONE)
            if touching > 0:
                met = 1
            elif met == 0:
                low = goal
            keep(w, at, side)
        elif inward == 1 and fails >= HOPELESS:
            phase = BACK
            turned = t + 1
            top = good
            fails = 0
            lost = 1
        elif fails > HOPELESS:
            lost = 0  # ever further from the last equilibrium: it goes on from where it is
        if stopped == 0 and (kept == 0 or lost == 1):
            restored = 1
            here = good
            restore(w, at, side)
    meet()
    if at.lane == 0:
        w.at[b] = here
        w.good[b] = good
        w.pace[b] = pace
        w.top[b] = top
        w.low[b] = low
        w.phase[b] = phase
        w.turned[b] = turned
        w.met[b] = met
        w.fails[b] = fails
    meet()
    return kept, restored, stopped
