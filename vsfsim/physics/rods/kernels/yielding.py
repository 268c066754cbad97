"""Wires that yield: the moment of a segment whose core is elastic and perfectly plastic and whose sheath is elastic.

The core, of bending stiffness Kw, carries the moment Kw (phi - phi_p) of the two bendings phi = (phi_2, phi_3), of norm
Mp at most (a circular yield surface, because the core is round). phi_p is its plastic bending. The sheath carries
(Kphi - Kw) phi. Over a stride from the plastic bending phi_p the moment is that of the backward Euler step (Simo and
Hughes 1998, sections 1.4 and 3.3), which has a potential (Ortiz and Stainier 1999): with e = phi - phi_p

    |Kw e| <= Mp:   W = Kw |e|^2 / 2,            M = Kw e,          dM/dphi = Kw I
    else:           W = Mp |e| - Mp^2 / (2 Kw),  M = Mp e / |e|,    dM/dphi = Mp / |e| (I - e e^T / |e|^2)

So Newton's method has its exact second derivative and its line search a potential, as without plasticity. At the end of
a stride phi_p moves by e (1 - Mp / |Kw e|) and Mp times that length has become heat. A segment that has not yielded has
the bits of an elastic one.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.segment import HALF, ONE, ZERO, Strain, energy, vec3
from vsfsim.physics.rods.structs import Trees, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def bending(phi: vec3):
    """The two bendings of ``phi``, without the torsion."""
    return vec3(ZERO, phi[1], phi[2])


@wp.func
def elastic_share(e: vec3, wire: wp.vec2d):
    """Share of the core's bending ``e`` since it last yielded that remains elastic [-]."""
    trial = wire[0] * wp.length(e)
    out = ONE
    if trial > wire[1]:
        out = wire[1] / trial
    return out


@wp.func
def segment_energy(tree: Trees, w: Work, b: int, o: int, i: int, s: Strain):
    """Elastic energy of segment ``i``, and what yielding since the start of the stride has taken [J]."""
    out = energy(s, tree.kd[o + i], tree.kphi[o + i])
    wire = tree.wire[o + i]
    if wire[1] > ZERO:
        phi = bending(s.phi)
        e = phi - w.nodes.plastic[b, i]
        size = wp.length(e)
        core = HALF * wire[0] * wp.dot(e, e)
        if wire[0] * size > wire[1]:
            core = wire[1] * size - HALF * wire[1] * wire[1] / wire[0]
        out = out + (core - HALF * wire[0] * wp.dot(phi, phi))
    return out


@wp.func
def segment_moment(tree: Trees, w: Work, b: int, o: int, i: int, s: Strain):
    """Torsional and bending moments of segment ``i`` in the middle frame [N m]."""
    mu = wp.cw_mul(tree.kphi[o + i], s.phi)
    wire = tree.wire[o + i]
    if wire[1] > ZERO:
        phi = bending(s.phi)
        e = phi - w.nodes.plastic[b, i]
        mu = mu - wire[0] * (phi - elastic_share(e, wire) * e)
    return mu


@wp.func
def segment_tangent(tree: Trees, w: Work, b: int, o: int, i: int, s: Strain):
    """Derivative of `segment_moment` by torsion and bending [N m]."""
    out = wp.diag(tree.kphi[o + i])
    wire = tree.wire[o + i]
    if wire[1] > ZERO:
        e = bending(s.phi) - w.nodes.plastic[b, i]
        share = elastic_share(e, wire)
        if share < ONE:
            plane = wp.diag(vec3(ZERO, ONE, ONE))
            out = out - wire[0] * ((ONE - share) * plane + (share / wp.dot(e, e)) * wp.outer(e, e))
    return out


@wp.func
def yield_segment(tree: Trees, w: Work, b: int, o: int, i: int, s: Strain):
    """Ends a stride of segment ``i``: stores its plastic bending and adds to its heat."""
    wire = tree.wire[o + i]
    if wire[1] > ZERO:
        e = bending(s.phi) - w.nodes.plastic[b, i]
        lost = ONE - elastic_share(e, wire)
        if lost > ZERO:
            w.nodes.plastic[b, i] = w.nodes.plastic[b, i] + lost * e
            w.nodes.heat[b, i] = w.nodes.heat[b, i] + wire[1] * lost * wp.length(e)


@wp.func
def has_yielded(w: Work, b: int, i: int):
    """1 if segment ``i`` has a plastic bending, else 0."""
    return wp.where(wp.length_sq(w.nodes.plastic[b, i]) > ZERO, 1, 0)
