"""The fibres of a segment as smooth curves, the part of a fibre that touches a capsule, and contacts there in a state
of the nodes.

    y(s) = (1 - w) (xp + Rp (b + L s / (1 + 2 s) e)) + w (xc + Rc (b - L (1 - s) / (3 - 2 s) e)),   w = s^2 (3 - 2 s)

is the cubic Hermite curve through two nodes with the tangents L Rp e and L Rc e, s from 0 to 1, b the fibre's offset
from the middle line, e the direction of the segment and L its length, all at rest. It is the deflection of an
Euler-Bernoulli beam that is loaded at its nodes, and neighbours of the same direction at rest join without a kink.

In the frame of a capsule the curve is a cubic polynomial. The distance to the capsule's axis is a convex function of
space, so the points of a straight fibre inside a capsule are one interval; of a curved one, the interval from the first
to the last is taken. Its ends are found by Laguerre's method, which is exact for a straight fibre beside the capsule's
shaft.

``i`` is a segment, counted within the plant, ``j`` a fibre of it and ``k`` a capsule.
"""

import warp as wp

from vsfsim.physics.contact import friction
from vsfsim.physics.rods.kernels.contact_law import capsule_gap, normal_force
from vsfsim.physics.rods.kernels.segment import HALF, ONE, TINY, ZERO, real, spatial, strain, vec3
from vsfsim.physics.rods.structs import Contact, End, State, Thread, Touches, Trees, Work, struct

POINTS = wp.constant(3)  # Gauss points of a patch: exact for the energy of a parabola's overlap, of degree 4
GRID = wp.constant(4)  # intervals of a segment in which its closest point is searched
GRID_STEP = wp.constant(wp.float64(0.25))
STEPS = wp.constant(8)  # of a search of a point
CLOSE = wp.constant(wp.float64(1e-10))  # of a place, where a search ends [-]
# Length of branch whose contact is as stiff as `Trees.softness` says, and of the patches of open contacts [m].
CONTACT_LENGTH = wp.constant(wp.float64(0.002))


# A fibre in the frame of a capsule, y(s) = a + b s + c s^2 + d s^3.
Fibre = struct(
    "Fibre",
    a="vec3d -  coefficient of degree 0 [m]",
    b="vec3d -  coefficient of degree 1 [m]",
    c="vec3d -  coefficient of degree 2 [m]",
    d="vec3d -  coefficient of degree 3 [m]")

# The part of a fibre that touches a capsule; of an open contact, a part of the length `CONTACT_LENGTH` around its
# closest point.
Patch = struct(
    "Patch",
    low="float64 -  its first place [-]",
    high="float64 -  its last place [-]",
    gap="float64 -  least distance of the fibre's surface from the capsule, negative inside [m]")


@wp.func
def child_share(s: real):
    """w, the share of the child's node in a point at the place ``s``; the rest is the parent's."""
    return s * s * (real(3.0) - real(2.0) * s)


@wp.func
def material_point(tree: Trees, me: Thread, i: int, j: int, s: real, now: State):
    """World position of the material point at the place ``s`` of fibre ``j`` of segment ``i`` in a state [m], and the
    levers to it from the parent's node and from the child's [m]."""
    p = tree.parent[me.o + i]
    way = tree.rest[me.o + i] - tree.rest[me.o + p]
    arm_p = wp.quat_rotate(now.q[me.b, p], tree.offset[j] + (s / (ONE + real(2.0) * s)) * way)
    arm_c = wp.quat_rotate(now.q[me.b, i], tree.offset[j] - ((ONE - s) / (real(3.0) - real(2.0) * s)) * way)
    w = child_share(s)
    return (ONE - w) * (now.x[me.b, p] + arm_p) + w * (now.x[me.b, i] + arm_c), arm_p, arm_c


@wp.func
def fibre_in_capsule(tree: Trees, me: Thread, i: int, j: int, k: int, now: State, capsules: State):
    """Fibre ``j`` of segment ``i`` in the frame of capsule ``k``."""
    p = tree.parent[me.o + i]
    way = tree.rest[me.o + i] - tree.rest[me.o + p]
    cx = capsules.x[me.b, k]
    cq = capsules.q[me.b, k]
    qp = now.q[me.b, p]
    qc = now.q[me.b, i]
    first = wp.quat_rotate_inv(cq, now.x[me.b, p] + wp.quat_rotate(qp, tree.offset[j]) - cx)
    last = wp.quat_rotate_inv(cq, now.x[me.b, i] + wp.quat_rotate(qc, tree.offset[j]) - cx)
    leave = wp.quat_rotate_inv(cq, wp.quat_rotate(qp, way))
    come = wp.quat_rotate_inv(cq, wp.quat_rotate(qc, way))
    f = Fibre()
    f.a = first
    f.b = leave
    f.c = real(3.0) * (last - first) - real(2.0) * leave - come
    f.d = real(2.0) * (first - last) + leave + come
    return f


@wp.func
def half_square(f: Fibre, s: real, half: real):
    """Half the squared distance of the place ``s`` from a capsule's axis [m^2], and its first two derivatives."""
    y = f.a + s * (f.b + s * (f.c + s * f.d))
    v = f.b + s * (real(2.0) * f.c + (real(3.0) * s) * f.d)
    u = real(2.0) * f.c + (real(6.0) * s) * f.d
    z = y[2] - wp.clamp(y[2], -half, half)
    bend = v[0] * v[0] + v[1] * v[1]
    if z != ZERO:
        bend = bend + v[2] * v[2]
    slope = y[0] * v[0] + y[1] * v[1] + z * v[2]
    bend = bend + y[0] * u[0] + y[1] * u[1] + z * u[2]
    return HALF * (y[0] * y[0] + y[1] * y[1] + z * z), slope, bend


@wp.func
def patch_end(f: Fibre, half: real, level: real, outer: real, inner: real):
    """The place between ``outer`` and ``inner`` where half the squared distance from the axis is ``level``."""
    low = wp.min(outer, inner)
    high = wp.max(outer, inner)
    s = outer
    for _step in range(STEPS):
        value, slope, bend = half_square(f, s, half)
        over = value - level
        root = wp.sqrt(wp.max(slope * slope - real(2.0) * over * bend, ZERO))
        # the root of the parabola on the side of `inner`
        step = real(2.0) * over / wp.max(wp.abs(slope) + root, TINY * TINY)
        if inner < outer:
            step = -step
        after = wp.clamp(s + step, low, high)
        moved = wp.abs(after - s)
        s = after
        if moved < CLOSE:
            break
    return s


@wp.func
def closest_place(f: Fibre, half: real, best: int):
    """The closest place to the axis, next to number ``best`` of the grid, which is closest of the grid: Newton's
    method, with bisection where it leaves the interval."""
    step = GRID_STEP
    at = step * real(best)
    _value, slope, bend = half_square(f, at, half)
    if (best == 0 and slope >= ZERO) or (best == GRID and slope <= ZERO):
        return at
    low = at
    high = at
    if slope > ZERO:
        low = at - step
    else:
        high = at + step
    for _step in range(STEPS):
        after = HALF * (low + high)
        if bend > ZERO:
            newton = at - slope / bend
            if newton >= low and newton <= high:
                after = newton
        moved = wp.abs(after - at)
        at = after
        if moved < CLOSE:
            break
        _value, slope, bend = half_square(f, at, half)
        if slope > ZERO:
            high = at
        else:
            low = at
    return at


@wp.func(inline=False)
def touching_patch(f: Fibre, tip: int, half: real, reach: real, length: real):
    """The patch of a fibre of the rest length ``length`` beside a capsule of the half length ``half``, ``reach`` the
    sum of both radii. Of a ``tip`` it is the end of the fibre."""
    out = Patch()
    out.low = ONE
    out.high = ONE
    if tip == 1:
        value, _slope, _bend = half_square(f, ONE, half)
        out.gap = wp.sqrt(real(2.0) * value) - reach
        return out
    level = HALF * reach * reach
    step = GRID_STEP
    best = int(0)
    first = GRID + int(1)  # the first and the last place of the grid inside the capsule
    last = int(-1)
    least = real(1e30)
    for n in range(GRID + 1):
        value, _slope, _bend = half_square(f, step * real(n), half)
        if value < least:
            least = value
            best = n
        if value < level:
            first = wp.min(first, n)
            last = n
    at = closest_place(f, half, best)
    value, _slope, _bend = half_square(f, at, half)
    if value > least:
        at = step * real(best)
        value = least
    out.gap = wp.sqrt(real(2.0) * value) - reach
    if value < level:
        if last < 0:
            last = int(wp.floor(at / step))
            first = last + 1
        out.low = ZERO
        if first > 0:
            out.low = patch_end(f, half, level, step * real(first - 1), wp.min(at, step * real(first)))
        if last < GRID:
            out.high = patch_end(f, half, level, step * real(last + 1), wp.max(at, step * real(last)))
    else:
        reference = HALF * CONTACT_LENGTH / length
        out.low = wp.max(at - reference, ZERO)
        out.high = wp.min(at + reference, ONE)
    return out


@wp.func
def point_place(patch: Patch, n: int):
    """Place of Gauss point ``n`` of a patch."""
    return HALF * (patch.low + patch.high) + real(0.3872983346207417) * real(n - 1) * (patch.high - patch.low)


@wp.func
def point_stiffness(tree: Trees, me: Thread, at: Contact, patch: Patch, n: int):
    """Penalty of Gauss point ``n``: that of its length of branch [N/m]."""
    ends = tree.softness[at.fibre]
    soft = ends[0] + at.place * (ends[1] - ends[0])
    length = tree.length[me.o + at.node] * (patch.high - patch.low)
    if tree.tip[at.fibre] == 1:
        length = CONTACT_LENGTH
    weight = wp.where(n == 1, real(4.0 / 9.0), real(5.0 / 18.0))
    return weight * length / (CONTACT_LENGTH * soft * soft * soft)


@wp.func
def segment_strain(tree: Trees, me: Thread, i: int, now: State):
    """Strains of a segment."""
    p = tree.parent[me.o + i]
    return strain(now.x[me.b, p], now.q[me.b, p], now.x[me.b, i], now.q[me.b, i], tree.frame[me.o + i],
                  tree.length[me.o + i])


@wp.func
def fibre_patch(tree: Trees, touch: Touches, me: Thread, i: int, j: int, k: int, now: State, capsules: State):
    """The patch of a fibre beside a capsule."""
    f = fibre_in_capsule(tree, me, i, j, k, now, capsules)
    return touching_patch(f, tree.tip[j], touch.half[k], touch.radius[k] + tree.radius[j], tree.length[me.o + i])


@wp.func
def pressed(tree: Trees, touch: Touches, me: Thread, at: Contact, now: State, capsules: State):
    """The contact with the levers, gap and normal force that its place has in a state."""
    k = at.capsule
    y, arm_p, arm_c = material_point(tree, me, at.node, at.fibre, at.place, now)
    share = child_share(at.place)
    at.point = y
    at.surface = y
    at.parent.share = ONE - share
    at.child.share = share
    at.parent.arm = arm_p
    at.child.arm = arm_c
    at.parent.surface = arm_p
    at.child.surface = arm_c
    at.gap = capsule_gap(y, tree.radius[at.fibre], capsules.x[me.b, k], capsules.q[me.b, k], touch.half[k],
                         touch.radius[k])
    # An open contact has the force of a plane at the capsule's surface; only the model of the step uses it.
    push = -at.stiffness * at.gap.value
    if at.gap.value < ZERO:
        push = normal_force(-at.gap.value, at.stiffness)
    at.normal_gradient = -push * at.gap.normal
    at.friction_gradient = vec3()
    return at


@wp.func
def surface_point(tree: Trees, w: Work, me: Thread, at: Contact, now: State):
    """World position of the point on the branch's surface that was ``at.lever`` away from the fibre at the start of the
    stride [m], and the levers to it from the parent's node and from the child's, which both carry it along [m]."""
    i = at.node
    p = tree.parent[me.o + i]
    y, arm_p, arm_c = material_point(tree, me, i, at.fibre, at.place, now)
    lp = wp.quat_rotate(now.q[me.b, p], wp.quat_rotate_inv(w.start.q[me.b, p], at.lever))
    lc = wp.quat_rotate(now.q[me.b, i], wp.quat_rotate_inv(w.start.q[me.b, i], at.lever))
    share = child_share(at.place)
    return y + (ONE - share) * lp + share * lc, arm_p + lp, arm_c + lc


@wp.func
def rubbed(tree: Trees, w: Work, me: Thread, at: Contact, now: State):
    """The contact with the levers, slip and friction force of its surface point in a state."""
    y, arm_p, arm_c = surface_point(tree, w, me, at, now)
    at.surface = y
    at.parent.surface = arm_p
    at.child.surface = arm_c
    at.slip = friction.tangential(y - at.anchor, at.gap.normal)
    at.friction_gradient = friction.force(at.slip, at.stiffness, at.friction_limit)
    return at


@wp.func
def end_force(at: Contact, end: End):
    """Derivative of the energy of a contact by the node at one end of its segment [N, N m]."""
    moment = wp.cross(end.arm, at.normal_gradient) + wp.cross(end.surface, at.friction_gradient)
    return end.share * spatial(at.normal_gradient + at.friction_gradient, moment)
