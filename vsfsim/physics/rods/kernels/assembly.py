"""Gradient and second derivative of the potential at a state, and the quadratic model that a Newton step minimises.

Contacts and segments are computed one by one, and a node gathers from its own segment and its children's: no two lanes
add to the same number.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.contact import friction
from vsfsim.physics.rods.kernels.contact_law import (
    capsule_gap,
    friction_force,
    friction_hessian,
    normal_energy,
    normal_force,
    normal_hessian,
    normal_stiffness,
    plus_point,
    plus_spin,
    slip,
    turn_hessian,
)
from vsfsim.physics.rods.kernels.fibre import (
    POINTS,
    child_offset,
    child_share,
    fibre_point,
    parent_offset,
    point_place,
    point_stiffness,
)
from vsfsim.physics.rods.kernels.geometry import fibre_patch, segment_strain, surface_point
from vsfsim.physics.rods.kernels.lanes import lane_count, lane_sum, sync
from vsfsim.physics.rods.kernels.segment import (
    ONE,
    TINY,
    ZERO,
    gradient,
    hessian,
    mat33,
    mat66,
    quat,
    real,
    spatial,
    vec3,
)
from vsfsim.physics.rods.kernels.yielding import segment_moment, segment_tangent
from vsfsim.physics.rods.structs import Stale, Stick, Thread, Touches, Trees, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

vec6 = wp.spatial_vectord
# the blocks of a segment, by the nodes of their rows and columns
CHILD, PARENT, CHILD_PARENT, PARENT_CHILD = (wp.constant(k) for k in range(4))


@wp.func
def update_contacts(tree: Trees, touch: Touches, w: Work, me: Thread, side: int):
    """Patches, friction limits, normals, anchors, levers and forces of all contacts at the present state. Returns the
    sum of the normal forces [N]."""
    b = me.b
    o = me.o
    pressed = ZERO
    mu = touch.friction[b]
    for pair in range(me.lane, w.contacts.count[side, b] / POINTS, me.lanes):
        i = w.contacts.node[side, b, POINTS * pair]
        k = w.contacts.capsule[side, b, POINTS * pair]
        j = w.contacts.fibre[side, b, POINTS * pair]
        p = tree.parent[o + i]
        cx = w.capsules.x[b, k]
        cq = w.capsules.q[b, k]
        cx0 = w.capsules.x_start[b, k]
        cq0 = w.capsules.q_start[b, k]
        qp = w.nodes.q[b, p]
        qc = w.nodes.q[b, i]
        patch = fibre_patch(tree, touch, b, o, p, i, j, k, w.nodes.x, w.nodes.q, cx, cq)
        for n in range(POINTS):
            c = POINTS * pair + n
            s = point_place(patch, n)
            kn = point_stiffness(tree, o, i, j, patch, n, s)
            share = child_share(s)
            arm_p = wp.quat_rotate(qp, parent_offset(tree, o, p, i, j, s))
            arm_c = wp.quat_rotate(qc, child_offset(tree, o, p, i, j, s))
            y = (ONE - share) * (w.nodes.x[b, p] + arm_p) + share * (w.nodes.x[b, i] + arm_c)
            gap = capsule_gap(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
            depth = -gap.value
            force = normal_force(wp.max(depth, ZERO), kn)
            tau = mu * force
            pressed = pressed + force
            surface_p = arm_p
            surface_c = arm_c
            ft = vec3()
            if tau > ZERO:
                y0 = fibre_point(tree, b, o, p, i, j, s, w.nodes.x_start, w.nodes.q_start)
                gap0 = capsule_gap(y0, tree.radius[j], cx0, cq0, touch.half[k], touch.radius[k])
                lever = -tree.radius[j] * gap0.normal
                met = wp.quat_rotate_inv(cq0, y0 + lever - cx0)
                surface_p = arm_p + wp.quat_rotate(qp, wp.quat_rotate_inv(w.nodes.q_start[b, p], lever))
                surface_c = arm_c + wp.quat_rotate(qc, wp.quat_rotate_inv(w.nodes.q_start[b, i], lever))
                ys = (ONE - share) * (w.nodes.x[b, p] + surface_p) + share * (w.nodes.x[b, i] + surface_c)
                if w.contacts.stuck[side, b, c] == Stick.FREE:
                    start = w.contacts.gap_start[side, b, c]
                    free = start / wp.max(start - patch.gap, TINY)
                    w.contacts.stretch[side, b, c] = free * (met - wp.quat_rotate_inv(cq, ys - cx))
                    w.contacts.stuck[side, b, c] = Stick.NEW
                hold = cx + wp.quat_rotate(cq, met - w.contacts.stretch[side, b, c])
                slid = slip(gap.normal, ys, hold)
                ft = friction_force(slid, kn, tau)
                w.contacts.lever[side, b, c] = lever
                w.contacts.anchor[side, b, c] = hold
                w.contacts.slip[b, c] = slid
            elif w.contacts.stuck[side, b, c] == Stick.NEW:
                w.contacts.stuck[side, b, c] = Stick.FREE  # it lost contact again within the stride
            w.contacts.place[side, b, c] = s
            w.contacts.stiffness[side, b, c] = kn
            w.contacts.friction_limit[side, b, c] = tau
            w.contacts.normal[side, b, c] = gap.normal
            w.contacts.depth[side, b, c] = depth
            w.contacts.child_share[b, c] = share
            w.contacts.arm_parent[b, c] = arm_p
            w.contacts.arm_child[b, c] = arm_c
            w.contacts.surface_arm_parent[b, c] = surface_p
            w.contacts.surface_arm_child[b, c] = surface_c
            # An open contact has the force of a plane at the capsule's surface; only the model of the step uses it.
            push = wp.where(depth > ZERO, force, kn * depth)
            w.contacts.normal_gradient[b, c] = -push * gap.normal
            w.contacts.friction_gradient[b, c] = ft
            w.contacts.in_step[side, b, c] = wp.where(depth > ZERO, 1, 0)
    sync()
    return lane_sum(pressed)


@wp.func
def contact_energy(tree: Trees, touch: Touches, w: Work, me: Thread, side: int, x: wp.array2d(dtype=vec3),
                   q: wp.array2d(dtype=quat)):
    """This lane's share of the contact energy in the state (x, q) [J], with the points and limits of friction of
    `update_contacts`."""
    b = me.b
    o = me.o
    out = ZERO
    for pair in range(me.lane, w.contacts.count[side, b] / POINTS, me.lanes):
        i = w.contacts.node[side, b, POINTS * pair]
        k = w.contacts.capsule[side, b, POINTS * pair]
        j = w.contacts.fibre[side, b, POINTS * pair]
        p = tree.parent[o + i]
        cx = w.capsules.x[b, k]
        cq = w.capsules.q[b, k]
        patch = fibre_patch(tree, touch, b, o, p, i, j, k, x, q, cx, cq)
        for n in range(POINTS):
            c = POINTS * pair + n
            if patch.gap < ZERO:
                s = point_place(patch, n)
                y = fibre_point(tree, b, o, p, i, j, s, x, q)
                gap = capsule_gap(y, tree.radius[j], cx, cq, touch.half[k], touch.radius[k])
                out = out + normal_energy(wp.max(-gap.value, ZERO), point_stiffness(tree, o, i, j, patch, n, s))
            tau = w.contacts.friction_limit[side, b, c]
            if tau > ZERO:
                ys = surface_point(tree, w, b, o, p, i, j, w.contacts.place[side, b, c],
                                   w.contacts.lever[side, b, c], x, q)
                u = slip(w.contacts.normal[side, b, c], ys, w.contacts.anchor[side, b, c])
                out = out + friction.energy(wp.length(u), w.contacts.stiffness[side, b, c], tau)
    return out


@wp.func
def assemble(tree: Trees, touch: Touches, w: Work, me: Thread, count: int, side: int, geometric: real):
    """The gradient, and the blocks of the elastic energy. Returns the number of slipping points."""
    b = me.b
    o = me.o
    slipping = int(0)
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        p = tree.parent[o + i]
        s = segment_strain(tree, b, o, p, i, w.nodes.x, w.nodes.q)
        mu = segment_moment(tree, w, b, o, i, s)
        f, mc, mp = gradient(s, tree.kd[o + i], mu)
        w.system.elastic_gradient[b, i] = spatial(f - tree.load[o + i], mc)
        w.system.elastic_gradient_parent[b, i] = spatial(-f, mp)
        w.segments.frame[b, i] = s.turn
        w.segments.span[b, i] = s.D
        w.segments.half_rotation[b, i] = s.g
        h = hessian(s, tree.kd[o + i], mu, segment_tangent(tree, w, b, o, i, s), geometric)
        w.system.elastic_block[b, i] = h.child
        w.system.elastic_block_parent[b, i] = h.parent
        w.system.elastic_coupling[b, i] = h.mixed
        on = vec6()
        up = vec6()
        for c in range(w.segments.first_contact[b, i], w.segments.first_contact[b, i] + w.segments.contact_count[b, i]):
            if w.contacts.in_step[side, b, c] == 1:
                al = w.contacts.child_share[b, c]
                fn = w.contacts.normal_gradient[b, c]
                ft = w.contacts.friction_gradient[b, c]
                moment = wp.cross(w.contacts.arm_parent[b, c], fn) + wp.cross(w.contacts.surface_arm_parent[b, c], ft)
                up = up + (ONE - al) * spatial(fn + ft, moment)
                moment = wp.cross(w.contacts.arm_child[b, c], fn) + wp.cross(w.contacts.surface_arm_child[b, c], ft)
                on = on + al * spatial(fn + ft, moment)
                tau = w.contacts.friction_limit[side, b, c]
                if tau > ZERO and w.contacts.stiffness[side, b, c] * wp.length(w.contacts.slip[b, c]) > tau:
                    slipping = slipping + 1
        w.system.contact_gradient_child[b, i] = on
        w.system.contact_gradient_parent[b, i] = up
    sync()
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        elastic = w.system.elastic_gradient[b, i]
        g = w.system.contact_gradient_child[b, i]
        own = w.system.elastic_block[b, i]
        kid = tree.child[o + i]
        while kid >= 0:
            if w.nodes.active[b, kid] == 1:
                elastic = elastic + w.system.elastic_gradient_parent[b, kid]
                g = g + w.system.contact_gradient_parent[b, kid]
                own = own + w.system.elastic_block_parent[b, kid]
            kid = tree.next[o + kid]
        w.system.elastic_gradient[b, i] = elastic
        w.system.gradient[b, i] = elastic + g
        w.system.elastic_block[b, i] = own
    sync()
    return lane_count(slipping)


@wp.func
def contact_hessians(tree: Trees, touch: Touches, w: Work, me: Thread, count: int, side: int, geometric: real,
                     coulomb: int):
    """Second derivatives of the contacts; marks the whole model as stale. An open contact is a plane with the penalty's
    stiffness. With ``coulomb`` the friction limit follows the normal force."""
    b = me.b
    for a in range(1 + me.lane, count, me.lanes):
        w.system.stale[b, w.nodes.order[b, a]] = Stale.CONTACTS
    for c in range(me.lane, w.contacts.count[side, b], me.lanes):
        i = w.contacts.node[side, b, c]
        k = w.contacts.capsule[side, b, c]
        j = w.contacts.fibre[side, b, c]
        p = tree.parent[me.o + i]
        al = w.contacts.child_share[b, c]
        kn = w.contacts.stiffness[side, b, c]
        n = w.contacts.normal[side, b, c]
        depth = w.contacts.depth[side, b, c]
        tau = w.contacts.friction_limit[side, b, c]
        hn = kn * wp.outer(n, n)
        ht = mat33()
        hc = mat33()
        if depth > ZERO:
            arm_p = w.contacts.arm_parent[b, c]
            y = (ONE - al) * (w.nodes.x[b, p] + arm_p) + al * (w.nodes.x[b, i] + w.contacts.arm_child[b, c])
            gap = capsule_gap(y, tree.radius[j], w.capsules.x[b, k], w.capsules.q[b, k], touch.half[k], touch.radius[k])
            hn = normal_hessian(gap, kn, geometric)
            if tau > ZERO:
                u = w.contacts.slip[b, c]
                size = wp.length(u)
                ht = friction_hessian(u, n, kn, tau)
                if coulomb == 1 and kn * size > tau:
                    hc = (-touch.friction[b] * normal_stiffness(depth, kn) / size) * wp.outer(u, n)
        w.contacts.normal_hessian[b, c] = hn
        w.contacts.friction_hessian[b, c] = ht
        w.contacts.coulomb_hessian[b, c] = hc
    sync()


@wp.func
def assemble_step(tree: Trees, w: Work, me: Thread, count: int, side: int, geometric: real, coulomb: int):
    """Blocks and right-hand side of the step where they are stale, from the elastic energy and the contacts that take
    part."""
    b = me.b
    o = me.o
    # one item for each of the four blocks of a segment: there are few segments with contacts and many lanes
    for item in range(4 + me.lane, 4 * count, me.lanes):
        i = w.nodes.order[b, item / 4]
        if w.system.stale[b, i] < Stale.CONTACTS or w.segments.contact_count[b, i] == 0:
            continue
        block = item % 4
        if block == PARENT_CHILD and coulomb == 0:
            continue
        own = mat66()
        if block == CHILD_PARENT:
            own = w.system.elastic_coupling[b, i]
        if block == PARENT_CHILD:
            own = wp.transpose(w.system.elastic_coupling[b, i])
        right = vec6()
        for c in range(w.segments.first_contact[b, i], w.segments.first_contact[b, i] + w.segments.contact_count[b, i]):
            if w.contacts.in_step[side, b, c] == 1:
                al = w.contacts.child_share[b, c]
                fn = w.contacts.normal_gradient[b, c]
                ft = w.contacts.friction_gradient[b, c]
                row = al
                ra = w.contacts.arm_child[b, c]
                rr = w.contacts.surface_arm_child[b, c]
                if block == PARENT or block == PARENT_CHILD:
                    row = ONE - al
                    ra = w.contacts.arm_parent[b, c]
                    rr = w.contacts.surface_arm_parent[b, c]
                column = al
                ca = w.contacts.arm_child[b, c]
                cr = w.contacts.surface_arm_child[b, c]
                if block == PARENT or block == CHILD_PARENT:
                    column = ONE - al
                    ca = w.contacts.arm_parent[b, c]
                    cr = w.contacts.surface_arm_parent[b, c]
                own = plus_point(own, w.contacts.normal_hessian[b, c], ra, ca, row * column)
                if w.contacts.friction_limit[side, b, c] > ZERO:
                    own = plus_point(own, w.contacts.friction_hessian[b, c], rr, cr, row * column)
                    if coulomb == 1:
                        own = plus_point(own, w.contacts.coulomb_hessian[b, c], rr, ca, row * column)
                if block == CHILD or block == PARENT:
                    right = right - row * spatial(fn + ft, wp.cross(ra, fn) + wp.cross(rr, ft))
                    if geometric > ZERO and w.contacts.depth[side, b, c] > ZERO:
                        own = plus_spin(own, turn_hessian(fn, ra), row)
                        own = plus_spin(own, turn_hessian(ft, rr), row)
        if block == CHILD:
            w.system.contact_block_child[b, i] = own
            w.system.contact_rhs_child[b, i] = right
        if block == PARENT:
            w.system.contact_block_parent[b, i] = own
            w.system.contact_rhs_parent[b, i] = right
        if block == CHILD_PARENT:
            w.system.child_parent[b, i] = own
        if block == PARENT_CHILD:
            w.system.parent_child[b, i] = own
    sync()
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        if w.system.stale[b, i] == Stale.NO:
            continue
        diagonal = w.system.elastic_block[b, i]
        right = -w.system.elastic_gradient[b, i]
        if w.segments.contact_count[b, i] > 0:
            diagonal = diagonal + w.system.contact_block_child[b, i]
            right = right + w.system.contact_rhs_child[b, i]
        elif w.system.stale[b, i] == Stale.CONTACTS:
            w.system.child_parent[b, i] = w.system.elastic_coupling[b, i]
            if coulomb == 1:
                w.system.parent_child[b, i] = wp.transpose(w.system.elastic_coupling[b, i])
        kid = tree.child[o + i]
        while kid >= 0:
            if w.nodes.active[b, kid] == 1 and w.segments.contact_count[b, kid] > 0:
                diagonal = diagonal + w.system.contact_block_parent[b, kid]
                right = right + w.system.contact_rhs_parent[b, kid]
            kid = tree.next[o + kid]
        w.system.diagonal[b, i] = diagonal
        w.system.rhs[b, i] = right
    sync()


@wp.func
def predict_contacts(tree: Trees, w: Work, me: Thread, levels: int, count: int, side: int):
    """Predicts from the step which contacts will press, takes these into the model of the step, and marks what of it is
    stale then. Returns the number of contacts that changed."""
    b = me.b
    changed = int(0)
    for a in range(1 + me.lane, count, me.lanes):
        w.system.stale[b, w.nodes.order[b, a]] = Stale.NO
    sync()
    for c in range(me.lane, w.contacts.count[side, b], me.lanes):
        i = w.contacts.node[side, b, c]
        sp = w.system.step[b, tree.parent[me.o + i]]
        sc = w.system.step[b, i]
        al = w.contacts.child_share[b, c]
        way = (ONE - al) * (wp.spatial_top(sp) + wp.cross(wp.spatial_bottom(sp), w.contacts.arm_parent[b, c]))
        way = way + al * (wp.spatial_top(sc) + wp.cross(wp.spatial_bottom(sc), w.contacts.arm_child[b, c]))
        on = int(0)
        if w.contacts.depth[side, b, c] - wp.dot(w.contacts.normal[side, b, c], way) > ZERO:
            on = 1
        if on != w.contacts.in_step[side, b, c]:
            w.contacts.in_step[side, b, c] = on
            w.system.stale[b, i] = Stale.CONTACTS
            changed = changed + 1
    sync()
    changed = lane_count(changed)
    if changed > 0:
        for back in range(1, levels):
            d = levels - back
            for a in range(w.nodes.level[b, d] + me.lane, w.nodes.level[b, d + 1], me.lanes):
                i = w.nodes.order[b, a]
                stale = w.system.stale[b, i]
                kid = tree.child[me.o + i]
                while kid >= 0:
                    if w.nodes.active[b, kid] == 1 and w.system.stale[b, kid] > Stale.NO:
                        stale = wp.max(stale, Stale.BELOW)
                    kid = tree.next[me.o + kid]
                w.system.stale[b, i] = stale
            sync()
    return changed


@wp.func
def unbalanced_force(tree: Trees, w: Work, me: Thread, count: int):
    """Sum of the norms of the unbalanced forces, and of the moments over the length of the segment [N]."""
    out = ZERO
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[me.b, a]
        g = w.system.gradient[me.b, i]
        out = out + wp.length(wp.spatial_top(g)) + wp.length(wp.spatial_bottom(g)) / tree.length[me.o + i]
    return lane_sum(out)
