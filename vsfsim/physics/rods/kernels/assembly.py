"""Gradient and second derivative of the potential at a state, and the model that Newton's step minimises.

What contacts say is worked out contact by contact, what segments say segment by segment, and a node gathers from its
own segment and those above it: nothing is added up by two lanes at once.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.contact import friction
from vsfsim.physics.rods.kernels.lanes import count_all, meet, total
from vsfsim.physics.rods.kernels.search import surface_point
from vsfsim.physics.rods.kernels.segment import (
    ONE,
    TINY,
    ZERO,
    gradient,
    mat33,
    mat66,
    quat,
    real,
    second,
    six,
    strain,
    vec3,
)
from vsfsim.physics.rods.kernels.touching import (
    friction_force,
    friction_hessian,
    gap_of,
    normal_energy,
    normal_force,
    normal_hessian,
    normal_stiffness,
    plus_point,
    plus_spin,
    point_at,
    slip,
    turn_hessian,
)
from vsfsim.physics.rods.state import Here, Touches, Trees, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

vec6 = wp.spatial_vectord


@wp.func
def renew(tree: Trees, touch: Touches, w: Work, at: Here, side: int):
    """Limits, normals, anchors of friction, levers and forces of all contacts at the present state. The sum of the
    contact forces [N]."""
    b = at.b
    pressed = ZERO
    mu = touch.friction[b]
    for c in range(at.lane, w.count[side, b], at.lanes):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[at.o + i]
        s = tree.along[j]
        cx = w.cap_x[b, k]
        cq = w.cap_q[b, k]
        qp = w.q[b, p]
        qc = w.q[b, i]
        arm_p = wp.quat_rotate(qp, tree.offset[j])
        arm_c = wp.quat_rotate(qc, tree.offset[j])
        y = (ONE - s) * (w.x[b, p] + arm_p) + s * (w.x[b, i] + arm_c)
        gap = gap_of(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
        depth = -gap.value
        force = normal_force(wp.max(depth, ZERO), tree.penalty[j])
        tau = mu * force
        pressed = pressed + force
        lever = w.lever[side, b, c]
        rub_p = arm_p + wp.quat_rotate(qp, wp.quat_rotate_inv(w.q_start[b, p], lever))
        rub_c = arm_c + wp.quat_rotate(qc, wp.quat_rotate_inv(w.q_start[b, i], lever))
        ys = (ONE - s) * (w.x[b, p] + rub_p) + s * (w.x[b, i] + rub_c)
        stuck = w.stuck[side, b, c]
        if gap.value < ZERO and stuck == 0:
            free = w.gap0[side, b, c] / wp.max(w.gap0[side, b, c] - gap.value, TINY)
            met = w.local0[side, b, c]
            w.anchor[side, b, c] = met + free * (wp.quat_rotate_inv(cq, ys - cx) - met)
            w.stuck[side, b, c] = 2
        if gap.value >= ZERO and stuck == 2:
            w.stuck[side, b, c] = 0  # it left again before the step was over
        hold = cx + wp.quat_rotate(cq, w.anchor[side, b, c])
        slid = slip(gap.normal, ys, hold)
        ft = vec3()
        if tau > ZERO:
            ft = friction_force(slid, tree.penalty[j], tau)
        w.tau[side, b, c] = tau
        w.normal[side, b, c] = gap.normal
        w.depth[side, b, c] = depth
        w.hold[side, b, c] = hold
        w.slid[b, c] = slid
        w.arm_p[b, c] = arm_p
        w.arm_c[b, c] = arm_c
        w.rub_p[b, c] = rub_p
        w.rub_c[b, c] = rub_c
        # one that does not press yet has the force of a plane that stands in its way: only the step's model looks at it
        w.fn[b, c] = -wp.where(depth > ZERO, force, tree.penalty[j] * depth) * gap.normal
        w.ft[b, c] = ft
        w.on[side, b, c] = wp.where(depth > ZERO, 1, 0)
    meet()
    return total(pressed)


@wp.func
def contact_energy(tree: Trees, touch: Touches, w: Work, at: Here, side: int, x: wp.array2d(dtype=vec3),
                   q: wp.array2d(dtype=quat)):
    """This lane's share of the energy of the contacts, the limits of friction as `renew` left them [J]."""
    b = at.b
    out = ZERO
    for c in range(at.lane, w.count[side, b], at.lanes):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[at.o + i]
        y = point_at(tree.along[j], tree.offset[j], x[b, p], q[b, p], x[b, i], q[b, i])
        gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
        if gap.value < ZERO:
            out = out + normal_energy(-gap.value, tree.penalty[j])
        if w.tau[side, b, c] > ZERO:
            ys = surface_point(tree, w, b, p, i, j, w.lever[side, b, c], x[b, p], q[b, p], x[b, i], q[b, i])
            u = slip(w.normal[side, b, c], ys, w.hold[side, b, c])
            out = out + friction.energy(wp.length(u), tree.penalty[j], w.tau[side, b, c])
    return out


@wp.func
def assemble(tree: Trees, touch: Touches, w: Work, at: Here, count: int, side: int, geometric: real):
    """Gradient, elastic part and whole, and the blocks of the elastic energy. How many samples slip."""
    b = at.b
    o = at.o
    slipping = int(0)
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        p = tree.parent[o + i]
        s = strain(w.x[b, p], w.q[b, p], w.x[b, i], w.q[b, i], tree.frame[o + i], tree.length[o + i])
        f, mc, mp = gradient(s, tree.kd[o + i], tree.kphi[o + i])
        w.elastic[b, i] = six(f - tree.load[o + i], mc)
        w.elastic_up[b, i] = six(-f, mp)
        w.mid[b, i] = s.turn
        w.stretch[b, i] = s.D
        w.half_turn[b, i] = s.g
        h = second(s, tree.kd[o + i], tree.kphi[o + i], geometric)
        w.own[b, i] = h.child
        w.own_up[b, i] = h.parent
        w.mixed[b, i] = h.mixed
        on = vec6()
        up = vec6()
        for c in range(w.first[b, i], w.first[b, i] + w.many[b, i]):
            if w.on[side, b, c] == 1:
                j = w.sample[side, b, c]
                al = tree.along[j]
                fn = w.fn[b, c]
                ft = w.ft[b, c]
                up = up + (ONE - al) * six(fn + ft, wp.cross(w.arm_p[b, c], fn) + wp.cross(w.rub_p[b, c], ft))
                on = on + al * six(fn + ft, wp.cross(w.arm_c[b, c], fn) + wp.cross(w.rub_c[b, c], ft))
                if w.tau[side, b, c] > ZERO and tree.penalty[j] * wp.length(w.slid[b, c]) > w.tau[side, b, c]:
                    slipping = slipping + 1
        w.g_on[b, i] = on
        w.g_up[b, i] = up
    meet()
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        elastic = w.elastic[b, i]
        g = w.g_on[b, i]
        own = w.own[b, i]
        kid = tree.child[o + i]
        while kid >= 0:
            if w.active[b, kid] == 1:
                elastic = elastic + w.elastic_up[b, kid]
                g = g + w.g_up[b, kid]
                own = own + w.own_up[b, kid]
            kid = tree.next[o + kid]
        w.elastic[b, i] = elastic
        w.g[b, i] = elastic + g
        w.own[b, i] = own
    meet()
    return count_all(slipping)


@wp.func
def harden(tree: Trees, touch: Touches, w: Work, at: Here, count: int, side: int, geometric: real, coulomb: int):
    """Second derivatives of the contacts; all of the model is stale then. One that does not press stands in the way as
    a plane with the penalty's stiffness; with ``coulomb`` the limit of friction follows the normal force."""
    b = at.b
    for a in range(1 + at.lane, count, at.lanes):
        w.stale[b, w.order[b, a]] = 2
    for c in range(at.lane, w.count[side, b], at.lanes):
        i = w.node[side, b, c]
        k = w.body[side, b, c]
        j = w.sample[side, b, c]
        p = tree.parent[at.o + i]
        al = tree.along[j]
        kn = tree.penalty[j]
        n = w.normal[side, b, c]
        depth = w.depth[side, b, c]
        tau = w.tau[side, b, c]
        hn = kn * wp.outer(n, n)
        ht = mat33()
        hc = mat33()
        if depth > ZERO:
            y = (ONE - al) * (w.x[b, p] + w.arm_p[b, c]) + al * (w.x[b, i] + w.arm_c[b, c])
            gap = gap_of(y, tree.radius[j], w.cap_x[b, k], w.cap_q[b, k], touch.half[k], touch.radius[k])
            hn = normal_hessian(gap, kn, geometric)
            if tau > ZERO:
                u = w.slid[b, c]
                size = wp.length(u)
                ht = friction_hessian(u, n, kn, tau)
                if coulomb == 1 and kn * size > tau:
                    hc = (-touch.friction[b] * normal_stiffness(depth, kn) / size) * wp.outer(u, n)
        w.hn[b, c] = hn
        w.ht[b, c] = ht
        w.hc[b, c] = hc
    meet()


@wp.func
def model(tree: Trees, w: Work, at: Here, count: int, side: int, geometric: real, coulomb: int):
    """Blocks and right side of the step, where they are stale: the elastic part and the contacts that are on."""
    b = at.b
    o = at.o
    # each of the four blocks of a segment by itself: segments with contacts are few, and lanes many
    for item in range(4 + at.lane, 4 * count, at.lanes):
        i = w.order[b, item / 4]
        if w.stale[b, i] < 2 or w.many[b, i] == 0:
            continue
        block = item % 4  # rows and columns: child child, parent parent, child parent, parent child
        if block == 3 and coulomb == 0:
            continue
        own = mat66()
        if block == 2:
            own = w.mixed[b, i]
        if block == 3:
            own = wp.transpose(w.mixed[b, i])
        right = vec6()
        for c in range(w.first[b, i], w.first[b, i] + w.many[b, i]):
            if w.on[side, b, c] == 1:
                al = tree.along[w.sample[side, b, c]]
                fn = w.fn[b, c]
                ft = w.ft[b, c]
                row = al
                ra = w.arm_c[b, c]
                rr = w.rub_c[b, c]
                if block == 1 or block == 3:
                    row = ONE - al
                    ra = w.arm_p[b, c]
                    rr = w.rub_p[b, c]
                column = al
                ca = w.arm_c[b, c]
                cr = w.rub_c[b, c]
                if block == 1 or block == 2:
                    column = ONE - al
                    ca = w.arm_p[b, c]
                    cr = w.rub_p[b, c]
                own = plus_point(own, w.hn[b, c], ra, ca, row * column)
                if w.tau[side, b, c] > ZERO:
                    own = plus_point(own, w.ht[b, c], rr, cr, row * column)
                    if coulomb == 1:
                        own = plus_point(own, w.hc[b, c], rr, ca, row * column)
                if block < 2:
                    right = right - row * six(fn + ft, wp.cross(ra, fn) + wp.cross(rr, ft))
                    if geometric > ZERO and w.depth[side, b, c] > ZERO:
                        own = plus_spin(own, turn_hessian(fn, ra), row)
                        own = plus_spin(own, turn_hessian(ft, rr), row)
        if block == 0:
            w.diagonal_on[b, i] = own
            w.right_on[b, i] = right
        if block == 1:
            w.diagonal_up[b, i] = own
            w.right_up[b, i] = right
        if block == 2:
            w.coupling[b, i] = own
        if block == 3:
            w.across[b, i] = own
    meet()
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[b, a]
        if w.stale[b, i] == 0:
            continue
        diagonal = w.own[b, i]
        right = -w.elastic[b, i]
        if w.many[b, i] > 0:
            diagonal = diagonal + w.diagonal_on[b, i]
            right = right + w.right_on[b, i]
        elif w.stale[b, i] == 2:
            w.coupling[b, i] = w.mixed[b, i]
            if coulomb == 1:
                w.across[b, i] = wp.transpose(w.mixed[b, i])
        kid = tree.child[o + i]
        while kid >= 0:
            if w.active[b, kid] == 1 and w.many[b, kid] > 0:
                diagonal = diagonal + w.diagonal_up[b, kid]
                right = right + w.right_up[b, kid]
            kid = tree.next[o + kid]
        w.diagonal[b, i] = diagonal
        w.right[b, i] = right
    meet()


@wp.func
def foresee(tree: Trees, w: Work, at: Here, tall: int, count: int, side: int):
    """Sets on what the step would press, off what it would leave, and marks what of the model is stale then. How many
    contacts changed."""
    b = at.b
    changed = int(0)
    for a in range(1 + at.lane, count, at.lanes):
        w.stale[b, w.order[b, a]] = 0
    meet()
    for c in range(at.lane, w.count[side, b], at.lanes):
        i = w.node[side, b, c]
        sp = w.step[b, tree.parent[at.o + i]]
        sc = w.step[b, i]
        al = tree.along[w.sample[side, b, c]]
        way = (ONE - al) * (wp.spatial_top(sp) + wp.cross(wp.spatial_bottom(sp), w.arm_p[b, c]))
        way = way + al * (wp.spatial_top(sc) + wp.cross(wp.spatial_bottom(sc), w.arm_c[b, c]))
        on = int(0)
        if w.depth[side, b, c] - wp.dot(w.normal[side, b, c], way) > ZERO:
            on = 1
        if on != w.on[side, b, c]:
            w.on[side, b, c] = on
            w.stale[b, i] = 2
            changed = changed + 1
    meet()
    changed = count_all(changed)
    if changed > 0:
        for back in range(1, tall):
            d = tall - back
            for a in range(w.level[b, d] + at.lane, w.level[b, d + 1], at.lanes):
                i = w.order[b, a]
                stale = w.stale[b, i]
                kid = tree.child[at.o + i]
                while kid >= 0:
                    if w.active[b, kid] == 1 and w.stale[b, kid] > 0:
                        stale = wp.max(stale, 1)
                    kid = tree.next[at.o + kid]
                w.stale[b, i] = stale
            meet()
    return changed


@wp.func
def unbalanced(tree: Trees, w: Work, at: Here, count: int):
    """Sum of the lengths of the unbalanced forces, moments over the segment's length counted as forces [N]."""
    out = ZERO
    for a in range(1 + at.lane, count, at.lanes):
        i = w.order[at.b, a]
        g = w.g[at.b, i]
        out = out + wp.length(wp.spatial_top(g)) + wp.length(wp.spatial_bottom(g)) / tree.length[at.o + i]
    return total(out)
