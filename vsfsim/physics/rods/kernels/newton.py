"""Equilibrium of the active part of a tree: Newton's method with a line search on the potential."""

import warp as wp

from vsfsim.physics.rods.kernels import assembly
from vsfsim.physics.rods.kernels.contact_search import activate_nodes, carry_unloaded, copy_state, list_contacts
from vsfsim.physics.rods.kernels.crossing import crossing
from vsfsim.physics.rods.kernels.elimination import solve
from vsfsim.physics.rods.kernels.lanes import lane_max, lane_sum, sync
from vsfsim.physics.rods.kernels.segment import HALF, ONE, TINY, ZERO, energy, quat, real, strain, vec3
from vsfsim.physics.rods.structs import Thread, Touches, Trees, Work
from vsfsim.physics.solve.frames import Reason

MARGIN = wp.constant(wp.float64(0.006))  # distance from a capsule at which a fibre is listed as a contact [m]
# Longest displacement in one iteration over the clearance of the node, its distance from the capsules. The clearance
# counts as `MARGIN` at least, which is less than half the thickness of the thinnest capsule.
MOVE = wp.constant(wp.float64(0.85))
# Displacement over the clearance after which contacts are searched again. Steps in between stay below 1 in sum, so what
# is not listed, and the unloaded parts, which `crossing` does not look at, cannot reach a capsule.
SEARCH = wp.constant(wp.float64(0.5))
TURN = wp.constant(wp.float64(0.5))  # largest rotation of a node in one iteration [rad]
HALVINGS = wp.constant(12)  # of the length of a step in the line search
# Sufficient decrease of the residual norm of steps with the unsymmetric tangent of Coulomb friction (no potential
# exists there).
SHRINK = wp.constant(wp.float64(0.25))
# Residual below which, once a step has not lowered the potential, steps are judged by the residual norm, too: the
# points of a patch move with it, and their sum is the integral of the energy to a ten-thousandth only [-].
TRUSTED = wp.constant(wp.float64(0.01))
CAREFUL = wp.constant(2)  # steps with the symmetric tangent after an unsymmetric one was rejected


@wp.func
def rotated(q: quat, spin: vec3):
    """exp(spin) q."""
    angle = wp.length(spin)
    half = HALF * angle
    scale = HALF
    if angle > TINY:
        scale = wp.sin(half) / angle
    return wp.normalize(wp.mul(quat(scale * spin[0], scale * spin[1], scale * spin[2], wp.cos(half)), q))


@wp.func
def look_along(tree: Trees, w: Work, me: Thread, count: int):
    """Sets D' of each segment along the step, see `segment`. Returns the slope of the potential along the step [J], the
    largest displacement of a node, or of what it carries, over its clearance [-], and the largest rotation [rad]."""
    b = me.b
    slope = ZERO
    way = ZERO
    turn = ZERO
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        s = w.system.step[b, i]
        up = w.system.step[b, tree.parent[me.o + i]]
        at = w.segments.strain[b, i]
        on_p = wp.quat_rotate_inv(at.turn, wp.spatial_bottom(up))
        on_c = wp.quat_rotate_inv(at.turn, wp.spatial_bottom(s))
        spin = HALF * (on_p + on_c) - HALF * wp.cross(at.g, on_c - on_p)
        apart = wp.quat_rotate_inv(at.turn, wp.spatial_top(s) - wp.spatial_top(up))
        w.segments.span_rate[b, i] = apart - wp.cross(spin, at.D)
        slope = slope + wp.dot(w.system.gradient[b, i], s)
        angle = wp.length(wp.spatial_bottom(s))
        turn = wp.max(turn, angle)
        farthest = wp.length(wp.spatial_top(s)) + angle * w.nodes.unloaded_reach[b, i]
        way = wp.max(way, farthest / wp.max(MARGIN, w.nodes.node_clearance[b, i]))
    sync()
    return lane_sum(slope), lane_max(way), lane_max(turn)


@wp.func
def trial_state(tree: Trees, w: Work, me: Thread, count: int, levels: int, alpha: real, load: real):
    """The trial state at ``alpha`` times the step. Returns this lane's share of its elastic energy and of what yields,
    less the work of the loads [J].

    Nodes turn by ``alpha`` times their spins, the D of a segment changes by ``alpha`` D', and positions follow from the
    root. So a rotation does not stretch a slender segment, as it would if positions moved along straight lines. The
    path has the step as its tangent, which is all that a line search needs.
    """
    b = me.b
    o = me.o
    out = ZERO
    if me.lane == 0:
        w.trial.x[b, 0] = w.now.x[b, 0]
        w.trial.q[b, 0] = w.now.q[b, 0]
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        w.trial.q[b, i] = rotated(w.now.q[b, i], alpha * wp.spatial_bottom(w.system.step[b, i]))
    sync()
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        span = w.segments.strain[b, i].D + alpha * w.segments.span_rate[b, i]
        qp = w.trial.q[b, tree.parent[o + i]]
        s = strain(vec3(), qp, vec3(), w.trial.q[b, i], tree.frame[o + i], ZERO)
        w.trial.x[b, i] = wp.quat_rotate(s.turn, span)
        s.d = span - vec3(tree.length[o + i], ZERO, ZERO)
        out = out + energy(s, tree.kd[o + i], tree.kphi[o + i], tree.wire[o + i], w.nodes.plastic[b, i])
    sync()
    for d in range(1, levels):
        for a in range(w.nodes.level[b, d] + me.lane, w.nodes.level[b, d + 1], me.lanes):
            i = w.nodes.order[b, a]
            w.trial.x[b, i] = w.trial.x[b, i] + w.trial.x[b, tree.parent[o + i]]
        sync()
    if load > ZERO:
        for a in range(1 + me.lane, count, me.lanes):
            i = w.nodes.order[b, a]
            out = out - wp.dot(tree.load[o + i], w.trial.x[b, i] - tree.rest[o + i])
    return out


@wp.func
def trial_crossing(tree: Trees, touch: Touches, w: Work, me: Thread, count: int):
    """Number of active segments that pass through a capsule on the way to the trial state."""
    return crossing(tree, touch.half, w.nodes.order, me, count, w.now, w.capsules, w.trial, w.capsules)


@wp.func
def equilibrate(tree: Trees, touch: Touches, w: Work, me: Thread, old: int, new: int, load: real):
    """From the present state to the equilibrium with the capsules at their present poses.

    Each large function is called in one place only, and a failed step is repeated by another turn of the loop: CUDA's
    compiler inlines a function at every call.

    Args:
        old, new: contact lists of the last stride and of this one. load: sum of the plant's weights [N].

    Returns:
        `frames.Reason`, Newton iterations, residual [-], number of active nodes.
    """
    b = me.b
    count = int(0)
    levels = int(0)
    moved = real(2.0)  # displacement since the last contact search over the clearance; 2 makes the lists now
    listed = int(0)
    reason = int(Reason.ITERATIONS)
    used = int(0)
    residual = ZERO
    small = int(0)
    plain = int(0)  # steps with the symmetric tangent that remain to be made
    tried = int(0)  # 1: the present step is unsymmetric, at full length and without a line search
    before = ZERO
    way = ZERO
    same = int(0)  # 1: the state is that of the iteration before, and the step is computed in another way
    geometric = ONE
    rest = ZERO
    slope = ZERO
    turn = ZERO
    turns = int(0)
    for _it in range(3 * touch.limits.newton):
        if turns >= touch.limits.newton:
            break
        if same == 0:
            turns = turns + 1
        if moved > SEARCH and tried == 0:
            carry_unloaded(tree, w, me)
            listed = list_contacts(tree, touch, w, me, MARGIN, old, new)
            if listed < 0:
                reason = Reason.PATCH
                break
            count, levels = activate_nodes(tree, w, me, load)
            moved = ZERO
            if count == 1:
                reason = Reason.NONE
                break
        force = assembly.update_contacts(tree, touch, w, me, new) + load
        slips = assembly.assemble(tree, w, me, count, new, geometric)
        rest = assembly.unbalanced_force(tree, w, me, count)
        if tried == 1 and not rest < (ONE - SHRINK) * before:
            # the residual norm has not decreased enough: return to the state before, and take the symmetric tangent
            copy_state(w, me, count, w.saved, w.now)
            tried = 0
            plain = CAREFUL
            continue
        if tried == 1:
            moved = moved + way
        tried = 0
        residual = rest / wp.max(wp.max(force, touch.limits.force_floor),
                                 tree.floor[touch.plant[b]] / touch.limits.tolerance)
        if not wp.isfinite(rest):
            reason = Reason.NOT_FINITE
            break
        if residual <= touch.limits.tolerance:
            reason = Reason.NONE
            break
        if same == 0:
            used = used + 1
        same = 0
        if moved > SEARCH:
            same = 1
            continue
        coulomb = int(0)
        if plain == 0 and (slips > 0 or (small > 0 and residual < TRUSTED)):
            coulomb = 1
        assembly.assemble_step(tree, touch, w, me, count, new, geometric, coulomb)
        fine = solve(tree, w, me, levels, coulomb)
        if fine == 1:
            slope, way, turn = look_along(tree, w, me, count)
        if coulomb == 1:
            if fine == 1 and wp.isfinite(slope) and moved + way < ONE and way < MOVE and turn < TURN:
                before = rest
                tried = 1
                copy_state(w, me, count, w.now, w.saved)
            else:
                plain = 1
                same = 1
                continue
        else:
            if fine == 0:
                if geometric > ZERO:
                    # without the geometric stiffness the tangent is positive definite
                    geometric = ZERO
                    same = 1
                    plain = wp.max(plain, 1)
                    continue
                reason = Reason.NOT_FINITE
                break
            if not wp.isfinite(slope):
                reason = Reason.NOT_FINITE
                break
            geometric = ONE
            plain = wp.max(plain - 1, 0)
        alpha = ONE
        if tried == 0:
            alpha = wp.min(ONE, wp.min(wp.min(MOVE, ONE - moved) / wp.max(way, TINY), TURN / wp.max(turn, TINY)))
        start = ZERO
        found = int(0)
        through = int(0)
        for trial in range(HALVINGS + 1):
            reach = alpha
            if trial == 0 and tried == 0:
                reach = ZERO
            there = trial_state(tree, w, me, count, levels, reach, load)
            if tried == 1:
                through = trial_crossing(tree, touch, w, me, count)
                break
            there = lane_sum(there + assembly.contact_energy(tree, touch, w, me, new, w.trial))
            if trial == 0:
                start = there
            else:
                # Armijo's condition, up to the rounding error of the sum
                if there <= start + real(1e-4) * alpha * slope + real(1e-14) * wp.abs(start):
                    if trial_crossing(tree, touch, w, me, count) == 0:
                        found = 1
                        break
                alpha = HALF * alpha
        if tried == 1:
            if through > 0:
                # the step would carry a fibre through a capsule: a line search with the symmetric tangent shortens it
                tried = 0
                plain = CAREFUL
                same = 1
                continue
            copy_state(w, me, count, w.trial, w.now)
            continue
        if found == 0:
            small = small + 1
            if small > 2:
                reason = Reason.STALLED
                break
            continue
        small = 0
        copy_state(w, me, count, w.trial, w.now)
        moved = moved + alpha * way
    carry_unloaded(tree, w, me)
    return reason, used, residual, count
