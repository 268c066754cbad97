"""Gradient and second derivative of the potential at a state, and the quadratic model that a Newton step minimises.

Contacts and segments are computed one by one, and a node gathers from its own segment and its children's: no two lanes
add to the same number.
"""

import warp as wp

from vsfsim.physics.contact import friction
from vsfsim.physics.rods.kernels import contact_law, fibre, segment
from vsfsim.physics.rods.kernels.contact_law import plus_point, plus_spin
from vsfsim.physics.rods.kernels.elimination import CHILD, CHILD_PARENT, PARENT, PARENT_CHILD
from vsfsim.physics.rods.kernels.fibre import POINTS
from vsfsim.physics.rods.kernels.lanes import lane_count, lane_sum, sync
from vsfsim.physics.rods.kernels.segment import TINY, ZERO, real
from vsfsim.physics.rods.structs import Contact, State, Stick, Thread, Touches, Trees, Work


@wp.func
def update_contacts(tree: Trees, touch: Touches, w: Work, me: Thread, side: int):
    """Patches, friction limits, normals, anchors, levers and forces of all contacts at the present state. Returns the
    sum of the normal forces [N]."""
    b = me.b
    total = ZERO
    for pair in range(me.lane, w.count[side, b] / POINTS, me.lanes):
        first = w.contacts[side, b, POINTS * pair]
        k = first.capsule
        cx = w.capsules.x[b, k]
        cq = w.capsules.q[b, k]
        cx0 = w.capsules_start.x[b, k]
        cq0 = w.capsules_start.q[b, k]
        patch = fibre.fibre_patch(tree, touch, me, first.node, first.fibre, k, w.now, w.capsules)
        for n in range(POINTS):
            at = w.contacts[side, b, POINTS * pair + n]
            at.place = fibre.point_place(patch, n)
            at.stiffness = fibre.point_stiffness(tree, me, at, patch, n)
            at = fibre.pressed(tree, touch, me, at, w.now, w.capsules)
            force = contact_law.normal_force(wp.max(-at.gap.value, ZERO), at.stiffness)
            at.friction_limit = touch.friction[b] * force
            total = total + force
            if at.friction_limit > ZERO:
                y0, _arm_p, _arm_c = fibre.material_point(tree, me, at.node, at.fibre, at.place, w.start)
                begun = contact_law.capsule_gap(y0, tree.radius[at.fibre], cx0, cq0, touch.half[k], touch.radius[k])
                at.lever = -tree.radius[at.fibre] * begun.normal
                met = wp.quat_rotate_inv(cq0, y0 + at.lever - cx0)
                if at.memory.stuck == Stick.FREE:
                    ys, _surface_p, _surface_c = fibre.surface_point(tree, w, me, at, w.now)
                    free = at.gap_start / wp.max(at.gap_start - patch.gap, TINY)
                    at.memory.stretch = free * (met - wp.quat_rotate_inv(cq, ys - cx))
                    at.memory.stuck = int(Stick.NEW)
                at.anchor = cx + wp.quat_rotate(cq, met - at.memory.stretch)
                at = fibre.rubbed(tree, w, me, at, w.now)
            elif at.memory.stuck == Stick.NEW:
                at.memory.stuck = int(Stick.FREE)  # it lost contact again within the stride
            w.contacts[side, b, POINTS * pair + n] = at
    sync()
    return lane_sum(total)


@wp.func
def contact_energy(tree: Trees, touch: Touches, w: Work, me: Thread, side: int, now: State):
    """This lane's share of the contact energy in a state [J], with the points and limits of friction of
    `update_contacts`."""
    b = me.b
    out = ZERO
    for pair in range(me.lane, w.count[side, b] / POINTS, me.lanes):
        first = w.contacts[side, b, POINTS * pair]
        patch = fibre.fibre_patch(tree, touch, me, first.node, first.fibre, first.capsule, now, w.capsules)
        for n in range(POINTS):
            at = w.contacts[side, b, POINTS * pair + n]
            if patch.gap < ZERO:
                there = at
                there.place = fibre.point_place(patch, n)
                there.stiffness = fibre.point_stiffness(tree, me, there, patch, n)
                there = fibre.pressed(tree, touch, me, there, now, w.capsules)
                out = out + contact_law.normal_energy(wp.max(-there.gap.value, ZERO), there.stiffness)
            if at.friction_limit > ZERO:
                rubbing = fibre.rubbed(tree, w, me, at, now)
                out = out + friction.energy(wp.length(rubbing.slip), at.stiffness, at.friction_limit)
    return out


@wp.func
def slips(at: Contact):
    return at.friction_limit > ZERO and at.stiffness * wp.length(at.slip) > at.friction_limit


@wp.func
def assemble(tree: Trees, w: Work, me: Thread, count: int, side: int, geometric: real):
    """The gradient at each node, and the second derivative of each segment's elastic energy. Returns the number of
    slipping points."""
    b = me.b
    o = me.o
    slipping = int(0)
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        s = fibre.segment_strain(tree, me, i, w.now)
        kphi = tree.kphi[o + i]
        wire = tree.wire[o + i]
        mu = segment.moment(s, kphi, wire, w.nodes.plastic[b, i])
        f, mc, mp = segment.gradient(s, tree.kd[o + i], mu)
        w.segments.strain[b, i] = s
        bend = segment.moment_tangent(s, kphi, wire, w.nodes.plastic[b, i])
        by_child, by_parent, mixed = segment.hessian(s, tree.kd[o + i], mu, bend, geometric)
        w.system.blocks[b, i, CHILD] = by_child
        w.system.blocks[b, i, PARENT] = by_parent
        w.system.blocks[b, i, CHILD_PARENT] = mixed
        w.system.blocks[b, i, PARENT_CHILD] = wp.transpose(mixed)
        on = segment.spatial(f - tree.load[o + i], mc)
        up = segment.spatial(-f, mp)
        for c in range(w.segments.first_contact[b, i], w.segments.first_contact[b, i] + w.segments.contact_count[b, i]):
            at = w.contacts[side, b, c]
            if at.gap.value < ZERO:
                up = up + fibre.end_force(at, at.parent)
                on = on + fibre.end_force(at, at.child)
                if slips(at):
                    slipping = slipping + 1
        w.system.gradient[b, i] = on
        w.system.gradient_parent[b, i] = up
    sync()
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        g = w.system.gradient[b, i]
        kid = tree.child[o + i]
        while kid >= 0:
            if w.nodes.active[b, kid] == 1:
                g = g + w.system.gradient_parent[b, kid]
            kid = tree.next[o + kid]
        w.system.gradient[b, i] = g
    sync()
    return lane_count(slipping)


@wp.func
def assemble_step(tree: Trees, touch: Touches, w: Work, me: Thread, count: int, side: int, geometric: real,
                  coulomb: int):
    """The matrix of the step, from the elastic energy and the contacts that press. With ``coulomb`` the friction limit
    follows the normal force."""
    b = me.b
    o = me.o
    # one item for each of the four blocks of a segment: there are few segments with contacts and many lanes
    for item in range(4 + me.lane, 4 * count, me.lanes):
        i = w.nodes.order[b, item / 4]
        block = item % 4
        if w.segments.contact_count[b, i] == 0 or (block == PARENT_CHILD and coulomb == 0):
            continue
        own = w.system.blocks[b, i, block]
        for c in range(w.segments.first_contact[b, i], w.segments.first_contact[b, i] + w.segments.contact_count[b, i]):
            at = w.contacts[side, b, c]
            if at.gap.value < ZERO:
                row = wp.where(block == PARENT or block == PARENT_CHILD, at.parent, at.child)
                column = wp.where(block == PARENT or block == CHILD_PARENT, at.parent, at.child)
                share = row.share * column.share
                press = contact_law.normal_hessian(at.gap, at.stiffness, geometric)
                own = plus_point(own, press, row.arm, column.arm, share)
                if at.friction_limit > ZERO:
                    u, v = friction.hessian_roots(at.slip, at.gap.normal, at.stiffness, at.friction_limit)
                    own = plus_point(own, wp.outer(u, u) + wp.outer(v, v), row.surface, column.surface, share)
                    if coulomb == 1 and slips(at):
                        # the friction force follows its limit, the normal force
                        normal = contact_law.normal_stiffness(-at.gap.value, at.stiffness)
                        bend = touch.friction[b] * normal / wp.length(at.slip)
                        own = plus_point(own, -bend * wp.outer(at.slip, at.gap.normal), row.surface, column.arm, share)
                if geometric > ZERO and (block == CHILD or block == PARENT):
                    own = plus_spin(own, contact_law.turn_hessian(at.normal_gradient, row.arm), row.share)
                    own = plus_spin(own, contact_law.turn_hessian(at.friction_gradient, row.surface), row.share)
        w.system.blocks[b, i, block] = own
    sync()
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[b, a]
        diagonal = w.system.blocks[b, i, CHILD]
        kid = tree.child[o + i]
        while kid >= 0:
            if w.nodes.active[b, kid] == 1:
                diagonal = diagonal + w.system.blocks[b, kid, PARENT]
            kid = tree.next[o + kid]
        w.system.blocks[b, i, CHILD] = diagonal
    sync()


@wp.func
def unbalanced_force(tree: Trees, w: Work, me: Thread, count: int):
    """Sum of the norms of the unbalanced forces, and of the moments over the length of the segment [N]."""
    out = ZERO
    for a in range(1 + me.lane, count, me.lanes):
        i = w.nodes.order[me.b, a]
        g = w.system.gradient[me.b, i]
        out = out + wp.length(wp.spatial_top(g)) + wp.length(wp.spatial_bottom(g)) / tree.length[me.o + i]
    return lane_sum(out)
