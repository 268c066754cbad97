"""Coulomb's law of friction, the one place of it: regularised, and solved as a sequence of Tresca problems.

    Pi_t = { k/2 |u|^2                     k |u| <= tau   (the point sticks)
           { tau |u| - tau^2/(2 k)         else           (the point slips)

u is the tangential way of a point from its anchor, the place where it last stuck, and k its tangential stiffness. The
limit tau = mu f_n is held fixed while Newton's method brings the forces into balance: the problem then has a potential.
Afterwards it is renewed from the normal force that was found, until it no longer changes, and the law is Coulomb's.
Contact points of a surface (`kernels`) and rods (`rods.kernels.contact_law`) use these functions; each keeps its
anchors in its own way.

Where friction lifts a point off and the next iteration brings it back, the full change of its limit would be made and
undone for ever. So from the thirteenth renewal of a step on half of every change is made. The half that is held back
counts as a residual of Coulomb's law: a frame with any of it left is not in equilibrium. A point that comes into
contact where the object bulges up is anchored where it is; an anchor that followed its point in every iteration would
creep on for ever, so it is set `ANCHORINGS` times in a step at most.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly

ANCHORINGS = 3
"""How often an anchor that a step makes may be set in this step."""
# renewals of a step whose change is made in full, and the part of it that is made from then on: with 0.3 sixty renewals
# were too few, 0.5 and 0.7 arrive alike (`test_frames_of_columns_arrive`)
_FULL, _STEADY = wp.constant(12), wp.constant(wp.float64(0.5))
_ZERO, _HALF, _ONE = (wp.constant(wp.float64(value)) for value in (0.0, 0.5, 1.0))


@wp.func
def tangential(v: wp.vec3d, normal: wp.vec3d):
    """The part of a vector across a unit normal."""
    return v - wp.dot(v, normal) * normal


@wp.func
def sticks(way: wp.float64, stiffness: wp.float64, limit: wp.float64):
    """Whether a point sticks at the tangential way ``way`` = |u| [m] from its anchor."""
    return stiffness * way <= limit


@wp.func
def energy(way: wp.float64, stiffness: wp.float64, limit: wp.float64):
    """Pi_t [J]."""
    if sticks(way, stiffness, limit):
        return _HALF * stiffness * way * way
    return limit * way - _HALF * limit * limit / stiffness


@wp.func
def force(u: wp.vec3d, stiffness: wp.float64, limit: wp.float64):
    """Gradient of Pi_t by u [N], minus the force on the point: Coulomb's return map."""
    way = wp.length(u)
    if sticks(way, stiffness, limit):
        return stiffness * u
    return limit * (u / way)


@wp.func
def axis_across(normal: wp.vec3d):
    """A unit vector across a unit normal."""
    out = wp.cross(normal, wp.vec3d(_ZERO, _ZERO, _ONE))
    if wp.abs(normal[2]) > wp.float64(0.9):
        out = wp.cross(normal, wp.vec3d(_ONE, _ZERO, _ZERO))
    return wp.normalize(out)


@wp.func
def hessian_roots(u: wp.vec3d, normal: wp.vec3d, stiffness: wp.float64, limit: wp.float64):
    """The Hessian of Pi_t as r r^T + s s^T in the tangent plane of ``normal``: the rows r, along the slip, and s,
    across it [sqrt(N/m)]. A slipping point has r = 0: along the slip the force is constant."""
    way = wp.length(u)
    along = axis_across(normal)
    if way > _ZERO:
        along = u / way
    across = wp.cross(normal, along)
    if sticks(way, stiffness, limit):
        root = wp.sqrt(stiffness)
        return root * along, root * across
    return wp.vec3d(), wp.sqrt(limit / way) * across


@wp.func
def relaxed(asked: wp.float64, present: wp.float64, renewals: int):
    """From the limit that Coulomb's law asks for, the present one [N] and the number of this renewal in the step: the
    next limit, and the part of the change that is held back, the residual of the law [N]."""
    part = _ONE
    if renewals > _FULL:
        part = _STEADY
    return present + part * (asked - present), (_ONE - part) * wp.abs(asked - present)
