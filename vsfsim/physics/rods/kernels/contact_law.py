"""Contact of the fibres of a plant with rigid capsules: gap, penalty, and Coulomb friction with memory.

    Pi_n = int k/l p^2 (1/2 + p / (3 h)) ds,   p = <-gap>,   gap = |y - nearest point of the capsule's axis| - R - r
    Pi_t as in `contact.friction`, of the stiffness k

y is a material point of a fibre (`fibre`), r the radius of the branch around it, k / l the penalty of a length of
branch. The integral is over the patch of the fibre inside the capsule, by three Gauss points. The patch follows the
state; as p is zero at its ends, force and stiffness are the sums of those of its points, as if these were fixed. So a
capsule that slides along a smooth branch without friction meets no resistance but that of the branch's slope. The
penalty hardens at h = 1 mm: soft leaves may have a soft penalty, which Newton's method needs, and a capsule still does
not pass through them.

Friction acts on the surface, at y_s = y - r n; the nodes carry the n of the start of the stride along, so a branch may
roll. tau = mu dPi_n/dp is updated in every Newton iteration and is constant during its line search (a sequence of
Tresca problems), as are the points. u_t is the elastic part of the tangential displacement that the point had at the
start of the stride, plus that of y_s over the capsule since then: a point of the patch is followed by its number, while
the patch may move along the branch. Of a new contact only the displacement counts that is left of the straight path of
its point when it meets the capsule, by the first iterate that is inside.
"""

import warp as wp

from vsfsim.physics.rods.kernels.segment import HALF, ONE, ZERO, quat, real, vec3
from vsfsim.physics.rods.structs import Gap

NEAR = wp.constant(wp.float64(1e-12))  # distance from the axis below which the normal is arbitrary [m]
HARD = wp.constant(wp.float64(1e-3))  # h, the penetration at which the penalty hardens [m]


@wp.func
def capsule_gap(y: vec3, r: real, cx: vec3, cq: quat, half: real, radius: real):
    local = wp.quat_rotate_inv(cq, y - cx)
    z = wp.clamp(local[2], -half, half)
    out = vec3(local[0], local[1], local[2] - z)
    away = wp.length(out)
    n = vec3(ONE, ZERO, ZERO)  # on the axis itself every normal is as good
    if away > NEAR:
        n = out / away
    g = Gap()
    g.value = away - radius - r
    g.normal = wp.quat_rotate(cq, n)
    g.away = away
    g.axis = vec3(ZERO, ZERO, ZERO)
    if wp.abs(local[2]) < half:
        g.axis = wp.quat_rotate(cq, vec3(ZERO, ZERO, ONE))
    return g


@wp.func
def normal_energy(p: real, k: real):
    return k * p * p * (HALF + p / (real(3.0) * HARD))


@wp.func
def normal_force(p: real, k: real):
    """Normal force at a penetration p >= 0 [N]."""
    return k * p * (ONE + p / HARD)


@wp.func
def normal_stiffness(p: real, k: real):
    return k * (ONE + real(2.0) * p / HARD)


@wp.func
def normal_hessian(g: Gap, k: real, geometric: real):
    """Second derivative of Pi_n by y; ``geometric`` 0 leaves out the curvature of the capsule, which lowers it."""
    eye = wp.identity(n=3, dtype=real)
    nn = wp.outer(g.normal, g.normal)
    bend = eye - nn - wp.outer(g.axis, g.axis)
    return normal_stiffness(-g.value, k) * nn - (geometric * normal_force(-g.value, k) / wp.max(g.away, NEAR)) * bend


@wp.func
def turn_hessian(f: vec3, lever: vec3):
    """Second derivative of f . (R b) by the spin of R, lever = R b."""
    return HALF * (wp.outer(f, lever) + wp.outer(lever, f)) - wp.dot(f, lever) * wp.identity(n=3, dtype=real)


@wp.func_native(snippet="""
    // J_r^T h J_c with J = (I, -[lever]) for a point that moves with a node: rows (h; [r] h), columns (. , -. [c])
    wp::mat_t<6, 6, double> out = to;
    double top[3][6];
    for (int i = 0; i < 3; ++i) {
        const double a = weight * h.data[i][0], b = weight * h.data[i][1], c = weight * h.data[i][2];
        top[i][0] = a; top[i][1] = b; top[i][2] = c;
        top[i][3] = column[1] * c - column[2] * b;
        top[i][4] = column[2] * a - column[0] * c;
        top[i][5] = column[0] * b - column[1] * a;
    }
    for (int j = 0; j < 6; ++j) {
        for (int i = 0; i < 3; ++i)
            out.data[i][j] += top[i][j];
        out.data[3][j] += row[1] * top[2][j] - row[2] * top[1][j];
        out.data[4][j] += row[2] * top[0][j] - row[0] * top[2][j];
        out.data[5][j] += row[0] * top[1][j] - row[1] * top[0][j];
    }
    return out;
""")
def plus_point(to: wp.spatial_matrixd, h: wp.mat33d, row: wp.vec3d, column: wp.vec3d,
               weight: wp.float64) -> wp.spatial_matrixd:
    """``to`` plus ``weight`` J_r^T h J_c, for points that move with nodes by the levers ``row`` and ``column``."""
    ...


@wp.func_native(snippet="""
    wp::mat_t<6, 6, double> out = to;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
            out.data[i + 3][j + 3] += weight * h.data[i][j];
    return out;
""")
def plus_spin(to: wp.spatial_matrixd, h: wp.mat33d, weight: wp.float64) -> wp.spatial_matrixd:
    """``to`` plus ``weight`` times a 3 x 3 block in the spins of a node."""
    ...
