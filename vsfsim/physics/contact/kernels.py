"""The kernels that all contact shares: a stiff penalty, and Coulomb friction, of points whose gap a *source* finds.

    Pi_n = sum_q w_q/2 <-g(x_q)>^2,     f_n = -w_q g n     where g < 0

g is the distance of the point q from the other body and w_q its stiffness; a package may bring another `law`. Sources
are rigid bodies (`rigid_kernels`) and the deformable surface of a sensor (`pair.kernels`). The first part of the
penetration may be softer: there it stands for the indentation that the mesh is too coarse for (`local_indentation`). On
a sheet under bodies with edges the stiffness grows with the depth down to h (`patch.sheet_contact`), and the force is
w_q g^2 / (2 h) there.

Friction acts as `friction` says, with the tangential stiffness STICK w_q: a stuck point gives way by a thousandth of an
element at most. Slipping points drag their anchor along when the frame is done: stick-slip with history. Where
``coulomb`` is 1 the limit of a point is mu f_n as it is now, so that the stiffness couples friction to the gap and is
not symmetric; it has no potential.

A point that the other body would push out through its own is on the wrong side. It is not pushed, and a state with such
a point is no solution. All numbers are float64: a contact force is a stiff spring on a small difference of positions.
"""

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
import warp as wp

from vsfsim.physics.contact import friction
from vsfsim.physics.runtime import mat33, real, vec3

STICK = 0.1
"""Tangential stiffness of a stuck point over the normal one [-]: softer, since stick and slip meet in a kink of that
width."""
FACING = 0.5
"""Cosine between the outward normals of both bodies above which a point inside the other one is on its wrong side."""


class Points:
    """The contact points of B touches, q for each of f parts; arrays are written in place. A source has more of them.

    The owner of an anchor is a code: -1 is none, j >= 0 is the body or face j, and -2 - j is j with an anchor that this
    step made and may still move.
    """

    # model
    shape: wp.array4d(dtype=real)  # shape values of the points of each part (B, f, q, 6)
    local: wp.array3d(dtype=wp.int32)  # nodes of each part (B, f, 6); the first three are corners of its face
    stiffness: wp.array3d(dtype=real)  # w_q (B, f, q) [N/m]
    share: wp.array3d(dtype=real)  # of it that acts down to the depth `soft`, see `local_indentation` [-]
    soft: wp.array2d(dtype=real)  # (B, f) [m]
    onset: real  # of a sheet, see `patch.sheet_contact` [m]
    terms: wp.array(dtype=real)  # of the law of contact, see `law`
    coulomb: wp.array(dtype=real)  # (B,), see `rigid_contact`
    coefficient: wp.array(dtype=real)  # of friction, of each body or face [-]
    # nodes of the patches, now and when the step began (B, s) [m]
    x: wp.array2d(dtype=vec3)
    x_before: wp.array2d(dtype=vec3)
    # memory of friction, and its iteration in a step, see `friction`; the anchor is the source's
    owner: wp.array3d(dtype=wp.int32)
    limit: wp.array3d(dtype=real)
    across: wp.array3d(dtype=vec3)
    renewals: wp.array(dtype=wp.int32)
    anchorings: wp.array3d(dtype=wp.int32)
    residual: wp.array3d(dtype=real)
    # what `evaluate` finds
    gap: wp.array3d(dtype=real)
    body: wp.array3d(dtype=wp.int32)  # the nearest body or face
    normal: wp.array3d(dtype=vec3)
    force: wp.array3d(dtype=vec3)
    stiff: wp.array3d(dtype=mat33)  # [N/m], without its geometric term
    drag: wp.array3d(dtype=vec3)  # of friction, the same, where it is no part of these
    drag_stiff: wp.array3d(dtype=mat33)
    geometric: wp.array3d(dtype=mat33)
    slips: wp.array3d(dtype=wp.int32)
    wrong_side: wp.array2d(dtype=wp.int32)
    energy: wp.array2d(dtype=real)


def bound(struct: Any, given: Mapping[str, Any], size: tuple[int, ...],
          device: str) -> tuple[Any, dict[str, torch.Tensor]]:
    """An instance of a Warp ``struct``, and the tensors of its arrays by name: those ``given``, beside its numbers, and
    zeros for the others, of which those with r dimensions have the first r of ``size``. They are only ever written in
    place."""
    out, tensors = struct(), {}
    for name, var in struct.vars.items():
        if not hasattr(kind := var.type, "ndim"):
            setattr(out, name, given[name])
            continue
        real = torch.int32 if kind.dtype in (wp.int32, wp.vec3i) else torch.float64
        if (value := given.get(name)) is None:
            value = torch.zeros((*size[:kind.ndim], *getattr(kind.dtype, "_shape_", ())), dtype=real, device=device)
        elif isinstance(value, np.ndarray):
            value = torch.as_tensor(np.array(value), dtype=real, device=device)
        tensors[name] = value
        setattr(out, name, wp.from_torch(value, dtype=kind.dtype))
    return out, tensors


def contact_kernels(module: str, own: type, make: Callable[[Any, Any], Any], push: Any, *, on_faces: bool) -> Any:
    """The kernels of the contact points of a source.

    Args:
        module: name of their Warp module.
        own: the arrays of the source, annotated as those of `Points`; ``anchor`` is one of them.
        make: of the struct of both, and of ``place`` (c, x, b, f, q), where the point q of the part f of the touch b
            is with the nodes at x, makes the functions of the source on (c, b, f, q, ...):
            ``meet`` (p), p being that place, finds the nearest body or face, the gap, the direction of the force, that
            in which the gap grows, and the Hessian of the gap; all but the gap only where that is negative.
            ``held`` (owner): where an anchor is. ``anchors`` (j) makes one, and sets its owner.
            ``drags`` (at, d, left): moves the anchor ``at`` to where d, the way to the point, has the length ``left``.
        push: the Warp function of a law of contact, see `law`.
        on_faces: whether anchors are on faces of one surface, where friction acts apart from the pressure; else one on
            another body than the nearest holds nothing.

    Returns:
        ``evaluate``, ``update_friction`` and ``end_step``, to be launched over (f, k) with (points, columns (k,)); the
        function ``find`` (c, b, f) that evaluates one part; the struct ``Points``, and what ``make`` has made.
    """
    # loops over the points of a part end at a variable: unrolled, their six copies take Warp seconds to compile
    most_anchorings = wp.constant(friction.ANCHORINGS)
    facing, stick, apart = wp.constant(real(FACING)), wp.constant(real(STICK)), wp.constant(on_faces)
    both = {**Points.__annotations__, **own.__annotations__}
    Struct = wp.struct(type("Points", (), {"__annotations__": both}), module=module)

    @wp.func(module=module)
    def place(c: Struct, x: wp.array2d(dtype=vec3), b: int, f: int, q: int):
        out = vec3()
        for a in range(6):
            out += c.shape[b, f, q, a] * x[b, c.local[b, f, a]]
        return out

    source = make(Struct, place)
    meet, held, anchors, drags = source.meet, source.held, source.anchors, source.drags

    @wp.func(module=module)
    def holds(owner: int, j: int):
        # whether the owner of an anchor holds a point that is at j
        return owner == j or (apart and owner >= 0)

    @wp.func(module=module)
    def find(c: Struct, b: int, f: int):
        energy = real(0.0)
        wrong = int(0)  # noqa: UP018, RUF046
        corner = c.x[b, c.local[b, f, 0]]
        outward = wp.cross(c.x[b, c.local[b, f, 1]] - corner, c.x[b, c.local[b, f, 2]] - corner)
        outward = outward / wp.max(wp.length(outward), real(1e-30))
        for q in range(c.shape.shape[2]):
            force = vec3()
            stiff = mat33()
            geometric = mat33()
            gap = real(1e30)
            slips = int(0)  # noqa: UP018, RUF046  a Warp variable, not a constant: it changes in a loop
            w = c.stiffness[b, f, q]
            if w > real(0.0):
                p = place(c, c.x, b, f, q)
                near, gap, n, along_gap, bend = meet(c, b, f, q, p)
                if gap < real(0.0) and wp.dot(n, outward) > facing:
                    # the nearest way out leads through the body itself: the point has passed the other one's middle
                    wrong += 1
                    gap = real(0.0)
                c.body[b, f, q] = near
                limit = c.limit[b, f, q]
                slope = real(0.0)
                if gap < real(0.0):
                    c.normal[b, f, q] = n
                    size, slope, work = push(w, c.share[b, f, q], c.soft[b, f], c.onset, -gap, c.terms)
                    force = size * n
                    stiff = slope * wp.outer(n, along_gap)
                    geometric = size * bend
                    energy += work
                    if c.coulomb[b] > real(0.0) and limit > real(0.0):
                        limit = c.coefficient[near] * size
                else:
                    # the limit that was found last acts on points that have left since, too: only so there is a
                    # potential
                    limit = (real(1.0) - c.coulomb[b]) * limit
                drag = vec3()
                drag_stiffness = mat33()
                if limit > real(0.0):
                    m = c.across[b, f, q]
                    owner = c.owner[b, f, q]
                    d = friction.tangential(p - held(c, b, f, q, wp.where(owner < -1, -2 - owner, owner)), m)
                    v = stick * w
                    energy += friction.energy(wp.length(d), v, limit)
                    along, sideways = friction.hessian_roots(d, m, v, limit)
                    drag = -friction.force(d, v, limit)
                    drag_stiffness = wp.outer(along, along) + wp.outer(sideways, sideways)
                    if not friction.sticks(wp.length(d), v, limit):
                        slips = 1
                        # of a limit that follows the normal force
                        drag_stiffness -= (c.coulomb[b] * c.coefficient[near] * slope) * wp.outer(d / wp.length(d), n)
                if apart:
                    c.drag[b, f, q] = drag
                    c.drag_stiff[b, f, q] = drag_stiffness
                else:
                    force += drag
                    stiff += drag_stiffness
            c.gap[b, f, q] = gap
            c.force[b, f, q] = force
            c.stiff[b, f, q] = stiff
            c.geometric[b, f, q] = geometric
            c.slips[b, f, q] = slips
        c.energy[b, f] = energy
        c.wrong_side[b, f] = wrong

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(c: Struct, columns: wp.array(dtype=wp.int32)):
        f, k = wp.tid()
        find(c, columns[k], f)

    @wp.kernel(module=module, enable_backward=False)
    def update_friction(c: Struct, columns: wp.array(dtype=wp.int32)):
        # the limit and the tangent plane of the next iteration; anchors of points that came into contact in this step
        f, k = wp.tid()
        b = columns[k]
        for q in range(c.shape.shape[2]):
            limit = real(0.0)
            g = c.gap[b, f, q]
            if g < real(0.0):
                j = c.body[b, f, q]
                size, _slope, _work = push(c.stiffness[b, f, q], c.share[b, f, q], c.soft[b, f], c.onset, -g,
                                           c.terms)
                limit = c.coefficient[j] * size
                c.across[b, f, q] = wp.normalize(c.normal[b, f, q])
                owner = c.owner[b, f, q]
                if not holds(owner, j) and (not holds(-2 - owner, j) or c.anchorings[b, f, q] < most_anchorings):
                    c.anchorings[b, f, q] = c.anchorings[b, f, q] + 1
                    anchors(c, b, f, q, j)
            residual = real(0.0)
            if c.coulomb[b] == real(0.0):
                limit, residual = friction.relaxed(limit, c.limit[b, f, q], c.renewals[b])
            c.limit[b, f, q] = limit
            c.residual[b, f, q] = residual

    @wp.kernel(module=module, enable_backward=False)
    def end_step(c: Struct, columns: wp.array(dtype=wp.int32)):
        # points that slipped drag their anchor along, points that left lose it
        f, k = wp.tid()
        b = columns[k]
        for q in range(c.shape.shape[2]):
            owner = c.owner[b, f, q]
            owner = wp.where(owner < -1, -2 - owner, owner)
            if c.gap[b, f, q] >= real(0.0) or not holds(owner, c.body[b, f, q]):
                c.owner[b, f, q] = -1
                c.limit[b, f, q] = real(0.0)
            else:
                c.owner[b, f, q] = owner
                at = held(c, b, f, q, owner)
                d = friction.tangential(place(c, c.x, b, f, q) - at, c.across[b, f, q])
                v = stick * c.stiffness[b, f, q]
                if not friction.sticks(wp.length(d), v, c.limit[b, f, q]):
                    drags(c, b, f, q, at, d, c.limit[b, f, q] / v)

    return SimpleNamespace(find=find, evaluate=evaluate, update_friction=update_friction, end_step=end_step,
                           Points=Struct, **vars(source))
