"""Gradient and second derivative of the potential at a state, and the model that Newton's step minimises."""

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.arrays import Touches, Trees, Work
from vsfsim.physics.rods.search import surface_point
from vsfsim.physics.rods.segment import ONE, TINY, ZERO, gradient, mat66, quat, real, second, six, strain, vec3
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
        w.depth[side, b, c] = -gap.value
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
def assemble(tree: Trees, touch: Touches, w: Work, b: int, o: int, count: int, side: int, geometric: real):
    """Gradient, elastic part and whole, and the blocks of the elastic energy; contacts that press are set on. How many samples slip."""
    slipping = int(0)
    for a in range(count):
        i = w.order[b, a]
        w.elastic[b, i] = vec6()
        w.own[b, i] = mat66()
    for a in range(1, count):
        i = w.order[b, a]
        p = tree.parent[o + i]
        s = strain(w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i], tree.frame[o + i], tree.length[o + i])
        f, mc, mp = gradient(s, tree.kd[o + i], tree.kphi[o + i])
        w.elastic[b, i] = w.elastic[b, i] + six(f - tree.load[o + i], mc)
        w.elastic[b, p] = w.elastic[b, p] + six(-f, mp)
        w.mid[b, i] = s.turn
        w.stretch[b, i] = s.D
        w.half_turn[b, i] = s.g
        h = second(s, tree.kd[o + i], tree.kphi[o + i], geometric)
        w.own[b, i] = w.own[b, i] + h.child
        w.own[b, p] = w.own[b, p] + h.parent
        w.mixed[b, i] = h.mixed
    for a in range(count):
        i = w.order[b, a]
        w.g[b, i] = w.elastic[b, i]
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        al = tree.along[j]
        depth = w.depth[side, b, c]
        w.on[side, b, c] = 0
        if depth > ZERO:
            w.on[side, b, c] = 1
            lp = wp.quat_rotate(w.q[b, p], tree.offset[j])
            lc = wp.quat_rotate(w.q[b, i], tree.offset[j])
            push(w, b, p, i, al, -normal_force(depth, tree.penalty[j]) * w.normal[side, b, c], lp, lc)
            if w.tau[side, b, c] > ZERO:
                lever = w.lever[side, b, c]
                lps = lp + wp.quat_rotate(w.q[b, p], wp.quat_rotate_inv(w.q_start[b, p], lever))
                lcs = lc + wp.quat_rotate(w.q[b, i], wp.quat_rotate_inv(w.q_start[b, i], lever))
                ys = (ONE - al) * (w.x[b, p] + lps) + al * (w.x[b, i] + lcs)
                u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
                push(w, b, p, i, al, friction_force(u, tree.penalty[j], w.tau[side, b, c]), lps, lcs)
                if tree.penalty[j] * wp.length(u) > w.tau[side, b, c]:
                    slipping = slipping + 1
    return slipping


@wp.func
def model(tree: Trees, touch: Touches, w: Work, b: int, o: int, count: int, side: int, geometric: real, coulomb: int):
    """Blocks and right side of the step: the elastic part and the contacts that are on. One that is on and does not press yet stands in the way as a plane with the penalty's stiffness;
    with ``coulomb`` the limit of friction follows the normal force."""
    for a in range(count):
        i = w.order[b, a]
        w.diagonal[b, i] = w.own[b, i]
        w.coupling[b, i] = w.mixed[b, i]
        w.across[b, i] = wp.transpose(w.mixed[b, i])
        w.step[b, i] = -w.elastic[b, i]
    for c in range(w.count[side, b]):
        if w.on[side, b, c] == 1:
            i = w.node[side, b, c]
            k = w.body[side, b, c]
            j = w.sample[side, b, c]
            p = tree.parent[o + i]
            al = tree.along[j]
            kn = tree.penalty[j]
            n = w.normal[side, b, c]
            depth = w.depth[side, b, c]
            lp = wp.quat_rotate(w.q[b, p], tree.offset[j])
            lc = wp.quat_rotate(w.q[b, i], tree.offset[j])
            if depth <= ZERO:
                answer(w, b, p, i, al, (-kn * depth) * n, lp, lc)
                stiffen(w, b, p, i, al, kn * wp.outer(n, n), lp, lc)
            else:
                y = (ONE - al) * (w.x[b, p] + lp) + al * (w.x[b, i] + lc)
                gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
                fn = -normal_force(depth, kn) * n
                answer(w, b, p, i, al, fn, lp, lc)
                stiffen(w, b, p, i, al, normal_hessian(gap, kn, geometric), lp, lc)
                if geometric > ZERO:
                    curve(w, b, p, (ONE - al) * turn_hessian(fn, lp))
                    curve(w, b, i, al * turn_hessian(fn, lc))
                if w.tau[side, b, c] > ZERO:
                    lever = w.lever[side, b, c]
                    lps = lp + wp.quat_rotate(w.q[b, p], wp.quat_rotate_inv(w.q_start[b, p], lever))
                    lcs = lc + wp.quat_rotate(w.q[b, i], wp.quat_rotate_inv(w.q_start[b, i], lever))
                    ys = (ONE - al) * (w.x[b, p] + lps) + al * (w.x[b, i] + lcs)
                    u = slip(n, ys, w.hold[side, b, c])
                    ft = friction_force(u, kn, w.tau[side, b, c])
                    answer(w, b, p, i, al, ft, lps, lcs)
                    stiffen(w, b, p, i, al, friction_hessian(u, n, kn, w.tau[side, b, c]), lps, lcs)
                    if geometric > ZERO:
                        curve(w, b, p, (ONE - al) * turn_hessian(ft, lps))
                        curve(w, b, i, al * turn_hessian(ft, lcs))
                    size = wp.length(u)
                    if coulomb == 1 and kn * size > w.tau[side, b, c]:
                        couple(w, b, p, i, al, (-touch.friction[b] * normal_stiffness(depth, kn) / size) * wp.outer(u, n), lps, lcs, lp, lc)


@wp.func
def answer(w: Work, b: int, p: int, i: int, s: real, f: vec3, lp: vec3, lc: vec3):
    """Takes the gradient ``f`` at a point off the right side."""
    w.step[b, p] = w.step[b, p] - (ONE - s) * six(f, wp.cross(lp, f))
    w.step[b, i] = w.step[b, i] - s * six(f, wp.cross(lc, f))


@wp.func
def foresee(tree: Trees, w: Work, b: int, o: int, side: int):
    """Sets on what the step would press, off what it would leave. How many contacts changed."""
    changed = int(0)
    for c in range(w.count[side, b]):
        i = w.node[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[o + i]
        al = tree.along[j]
        sp = w.step[b, p]
        sc = w.step[b, i]
        way = (ONE - al) * (wp.spatial_top(sp) + wp.cross(wp.spatial_bottom(sp), wp.quat_rotate(w.q[b, p], tree.offset[j])))
        way = way + al * (wp.spatial_top(sc) + wp.cross(wp.spatial_bottom(sc), wp.quat_rotate(w.q[b, i], tree.offset[j])))
        on = int(0)
        if w.depth[side, b, c] - wp.dot(w.normal[side, b, c], way) > ZERO:
            on = 1
        if on != w.on[side, b, c]:
            w.on[side, b, c] = on
            changed = changed + 1
    return changed


@wp.func
def unbalanced(tree: Trees, w: Work, b: int, o: int, count: int):
    """Sum of the lengths of the unbalanced forces, moments over the segment's length counted as forces [N]."""
    out = ZERO
    for a in range(1, count):
        i = w.order[b, a]
        g = w.g[b, i]
        out = out + wp.length(wp.spatial_top(g)) + wp.length(wp.spatial_bottom(g)) / tree.length[o + i]
    return out
