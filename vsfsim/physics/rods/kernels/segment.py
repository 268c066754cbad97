"""One beam segment between two nodes with rotations: strains, energy, gradient and the exact second derivative.

    E = 1/2 d . Kd d + 1/2 phi . Kphi phi
    phi = log(Rp^T Rc)  (in the segment's frame F),   d = (Rm F)^T (xc - xp) - L e1,   Rm = Rp exp(phi / 2)
    Kd = diag(E A, S2, S3) / L,  Kphi = diag(G J, E I2, E I3) / L,  1/S = 1/(k G A) + L^2 / (12 E I)

The strain measures are Simo's and Reissner's (Reissner 1972; Simo and Vu-Quoc 1986) at the middle of the segment,
invariant under rigid motions of any size (Crisfield and Jelenic 1999). One integration point cannot lock in shear; the
compliance L^2 / (12 E I) that it omits is added to 1/S (MacNeal 1978). So at small strain the nodes of a straight beam
are exact for loads at nodes, at any slenderness: G A may be infinite (Kirchhoff's rod).

Node rotations are the identity at rest, so a joint of several segments is rigid by itself. Spins are spatial: R <-
exp(spin) R. In the middle frame a and b are the spins of the two ends, e = b - a, psi = phi / 2, tau = tan(|psi| / 2) /
|psi|, g = tau psi, and

    phi' = C e,  C = c I + k psi psi^T,  c = |psi| / sin |psi|,  k = (1 - c) / |psi|^2
    w = (a + b) / 2 - g x e / 2        the spin of the middle frame
    d' = v' - w x D,                   D = d + L e1

The second derivative along a path of constant spins follows by differentiating these once more; it is a form in (v', w,
e).

A wire that yields has a core that is elastic and perfectly plastic and a sheath that is elastic. The core, of bending
stiffness Kw, carries the moment Kw r, r = (phi_2, phi_3) - phi_p, of norm Mp at most (a circular yield surface, because
the core is round). phi_p is its plastic bending. The sheath carries (Kphi - Kw) phi. Over a stride from the plastic
bending phi_p the moment is that of the backward Euler step (Simo and Hughes 1998, sections 1.4 and 3.3), which has a
potential (Ortiz and Stainier 1999):

    |Kw r| <= Mp:   W = Kw |r|^2 / 2,            M = Kw r,          dM/dphi = Kw I
    else:           W = Mp |r| - Mp^2 / (2 Kw),  M = Mp r / |r|,    dM/dphi = Mp / |r| (I - r r^T / |r|^2)

So Newton's method has its exact second derivative and its line search a potential, as without plasticity. At the end of
a stride phi_p moves by r (1 - Mp / |Kw r|) and Mp times that length has become heat. A segment that has not yielded has
the bits of an elastic one.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.structs import Strain

mat33 = wp.mat33d
vec3 = wp.vec3d
quat = wp.quatd
mat66 = wp.spatial_matrixd
real = wp.float64

HALF = wp.constant(wp.float64(0.5))
ZERO = wp.constant(wp.float64(0.0))
ONE = wp.constant(wp.float64(1.0))
SMALL = wp.constant(wp.float64(0.05))  # angle below which series are used, exact to 1e-12 of the value [rad]
TINY = wp.constant(wp.float64(1e-12))


@wp.func(inline=False)
def strain(xp: vec3, qp: quat, xc: vec3, qc: quat, frame: quat, length: real):
    s = Strain()
    left = wp.mul(qp, frame)
    rel = wp.mul(wp.quat_inverse(left), wp.mul(qc, frame))
    if rel[3] < ZERO:
        rel = quat(-rel[0], -rel[1], -rel[2], -rel[3])
    v = vec3(rel[0], rel[1], rel[2])
    sine = wp.length(v)
    s.angle = wp.atan2(sine, rel[3])
    s.c = ONE
    if sine > TINY:
        s.c = s.angle / sine
    s.psi = s.c * v
    s.phi = real(2.0) * s.psi
    s.g = v / (ONE + rel[3])
    half = wp.normalize(quat(rel[0], rel[1], rel[2], ONE + rel[3]))
    s.turn = wp.mul(left, half)
    s.D = wp.quat_rotate_inv(s.turn, xc - xp)
    s.d = s.D - vec3(length, ZERO, ZERO)
    return s


@wp.func
def plastic_bending(phi: vec3, plastic: vec3):
    """The two bendings of ``phi``, and r."""
    bent = vec3(ZERO, phi[1], phi[2])
    return bent, bent - plastic


@wp.func
def elastic_share(r: vec3, wire: wp.vec2d):
    """Share of the core's bending ``r`` since it last yielded that remains elastic [-]."""
    return wp.min(ONE, wire[1] / wp.max(wire[0] * wp.length(r), TINY * wire[1]))


@wp.func
def energy(s: Strain, kd: vec3, kphi: vec3, wire: wp.vec2d, plastic: vec3):
    """Elastic energy, and what yielding since the start of the stride has taken [J]. ``wire``: bending stiffness of the
    core and the moment at which it yields [N m], 0 for none; ``plastic``: its plastic bending [rad]."""
    out = HALF * (wp.dot(wp.cw_mul(kd, s.d), s.d) + wp.dot(wp.cw_mul(kphi, s.phi), s.phi))
    if wire[1] > ZERO:
        phi, r = plastic_bending(s.phi, plastic)
        size = wp.length(r)
        core = HALF * wire[0] * wp.dot(r, r)
        if wire[0] * size > wire[1]:
            core = wire[1] * size - HALF * wire[1] * wire[1] / wire[0]
        out = out + (core - HALF * wire[0] * wp.dot(phi, phi))
    return out


@wp.func
def moment(s: Strain, kphi: vec3, wire: wp.vec2d, plastic: vec3):
    """Torsional and bending moments in the middle frame [N m]."""
    mu = wp.cw_mul(kphi, s.phi)
    if wire[1] > ZERO:
        phi, r = plastic_bending(s.phi, plastic)
        mu = mu - wire[0] * (phi - elastic_share(r, wire) * r)
    return mu


@wp.func
def moment_tangent(s: Strain, kphi: vec3, wire: wp.vec2d, plastic: vec3):
    """Derivative of `moment` by torsion and bending [N m]."""
    out = wp.diag(kphi)
    if wire[1] > ZERO:
        _phi, r = plastic_bending(s.phi, plastic)
        share = elastic_share(r, wire)
        if share < ONE:
            plane = wp.diag(vec3(ZERO, ONE, ONE))
            out = out - wire[0] * ((ONE - share) * plane + (share / wp.dot(r, r)) * wp.outer(r, r))
    return out


@wp.func
def k_of(angle: real, c: real):
    """(1 - c) / angle^2."""
    t = angle * angle
    if angle < SMALL:
        return -(real(1.0 / 6.0) + t * (real(7.0 / 360.0) + t * real(31.0 / 15120.0)))
    return (ONE - c) / t


@wp.func
def times_c(s: Strain, mu: vec3):
    """C mu."""
    return s.c * mu + (k_of(s.angle, s.c) * wp.dot(s.psi, mu)) * s.psi


@wp.func(inline=False)
def gradient(s: Strain, kd: vec3, mu: vec3):
    """Derivatives by the child's position, the child's spin and the parent's spin, in the world; that by the parent's
    position is minus the first. ``mu`` is the moment, Kphi phi of an elastic segment."""
    q = wp.cw_mul(kd, s.d)
    cmu = times_c(s, mu)
    m = wp.cross(q, s.D)
    gm = wp.cross(s.g, m)
    on_child = HALF * (m + gm) + cmu
    on_parent = HALF * (m - gm) - cmu
    return wp.quat_rotate(s.turn, q), wp.quat_rotate(s.turn, on_child), wp.quat_rotate(s.turn, on_parent)


@wp.func
def symmetric(a: vec3, b: vec3):
    """Symmetric part of a b^T."""
    return HALF * (wp.outer(a, b) + wp.outer(b, a))


@wp.func
def from_blocks(tl: mat33, tr: mat33, bl: mat33, br: mat33):
    """A 6 x 6 matrix of four blocks."""
    out = mat66()
    for i in range(3):
        for j in range(3):
            out[i, j] = tl[i, j]
            out[i, j + 3] = tr[i, j]
            out[i + 3, j] = bl[i, j]
            out[i + 3, j + 3] = br[i, j]
    return out


@wp.func
def spatial(force: vec3, moment: vec3):
    """A force and a moment, or a displacement and a spin, as one 6-vector."""
    return wp.spatial_vectord(force[0], force[1], force[2], moment[0], moment[1], moment[2])


@wp.func(inline=False)
def hessian(s: Strain, kd: vec3, mu: vec3, stiffness: mat33, geometric: real):
    """The second derivative, 6 x 6 blocks in (position, spin): by the child's node, by the parent's, and the rows of
    the child with the columns of the parent. With ``geometric`` 0 it lacks the geometric stiffness, which makes it
    positive semidefinite. ``mu`` is the moment and ``stiffness`` its derivative by phi, Kphi of an elastic segment."""
    q = wp.cw_mul(kd, s.d)
    m = wp.cross(q, s.D)
    cmu = times_c(s, mu)
    t = s.angle * s.angle
    k = k_of(s.angle, s.c)
    c1 = real(1.0 / 3.0) + t * (real(7.0 / 90.0) + t * real(31.0 / 2520.0))
    k1 = -(real(7.0 / 180.0) + t * real(31.0 / 3780.0))
    tau = HALF + t * (real(1.0 / 24.0) + t * real(1.0 / 240.0))
    tau1 = real(1.0 / 12.0) + t * real(1.0 / 60.0)
    if s.angle > SMALL:
        sine = wp.sin(s.angle)
        c_slope = (sine - s.angle * wp.cos(s.angle)) / (sine * sine)
        c1 = c_slope / s.angle
        k1 = -(c_slope * s.angle + real(2.0) * (ONE - s.c)) / (t * t)
        tangent = wp.tan(HALF * s.angle)
        tau = tangent / s.angle
        tau1 = (HALF * (ONE + tangent * tangent) * s.angle - tangent) / (t * s.angle)
    eye = wp.identity(n=3, dtype=real)
    cc = s.c * eye + k * wp.outer(s.psi, s.psi)
    dd = wp.skew(s.D)
    kdd = wp.diag(kd) * dd
    hvw = kdd - geometric * wp.skew(q)
    hww = wp.transpose(dd) * kdd + geometric * (symmetric(q, s.D) - wp.dot(q, s.D) * eye)
    hwe = (geometric * HALF) * (HALF * wp.skew(m) * wp.skew(s.g) - HALF * wp.skew(wp.cross(m, s.g)) + wp.skew(cmu))
    mp = wp.dot(mu, s.psi)
    pp = HALF * (c1 * symmetric(s.psi, mu) + k1 * mp * wp.outer(s.psi, s.psi) + k * symmetric(cmu, s.psi) + k * mp * cc)
    pp = pp - (real(0.25) * (tau * k + tau1)) * symmetric(s.psi, wp.cross(m, s.psi))
    hee = cc * stiffness * cc + geometric * pp
    wa = HALF * (eye + wp.skew(s.g))
    wb = wp.transpose(wa)
    turn = wp.quat_to_matrix(s.turn)
    back = wp.transpose(turn)
    hvv = turn * wp.diag(kd) * back
    hva = turn * (hvw * wa) * back
    hvb = turn * (hvw * wb) * back
    aw = wb * hww
    bw = wa * hww
    ae = wb * hwe  # wa^T hwe
    be = wa * hwe  # wb^T hwe
    haa = turn * (aw * wa - ae - wp.transpose(ae) + hee) * back
    hbb = turn * (bw * wb + be + wp.transpose(be) + hee) * back
    hba = turn * (bw * wa - be + wp.transpose(ae) - hee) * back
    return (from_blocks(hvv, hvb, wp.transpose(hvb), hbb), from_blocks(hvv, -hva, -wp.transpose(hva), haa),
            from_blocks(-hvv, hva, -wp.transpose(hvb), hba))
