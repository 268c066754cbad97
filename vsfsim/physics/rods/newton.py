"""Equilibrium of the active part of a tree: Newton's method with a line search on the potential, solved by elimination from the tips to the root."""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Touches, Trees, Work
from vsfsim.physics.rods.search import activate, gather, ride, surface_point
from vsfsim.physics.rods.segment import HALF, ONE, TINY, ZERO, energy, gradient, mat66, quat, real, second, six, strain, vec3
from vsfsim.physics.rods.touching import (
    add_mixed,
    add_point,
    friction_energy,
    friction_force,
    friction_hessian,
    gap_of,
    normal_energy,
    normal_force,
    normal_hessian,
    normal_stiffness,
    point_at,
    slip,
    turn_hessian,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

vec6 = wp.spatial_vectord

MARGIN = wp.constant(wp.float64(0.006))  # how near a sample must be to be listed [m]
MOVE = wp.constant(wp.float64(0.005))  # longest way of any node in one iteration [m]: under half of the thinnest capsule, so nothing is jumped
TURN = wp.constant(wp.float64(0.5))  # and its largest turn [rad]
FAINT = wp.constant(wp.float64(0.02))  # contact forces under this count as this in the residual: a thousandth of what a joint's torque sensor can tell [N]
NEWTON = wp.constant(60)
HALVINGS = wp.constant(12)
SHRINK = wp.constant(wp.float64(0.7))  # of the unbalanced force, by a step that no potential vouches for
CAREFUL = wp.constant(2)  # steps down the potential after one that was taken back
OK, ITERATIONS, STALLED, NOT_FINITE, PATCH = (wp.constant(k) for k in (0, 1, 3, 4, 5))  # frames.Reason


@wp.func
def renew(tree: Trees, touch: Touches, w: Work, b: int, o: int, side: int):
    """Limits, normals and anchors of friction at the present state. The sum of the contact forces [N]."""
    total = ZERO
    mu = touch.friction[b]
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        cx = w.cap_x[b, k]
        cq = w.cap_q[b, k]
        y = point_at(tree.along[j], tree.offset[j], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
        gap = gap_of(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
        force = normal_force(wp.max(-gap.value, ZERO), tree.penalty[j])
        total = total + force
        w.tau[side, b, c] = mu * force
        w.normal[side, b, c] = gap.normal
        if gap.value < ZERO and w.stuck[side, b, c] == 0:
            free = w.gap0[side, b, c] / wp.max(w.gap0[side, b, c] - gap.value, TINY)
            ys = surface_point(tree, w, b, p, i, j, w.lever[side, b, c], w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i])
            met = w.local0[side, b, c]
            w.anchor[side, b, c] = met + free * (wp.quat_rotate_inv(cq, ys - cx) - met)
            w.stuck[side, b, c] = 2
        if gap.value >= ZERO and w.stuck[side, b, c] == 2:
            w.stuck[side, b, c] = 0  # it left again before the step was over
        place = w.anchor[side, b, c]
        w.hold[side, b, c] = cx + wp.quat_rotate(cq, place)
    return total


@wp.func
def contact_energy(tree: Trees, touch: Touches, w: Work, b: int, o: int, side: int, x: wp.array2d(dtype=vec3), q: wp.array2d(dtype=quat)):
    """Energy of the contacts, the limits of friction as `renew` left them [J]."""
    out = ZERO
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        y = point_at(tree.along[j], tree.offset[j], x[b, p], q[b, p], x[b, i], q[b, i])
        gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            out = out + normal_energy(-gap.value, tree.penalty[j])
        if w.tau[side, b, c] > ZERO:
            ys = surface_point(tree, w, b, p, i, j, w.lever[side, b, c], x[b, p], q[b, p], x[b, i], q[b, i])
            u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
            out = out + friction_energy(wp.length(u), tree.penalty[j], w.tau[side, b, c])
    return out


@wp.func
def push(w: Work, b: int, p: int, i: int, s: real, f: vec3, lp: vec3, lc: vec3):
    """Adds the gradient ``f`` at a point with levers ``lp``, ``lc`` to its nodes."""
    w.g[b, p] = w.g[b, p] + (ONE - s) * six(f, wp.cross(lp, f))
    w.g[b, i] = w.g[b, i] + s * six(f, wp.cross(lc, f))


@wp.func
def stiffen(w: Work, b: int, p: int, i: int, s: real, h: wp.mat33d, lp: vec3, lc: vec3):
    """Adds J^T h J of a point to the blocks of its nodes."""
    w.diagonal[b, p] = w.diagonal[b, p] + add_point(h, lp, lc, s, 0, 0)
    w.diagonal[b, i] = w.diagonal[b, i] + add_point(h, lp, lc, s, 1, 1)
    w.coupling[b, i] = w.coupling[b, i] + add_point(h, lp, lc, s, 1, 0)
    w.across[b, i] = w.across[b, i] + add_point(h, lp, lc, s, 0, 1)


@wp.func
def curve(w: Work, b: int, i: int, h: wp.mat33d):
    """Adds a 3 x 3 block to the spins of a node."""
    d = w.diagonal[b, i]
    for r in range(3):
        for c in range(3):
            d[r + 3, c + 3] = d[r + 3, c + 3] + h[r, c]
    w.diagonal[b, i] = d


@wp.func
def couple(w: Work, b: int, p: int, i: int, s: real, h: wp.mat33d, lps: vec3, lcs: vec3, lp: vec3, lc: vec3):
    """Adds J_s^T h J: the derivative of a force at the surface (levers ``lps``, ``lcs``) by the place of the sample (``lp``, ``lc``). It is not symmetric."""
    w.diagonal[b, p] = w.diagonal[b, p] + add_mixed(h, lps, lp, (ONE - s) * (ONE - s))
    w.diagonal[b, i] = w.diagonal[b, i] + add_mixed(h, lcs, lc, s * s)
    w.coupling[b, i] = w.coupling[b, i] + add_mixed(h, lcs, lp, s * (ONE - s))
    w.across[b, i] = w.across[b, i] + add_mixed(h, lps, lc, s * (ONE - s))


@wp.func
def assemble(tree: Trees, touch: Touches, w: Work, b: int, o: int, count: int, side: int, geometric: real, coulomb: int):
    """Gradient and blocks of the second derivative at the present state; with ``coulomb`` the limit of friction follows the normal force. How many samples slip."""
    slipping = int(0)
    for a in range(count):
        i = w.order[b, a]
        w.g[b, i] = vec6()
        w.diagonal[b, i] = mat66()
    for a in range(1, count):
        i = w.order[b, a]
        p = tree.parent[o + i]
        s = strain(w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i], tree.frame[o + i], tree.length[o + i])
        f, mc, mp = gradient(s, tree.kd[o + i], tree.kphi[o + i])
        w.g[b, i] = w.g[b, i] + six(f - tree.load[o + i], mc)
        w.g[b, p] = w.g[b, p] + six(-f, mp)
        w.mid[b, i] = s.turn
        w.stretch[b, i] = s.D
        w.half_turn[b, i] = s.g
        h = second(s, tree.kd[o + i], tree.kphi[o + i], geometric)
        w.diagonal[b, i] = w.diagonal[b, i] + h.child
        w.diagonal[b, p] = w.diagonal[b, p] + h.parent
        w.coupling[b, i] = h.mixed
        w.across[b, i] = wp.transpose(h.mixed)
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        al = tree.along[j]
        lp = wp.quat_rotate(w.q[b, p], tree.offset[j])
        lc = wp.quat_rotate(w.q[b, i], tree.offset[j])
        y = (ONE - al) * (w.x[b, p] + lp) + al * (w.x[b, i] + lc)
        gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            kn = tree.penalty[j]
            fn = -normal_force(-gap.value, kn) * gap.normal
            push(w, b, p, i, al, fn, lp, lc)
            stiffen(w, b, p, i, al, normal_hessian(gap, kn, geometric), lp, lc)
            if geometric > ZERO:
                curve(w, b, p, (ONE - al) * turn_hessian(fn, lp))
                curve(w, b, i, al * turn_hessian(fn, lc))
            if w.tau[side, b, c] > ZERO:
                lever = w.lever[side, b, c]
                lps = lp + wp.quat_rotate(w.q[b, p], wp.quat_rotate_inv(w.q_start[b, p], lever))
                lcs = lc + wp.quat_rotate(w.q[b, i], wp.quat_rotate_inv(w.q_start[b, i], lever))
                ys = (ONE - al) * (w.x[b, p] + lps) + al * (w.x[b, i] + lcs)
                u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
                ft = friction_force(u, kn, w.tau[side, b, c])
                push(w, b, p, i, al, ft, lps, lcs)
                stiffen(w, b, p, i, al, friction_hessian(u, w.normal[side, b, c], kn, w.tau[side, b, c]), lps, lcs)
                if geometric > ZERO:
                    curve(w, b, p, (ONE - al) * turn_hessian(ft, lps))
                    curve(w, b, i, al * turn_hessian(ft, lcs))
                size = wp.length(u)
                if kn * size > w.tau[side, b, c]:
                    slipping = slipping + 1
                    if coulomb == 1:
                        couple(w, b, p, i, al, (-touch.friction[b] * normal_stiffness(-gap.value, kn) / size) * wp.outer(u, gap.normal), lps, lcs, lp, lc)
    return slipping


@wp.func
def unbalanced(tree: Trees, w: Work, b: int, o: int, count: int):
    """Sum of the lengths of the unbalanced forces, moments over the segment's length counted as forces [N]."""
    out = ZERO
    for a in range(1, count):
        i = w.order[b, a]
        g = w.g[b, i]
        out = out + wp.length(wp.spatial_top(g)) + wp.length(wp.spatial_bottom(g)) / tree.length[o + i]
    return out


@wp.func
def cholesky(a: mat66):
    """Lower factor of a 6 x 6 block, and 1, or 0 where it is not positive definite."""
    out = mat66()
    fine = int(1)
    for j in range(6):
        d = a[j, j]
        for k in range(j):
            d = d - out[j, k] * out[j, k]
        if not d > real(1e-13) * wp.abs(a[j, j]):
            fine = 0
            d = ONE
        root = wp.sqrt(d)
        out[j, j] = root
        for i in range(j + 1, 6):
            v = a[i, j]
            for k in range(j):
                v = v - out[i, k] * out[j, k]
            out[i, j] = v / root
    return out, fine


@wp.func
def solve(tree: Trees, w: Work, b: int, o: int, count: int):
    """Newton's step of all active nodes, from tips to root and back. 1, or 0 where the tangent is not positive definite."""
    for a in range(count):
        i = w.order[b, a]
        w.step[b, i] = -w.g[b, i]
    for back in range(1, count):
        i = w.order[b, count - back]
        p = tree.parent[o + i]
        low, fine = cholesky(w.diagonal[b, i])
        if fine == 0:
            return 0
        y = w.coupling[b, i]
        r = w.step[b, i]
        for k in range(6):
            inverse = ONE / low[k, k]
            for c in range(6):
                v = y[k, c]
                for m in range(k):
                    v = v - low[k, m] * y[m, c]
                y[k, c] = v * inverse
            v6 = r[k]
            for m in range(k):
                v6 = v6 - low[k, m] * r[m]
            r[k] = v6 * inverse
        w.diagonal[b, i] = low
        w.coupling[b, i] = y
        w.step[b, i] = r
        if p > 0:
            yt = wp.transpose(y)
            w.diagonal[b, p] = w.diagonal[b, p] - yt * y
            w.step[b, p] = w.step[b, p] - yt * r
    w.step[b, 0] = vec6()
    for a in range(1, count):
        i = w.order[b, a]
        p = tree.parent[o + i]
        low = w.diagonal[b, i]
        r = w.step[b, i] - w.coupling[b, i] * w.step[b, p]
        for up in range(6):
            k = 5 - up
            v = r[k]
            for m in range(k + 1, 6):
                v = v - low[m, k] * r[m]
            r[k] = v / low[k, k]
        w.step[b, i] = r
    return 1


@wp.func
def solve_coulomb(tree: Trees, w: Work, b: int, o: int, count: int):
    """As `solve`, for a tangent that is not symmetric: Gauss's elimination with pivots within the blocks. 1, or 0 where a pivot is lost."""
    for a in range(count):
        i = w.order[b, a]
        w.step[b, i] = -w.g[b, i]
    for back in range(1, count):
        i = w.order[b, count - back]
        p = tree.parent[o + i]
        d = w.diagonal[b, i]
        y = w.coupling[b, i]
        r = w.step[b, i]
        up = w.across[b, i]
        for k in range(6):
            best = k
            for m in range(k + 1, 6):
                if wp.abs(d[m, k]) > wp.abs(d[best, k]):
                    best = m
            if not wp.abs(d[best, k]) > ZERO:
                return 0
            if best != k:
                for c in range(6):
                    t = d[k, c]
                    d[k, c] = d[best, c]
                    d[best, c] = t
                    t = y[k, c]
                    y[k, c] = y[best, c]
                    y[best, c] = t
                t = r[k]
                r[k] = r[best]
                r[best] = t
            inverse = ONE / d[k, k]
            for m in range(k + 1, 6):
                f = d[m, k] * inverse
                if f != ZERO:
                    for c in range(k + 1, 6):
                        d[m, c] = d[m, c] - f * d[k, c]
                    for c in range(6):
                        y[m, c] = y[m, c] - f * y[k, c]
                    r[m] = r[m] - f * r[k]
        for low in range(6):
            k = 5 - low
            inverse = ONE / d[k, k]
            for m in range(k + 1, 6):
                f = d[k, m]
                for c in range(6):
                    y[k, c] = y[k, c] - f * y[m, c]
                r[k] = r[k] - f * r[m]
            for c in range(6):
                y[k, c] = y[k, c] * inverse
            r[k] = r[k] * inverse
        w.coupling[b, i] = y
        w.step[b, i] = r
        if p > 0:
            w.diagonal[b, p] = w.diagonal[b, p] - up * y
            w.step[b, p] = w.step[b, p] - up * r
    w.step[b, 0] = vec6()
    for a in range(1, count):
        i = w.order[b, a]
        w.step[b, i] = w.step[b, i] - w.coupling[b, i] * w.step[b, tree.parent[o + i]]
    return 1


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
def extent(tree: Trees, w: Work, b: int, o: int, count: int):
    """Slope of the potential along the step [J], the longest way of a node or its riders [m], the largest turn [rad]; D' of each segment, see `segment`."""
    slope = ZERO
    way = ZERO
    turn = ZERO
    for a in range(1, count):
        i = w.order[b, a]
        s = w.step[b, i]
        up = w.step[b, tree.parent[o + i]]
        slope = slope + wp.dot(w.g[b, i], s)
        angle = wp.length(wp.spatial_bottom(s))
        turn = wp.max(turn, angle)
        way = wp.max(way, wp.length(wp.spatial_top(s)) + angle * w.rider[b, i])
        mid = w.mid[b, i]
        on_p = wp.quat_rotate_inv(mid, wp.spatial_bottom(up))
        on_c = wp.quat_rotate_inv(mid, wp.spatial_bottom(s))
        spin = HALF * (on_p + on_c) - HALF * wp.cross(w.half_turn[b, i], on_c - on_p)
        w.rate[b, i] = wp.quat_rotate_inv(mid, wp.spatial_top(s) - wp.spatial_top(up)) - wp.cross(spin, w.stretch[b, i])
    return slope, way, turn


@wp.func
def attempt(tree: Trees, w: Work, b: int, o: int, count: int, alpha: real):
    """The trial state at ``alpha`` of the step, and its elastic energy less the work of the loads [J].

    Nodes turn by their spins, each segment's D goes a part of its D', and positions follow from the root: a slender segment is then not stretched by turning, as it
    would be if positions went straight. The path has the step as its tangent, which is all that a line search needs.
    """
    out = ZERO
    w.x_try[b, 0] = w.x[b, 0]
    w.q_try[b, 0] = w.q[b, 0]
    for a in range(1, count):
        i = w.order[b, a]
        p = tree.parent[o + i]
        w.q_try[b, i] = turned(w.q[b, i], alpha * wp.spatial_bottom(w.step[b, i]))
        there = w.stretch[b, i] + alpha * w.rate[b, i]
        xp = w.x_try[b, p]
        s = strain(xp, w.q_try[b, p], xp, w.q_try[b, i], tree.frame[o + i], ZERO)
        x = xp + wp.quat_rotate(s.turn, there)
        w.x_try[b, i] = x
        s.d = there - vec3(tree.length[o + i], ZERO, ZERO)
        out = out + energy(s, tree.kd[o + i], tree.kphi[o + i]) - wp.dot(tree.load[o + i], x - tree.rest[o + i])
    return out


@wp.func
def accept(w: Work, b: int, count: int):
    """Takes the trial state."""
    for a in range(1, count):
        i = w.order[b, a]
        w.x[b, i] = w.x_try[b, i]
        w.q[b, i] = w.q_try[b, i]


@wp.func
def keep(w: Work, b: int, count: int):
    """Remembers the state, to come back to it."""
    for a in range(1, count):
        i = w.order[b, a]
        w.x_keep[b, i] = w.x[b, i]
        w.q_keep[b, i] = w.q[b, i]


@wp.func
def restore(w: Work, b: int, count: int):
    """Back to the state that `keep` remembers."""
    for a in range(1, count):
        i = w.order[b, a]
        w.x[b, i] = w.x_keep[b, i]
        w.q[b, i] = w.q_keep[b, i]


@wp.func
def balance(tree: Trees, touch: Touches, w: Work, b: int, o: int, n: int, old: int, new: int, weighs: int, load: real):
    """From the present state to the equilibrium with the capsules where they are. Reason (0: found), iterations, residual, active nodes."""
    count = int(0)
    moved = ONE  # so that the lists are made at once
    clear = ZERO
    cap = MOVE
    listed = int(0)
    reason = int(ITERATIONS)
    used = int(0)
    residual = ZERO
    small = int(0)
    plain = int(0)
    tried = int(0)
    before = ZERO
    for it in range(NEWTON):
        if moved > clear and tried == 0:
            ride(tree, w, b, o, n)
            listed, clear = gather(tree, touch, w, b, o, n, MARGIN, old, new)
            if listed < 0:
                reason = PATCH
                break
            cap = MOVE
            if listed == 0:
                cap = wp.max(MOVE, HALF * clear)
            count = activate(tree, w, b, o, n, new, weighs)
            moved = ZERO
            if count == 1:
                reason = OK
                break
        force = renew(tree, touch, w, b, o, new) + load
        slips = assemble(tree, touch, w, b, o, count, new, ONE, wp.where(plain > 0, 0, 1))
        rest = unbalanced(tree, w, b, o, count)
        if tried == 1 and not rest < SHRINK * before:
            # Newton's step with friction following the normal force did no good: back, and down the potential instead
            restore(w, b, count)
            tried = 0
            plain = CAREFUL
            continue
        tried = 0
        residual = rest / wp.max(wp.max(force, FAINT), tree.floor[touch.plant[b]] / touch.tolerance)
        if not wp.isfinite(rest):
            reason = NOT_FINITE
            break
        if residual <= touch.tolerance:
            reason = OK
            break
        used = used + 1
        if slips > 0 and plain == 0:
            if solve_coulomb(tree, w, b, o, count) == 1:
                slope, way, turn = extent(tree, w, b, o, count)
                if wp.isfinite(slope) and way < cap and turn < TURN:
                    before = rest
                    tried = 1
                    keep(w, b, count)
                    attempt(tree, w, b, o, count, ONE)
                    accept(w, b, count)
                    moved = moved + way
                    continue
            plain = 1
            assemble(tree, touch, w, b, o, count, new, ONE, 0)
        plain = wp.max(plain - 1, 0)
        if solve(tree, w, b, o, count) == 0:
            assemble(tree, touch, w, b, o, count, new, ZERO, 0)
            if solve(tree, w, b, o, count) == 0:
                reason = NOT_FINITE
                break
        slope, way, turn = extent(tree, w, b, o, count)
        if not wp.isfinite(slope):
            reason = NOT_FINITE
            break
        alpha = wp.min(ONE, wp.min(cap / wp.max(way, TINY), TURN / wp.max(turn, TINY)))
        start = attempt(tree, w, b, o, count, ZERO) + contact_energy(tree, touch, w, b, o, new, w.x, w.q)
        found = int(0)
        for trial in range(HALVINGS):
            there = attempt(tree, w, b, o, count, alpha) + contact_energy(tree, touch, w, b, o, new, w.x_try, w.q_try)
            # rounding of the sum decides below its last digits
            if there <= start + real(1e-4) * alpha * slope + real(1e-14) * wp.abs(start):
                found = 1
                break
            alpha = HALF * alpha
        if found == 0:
            small = small + 1
            if small > 2:
                reason = STALLED
                break
        accept(w, b, count)
        moved = moved + alpha * way
    ride(tree, w, b, o, n)
    return reason, used, residual, count
