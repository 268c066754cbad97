"""Equilibrium of the active part of a tree: Newton's method with a line search on the potential."""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.assembly import assemble, contact_energy, foresee, harden, model, renew, unbalanced
from vsfsim.physics.rods.kernels.elimination import solve
from vsfsim.physics.rods.kernels.lanes import meet, most, total
from vsfsim.physics.rods.kernels.search import activate, gather, ride
from vsfsim.physics.rods.kernels.segment import HALF, ONE, TINY, ZERO, energy, quat, real, six, strain, vec3
from vsfsim.physics.rods.state import Here, Touches, Trees, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

MARGIN = wp.constant(wp.float64(0.006))  # how near a sample must be to be listed [m]
# longest way in one iteration, of the room that a node has: its distance from the capsules, `MARGIN` at least, which is
# under half of the thinnest
MOVE = wp.constant(wp.float64(0.85))
TURN = wp.constant(wp.float64(0.5))  # and its largest turn [rad]
BEND = wp.constant(wp.float64(0.3))  # the most that one segment bends in an iteration [rad]
HALVINGS = wp.constant(12)
# least share by which a step that no potential vouches for must shrink the unbalanced force, at its full length
SHRINK = wp.constant(wp.float64(0.25))
TRIES = wp.constant(3)  # lengths that such a step is tried at
CAREFUL = wp.constant(2)  # steps down the potential after one that was taken back
OK, ITERATIONS, STALLED, NOT_FINITE, PATCH = (wp.constant(k) for k in (0, 1, 3, 4, 5))  # frames.Reason
SETS = wp.constant(6)  # how often the contacts of a step are chosen anew


@wp.func
def turned(q: quat, spin: vec3):
    """exp(spin) q."""
    angle = wp.length(spin)
    half = HALF * angle
    scale = HALF
    if angle > TINY:
        scale = wp.sin(half) / angle
    return wp.normalize(wp.mul(quat(scale * spin[0], scale * spin[1], scale * spin[2], wp.cos(half)), q))


@wp.func
def rates(tree: Trees, w: Work, at: Here, count: int):
    """D' and the relative spin of each segment along the step, see `segment`. The largest spin over a segment [rad]."""
    b = at.b
    largest = ZERO
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        s = w.step[b, i]
        up = w.step[b, tree.parent[at.o + i]]
        mid = w.mid[b, i]
        on_p = wp.quat_rotate_inv(mid, wp.spatial_bottom(up))
        on_c = wp.quat_rotate_inv(mid, wp.spatial_bottom(s))
        spin = HALF * (on_p + on_c) - HALF * wp.cross(w.half_turn[b, i], on_c - on_p)
        w.rate[b, i] = wp.quat_rotate_inv(mid, wp.spatial_top(s) - wp.spatial_top(up)) - wp.cross(spin, w.stretch[b, i])
        relative = wp.spatial_bottom(s) - wp.spatial_bottom(up)
        w.relative[b, i] = relative
        largest = wp.max(largest, wp.length(relative))
    meet()
    return most(largest)


@wp.func
def soften(tree: Trees, w: Work, at: Here, tall: int, bend: real):
    """A segment that would bend further than ``bend`` [rad] bends that far, and what is above it goes with it: soft
    leaves shall not hold up the branch that they hang on. The step is changed."""
    b = at.b
    for d in range(1, tall):
        for a in range(w.level[b, d] + at.lane, w.level[b, d + 1], at.lanes):
            i = w.order[b, a]
            up = w.step[b, tree.parent[at.o + i]]
            mid = w.mid[b, i]
            on_p = wp.quat_rotate_inv(mid, wp.spatial_bottom(up))
            e = wp.quat_rotate_inv(mid, w.relative[b, i])
            rate = w.rate[b, i]
            size = wp.length(e)
            if size > bend:
                e = (bend / size) * e
                rate = (bend / size) * rate
            spin = on_p + HALF * e - HALF * wp.cross(w.half_turn[b, i], e)
            w.rate[b, i] = rate
            w.step[b, i] = six(wp.spatial_top(up) + wp.quat_rotate(mid, rate + wp.cross(spin, w.stretch[b, i])),
                               wp.quat_rotate(mid, on_p + e))
        meet()


@wp.func
def extent(w: Work, at: Here, count: int):
    """Slope of the potential along the step [J], the longest way of a node or its riders over the room that they have
    [-], the largest turn [rad]."""
    b = at.b
    slope = ZERO
    way = ZERO
    turn = ZERO
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        s = w.step[b, i]
        slope = slope + wp.dot(w.g[b, i], s)
        angle = wp.length(wp.spatial_bottom(s))
        turn = wp.max(turn, angle)
        way = wp.max(way, (wp.length(wp.spatial_top(s)) + angle * w.rider[b, i]) / wp.max(MARGIN, w.room[b, i]))
    return total(slope), most(way), most(turn)


@wp.func
def attempt(tree: Trees, w: Work, at: Here, count: int, tall: int, alpha: real, weighs: int):
    """The trial state at ``alpha`` of the step, and this lane's share of its elastic energy less the work of the loads
    [J].

    Nodes turn by their spins, each segment's D goes a part of its D', and positions follow from the root: a slender
    segment is then not stretched by turning, as it would be if positions went straight. The path has the step as its
    tangent, which is all that a line search needs.
    """
    b = at.b
    o = at.o
    out = ZERO
    if at.lane == 0:
        w.x_try[b, 0] = w.x[b, 0]
        w.q_try[b, 0] = w.q[b, 0]
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        w.q_try[b, i] = turned(w.q[b, i], alpha * wp.spatial_bottom(w.step[b, i]))
    meet()
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        there = w.stretch[b, i] + alpha * w.rate[b, i]
        s = strain(vec3(), w.q_try[b, tree.parent[o + i]], vec3(), w.q_try[b, i], tree.frame[o + i], ZERO)
        w.x_try[b, i] = wp.quat_rotate(s.turn, there)
        s.d = there - vec3(tree.length[o + i], ZERO, ZERO)
        out = out + energy(s, tree.kd[o + i], tree.kphi[o + i])
    meet()
    for d in range(1, tall):
        for a in range(w.level[b, d] + at.lane, w.level[b, d + 1], at.lanes):
            i = w.order[b, a]
            w.x_try[b, i] = w.x_try[b, i] + w.x_try[b, tree.parent[o + i]]
        meet()
    if weighs == 1:
        for a in range(1 + at.lane, count, at.lanes):
            i = w.order[b, a]
            out = out - wp.dot(tree.load[o + i], w.x_try[b, i] - tree.rest[o + i])
    return out


@wp.func
def copy_state(w: Work, at: Here, count: int, x_in: wp.array2d(dtype=vec3), q_in: wp.array2d(dtype=quat),
               x_out: wp.array2d(dtype=vec3), q_out: wp.array2d(dtype=quat)):
    """Active nodes of one state to another: the trial that is taken, the state to come back to, and the way back."""
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[at.b, a]
        x_out[at.b, i] = x_in[at.b, i]
        q_out[at.b, i] = q_in[at.b, i]
    meet()


@wp.func
def step(tree: Trees, touch: Touches, w: Work, at: Here, count: int, tall: int, side: int, geometric: real,
         coulomb: int, sets: int):
    """Newton's step with the contacts that it needs itself: their set is chosen anew until it stays, ``sets`` times at
    most. 1, or 0 where there is none."""
    fine = int(0)
    harden(tree, touch, w, at, count, side, geometric, coulomb)
    for _pick in range(sets):
        model(tree, w, at, count, side, geometric, coulomb)
        fine = solve(tree, w, at, tall, coulomb)
        if fine == 0 or sets == 1:
            break
        if foresee(tree, w, at, tall, count, side) == 0:
            break
    return fine


@wp.func
def balance(tree: Trees, touch: Touches, w: Work, at: Here, old: int, new: int, weighs: int, load: real):
    """From the present state to the equilibrium with the capsules where they are. Reason (0: found), iterations,
    residual, active nodes.

    Each large function is called in one place only, and a step that failed comes round again by another turn of the
    loop: CUDA's compiler takes in what is called, once for each place.
    """
    b = at.b
    count = int(0)
    tall = int(0)
    moved = real(2.0)  # so that the lists are made at once
    listed = int(0)
    reason = int(ITERATIONS)
    used = int(0)
    residual = ZERO
    small = int(0)
    plain = int(0)  # steps down the potential that are still owed
    tried = int(0)
    before = ZERO
    again = int(0)
    part = ONE
    way = ZERO
    spent = int(0)
    same = int(0)  # 1: the state is the one before, and the step is sought in another way
    geometric = ONE
    pressing = int(0)  # 1: with the contacts that press now
    rest = ZERO
    slope = ZERO
    turn = ZERO
    turns = int(0)
    for _it in range(3 * touch.travel):
        if spent >= touch.newton or turns >= touch.travel:
            break
        if same == 0:
            turns = turns + 1
        if moved > ONE and tried == 0:
            ride(tree, w, at)
            listed = gather(tree, touch, w, at, MARGIN, old, new)
            if listed < 0:
                reason = PATCH
                break
            count, tall = activate(tree, w, at, weighs)
            moved = ZERO
            if count == 1:
                reason = OK
                break
        force = renew(tree, touch, w, at, new) + load
        slips = assemble(tree, touch, w, at, count, new, geometric)
        leap = int(0)  # 1: the step is taken at `part` of its length, no potential decides
        if again == 1:
            # back where the step was made: it is tried once more, shorter
            again = 0
            leap = 1
        else:
            rest = unbalanced(tree, w, at, count)
            if tried > 0 and not rest < (ONE - SHRINK * part) * before:
                # no potential vouches for the step with friction that follows the normal force, so the unbalanced force
                # must shrink; else back, and at last down the potential
                copy_state(w, at, count, w.x_keep, w.q_keep, w.x, w.q)
                if tried < TRIES:
                    tried = tried + 1
                    part = real(0.35) * part
                    again = 1
                else:
                    tried = 0
                    plain = CAREFUL
                continue
            if tried > 0:
                moved = moved + part * way
            tried = 0
            residual = rest / wp.max(wp.max(force, touch.faint), tree.floor[touch.plant[b]] / touch.tolerance)
            if not wp.isfinite(rest):
                reason = NOT_FINITE
                break
            if residual <= touch.tolerance:
                reason = OK
                break
            if same == 0:
                used = used + 1
            same = 0
            coulomb = int(0)
            sets = int(SETS)
            bend = BEND
            if pressing == 1:
                sets = 1
                bend = real(10.0)
            elif slips > 0 and plain == 0:
                coulomb = 1
                bend = real(10.0)
            elif small > 0:
                sets = 1
            fine = step(tree, touch, w, at, count, tall, new, geometric, coulomb, sets)
            if fine == 1:
                if rates(tree, w, at, count) > bend:
                    soften(tree, w, at, tall, bend)
                slope, way, turn = extent(w, at, count)
            if coulomb == 1:
                if fine == 1 and wp.isfinite(slope) and way < MOVE and turn < TURN:
                    spent = spent + 1
                    before = rest
                    tried = 1
                    part = ONE
                    leap = 1
                    copy_state(w, at, count, w.x, w.q, w.x_keep, w.q_keep)
                else:
                    plain = 1
                    same = 1
                    continue
            else:
                if fine == 0:
                    if geometric > ZERO:
                        # without the terms of the stresses the tangent cannot lose its definiteness
                        geometric = ZERO
                        same = 1
                        plain = wp.max(plain, 1)
                        continue
                    reason = NOT_FINITE
                    break
                if not (slope < ZERO) and pressing == 0:
                    # the choice of contacts went round in circles; with those that press now the step leads down
                    pressing = 1
                    same = 1
                    plain = wp.max(plain, 1)
                    continue
                if not wp.isfinite(slope):
                    reason = NOT_FINITE
                    break
                geometric = ONE
                pressing = 0
                plain = wp.max(plain - 1, 0)
                spent = spent + 1
        alpha = wp.min(ONE, wp.min(MOVE / wp.max(way, TINY), TURN / wp.max(turn, TINY)))
        start = ZERO
        found = int(0)
        for trial in range(HALVINGS + 1):
            reach = alpha
            if leap == 1:
                reach = part
            elif trial == 0:
                reach = ZERO
            there = attempt(tree, w, at, count, tall, reach, weighs)
            if leap == 1:
                break
            there = total(there + contact_energy(tree, touch, w, at, new, w.x_try, w.q_try))
            if trial == 0:
                start = there
            else:
                # rounding of the sum decides below its last digits
                if there <= start + real(1e-4) * alpha * slope + real(1e-14) * wp.abs(start):
                    found = 1
                    break
                alpha = HALF * alpha
        if leap == 1:
            copy_state(w, at, count, w.x_try, w.q_try, w.x, w.q)
            continue
        if found == 0:
            small = small + 1
            if small > 2:
                reason = STALLED
                break
            continue
        small = 0
        if alpha * way > HALF * MOVE:
            spent = spent - 1  # on its way: a branch that springs back goes as far as it must
        copy_state(w, at, count, w.x_try, w.q_try, w.x, w.q)
        moved = moved + alpha * way
    ride(tree, w, at)
    return reason, used, residual, count
