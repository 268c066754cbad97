"""The kernels of the contact of two deformable surfaces, one of which, the sensor's, is carried along: a stiff penalty,
and Coulomb friction.

    Pi_n = sum_q w_q/2 <-g>^2,     g = +-|x_q - c(x_q)|,    c the nearest point of the other surface

The anchor of `friction` is a material point X of the other surface, and the slip is the tangential part of x_q - X.
Both surfaces push: every node of the sensor against the object's quadratic triangles, and every surface node of the
object against the sensor's triangles, so that neither a bump of one nor an edge of the other passes between nodes. w_q
is the node's share of the area of its faces times a pressure per metre.

At the nearest point c the distance is stationary along the surface, so the force on x_q is -w_q g n and the one on the
other surface is its opposite, distributed by the shape functions at c: forces balance exactly. n is not the normal of
the face at c, which jumps where a node rolls from face to face, so that the forces would never settle. It is blended
from the normals of the faces around where they meet smoothly, as they were when the step began. The gap changes along
the normal m of the face, so the stiffness is w_q n m^T, which is not symmetric: with n in place of m it is wrong by
some per cent, and the gap of a point that slips by a hundred times its penetration is then wrong by several times
itself. The change of n with the deformation is left out of the stiffness.

Positions and forces are in the world; `pair.contact` rotates the sensor's into its own frame.
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.contact import friction
from vsfsim.physics.contact.rigid_kernels import FACING, STICK
from vsfsim.physics.elements import closest_point
from vsfsim.physics.runtime import mat33, real, vec3

CANDIDATES = 12
"""Number of faces of the other surface that one node may meet in one step."""
FIXED, NEW = 1, 2
"""States of an anchor: from a step before, or made in this one, which may still move it; 0 is none."""


@functools.cache
def kernels() -> Any:
    """The kernels of the pair and their types. ``Side`` are the Q nodes of one surface and the F faces of the other
    one that they may meet, of B touches; arrays are written in place."""
    vec6 = wp.types.vector(length=6, dtype=real)
    vec_most = wp.types.vector(length=CANDIDATES, dtype=real)
    module = "vsfsim_pair_contact"
    near = closest_point.functions(module)
    facing, stick = wp.constant(real(FACING)), wp.constant(real(STICK))
    most = wp.constant(CANDIDATES)
    most_anchorings = wp.constant(friction.ANCHORINGS)
    fixed, new = wp.constant(FIXED), wp.constant(NEW)

    class Side:
        corners: int  # nodes of a face, 3 or 6
        first: int  # number of the first node in the positions x of a touch; the others follow it
        coefficient: real  # of friction [-]
        # positions of all nodes now, when the step began, and if both bodies had kept their shapes since (B, S) [m]
        x: wp.array2d(dtype=vec3)
        x_before: wp.array2d(dtype=vec3)
        x_swept: wp.array2d(dtype=vec3)
        facet: wp.array3d(dtype=wp.int32)  # corners of a face that each node is on (B, Q, 3)
        stiffness: wp.array2d(dtype=real)  # penalty of each node (B, Q) [N/m]; 0 is padding
        faces: wp.array3d(dtype=wp.int32)  # (B, F, corners)
        count: wp.array(dtype=wp.int32)  # faces in use (B,)
        smooth: wp.array3d(dtype=vec3)  # blended normals at the corners of the faces (B, F, corners) [-]
        candidates: wp.array3d(dtype=wp.int32)  # faces that each node may meet (B, Q, CANDIDATES); -1 is padding
        # memory of friction, and its iteration in a step, see `friction`
        anchored: wp.array2d(dtype=wp.int32)
        anchor_face: wp.array2d(dtype=wp.int32)
        anchor_shape: wp.array2d(dtype=vec6)
        limit: wp.array2d(dtype=real)
        across: wp.array2d(dtype=vec3)
        renewals: wp.array(dtype=wp.int32)
        anchorings: wp.array2d(dtype=wp.int32)
        residual: wp.array2d(dtype=real)
        # what `evaluate` finds
        gap: wp.array2d(dtype=real)
        face: wp.array2d(dtype=wp.int32)
        shape: wp.array2d(dtype=vec6)
        normal: wp.array2d(dtype=vec3)
        push: wp.array2d(dtype=vec3)  # forces on the node [N], and their stiffness [N/m]: normal,
        push_stiffness: wp.array2d(dtype=mat33)
        drag: wp.array2d(dtype=vec3)  # and of friction
        drag_stiffness: wp.array2d(dtype=mat33)
        slips: wp.array2d(dtype=wp.int32)
        wrong_side: wp.array2d(dtype=wp.int32)
        energy: wp.array2d(dtype=real)

    Side = wp.struct(Side, module=module)

    @wp.func(module=module)
    def meet(s: Side, p: vec3, b: int, q: int, x: wp.array2d(dtype=vec3)):
        # the nearest point among the candidates: face (-1: none), shape values, signed distance, unit normal out of the
        # other body
        found = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        gap = real(1e30)
        normal = vec3()
        least = real(1e30)
        best_height = real(0.0)
        for k in range(most):
            face = s.candidates[b, q, k]
            if face >= 0:
                n, c, out = near.nearest(p, b, face, s.corners, s.faces, x)
                delta = p - c
                far = wp.length(delta)
                height = wp.dot(delta, out)
                # of two faces that share the nearest point, the one that the point is higher over tells the side
                if far < least - real(1e-12) or (far < least + real(1e-12) and wp.abs(height) > best_height):
                    least = far
                    best_height = wp.abs(height)
                    found = face
                    shape = n
                    gap = far
                    if height < real(0.0):
                        gap = -far
                    normal = out
                    if far > real(1e-12):
                        normal = delta / gap
        return found, shape, gap, normal

    @wp.func(module=module)
    def place(s: Side, b: int, face: int, shape: vec6, x: wp.array2d(dtype=vec3)):
        out = vec3()
        for i in range(s.corners):
            out += shape[i] * x[b, s.faces[b, face, i]]
        return out

    @wp.kernel(module=module, enable_backward=False)
    def search(s: Side, columns: wp.array(dtype=wp.int32), within: real):
        # the nearest faces of the other surface to every point, no further than ``within``, nearest first
        q, k = wp.tid()
        b = columns[k]
        for i in range(most):
            s.candidates[b, q, i] = -1
        if s.stiffness[b, q] <= real(0.0):
            return
        p = s.x[b, s.first + q]
        held = int(0)  # noqa: UP018, RUF046
        worst = within
        far_of = vec_most()
        for face in range(s.count[b]):
            x0 = s.x[b, s.faces[b, face, 0]]
            x1 = s.x[b, s.faces[b, face, 1]]
            x2 = s.x[b, s.faces[b, face, 2]]
            middle = (x0 + x1 + x2) / real(3.0)
            reach = wp.max(wp.length(x0 - middle), wp.max(wp.length(x1 - middle), wp.length(x2 - middle)))
            if wp.length(p - middle) - reach < worst:
                m = near.on_triangle(p, x0, x1, x2)
                far = wp.length(p - (m[0] * x0 + m[1] * x1 + m[2] * x2))
                if far < worst:
                    if held < most:
                        held += 1
                    at = held - 1
                    while at > 0 and far_of[wp.max(at - 1, 0)] > far:
                        far_of[at] = far_of[at - 1]
                        s.candidates[b, q, at] = s.candidates[b, q, at - 1]
                        at -= 1
                    far_of[at] = far
                    s.candidates[b, q, at] = face
                    if held == most:
                        worst = far_of[most - 1]

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(s: Side, columns: wp.array(dtype=wp.int32)):
        q, k = wp.tid()
        b = columns[k]
        push = vec3()
        drag = vec3()
        push_stiffness = mat33()
        drag_stiffness = mat33()
        energy = real(0.0)
        gap = real(1e30)
        slips = int(0)  # noqa: UP018, RUF046
        wrong = int(0)  # noqa: UP018, RUF046
        face = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        n = vec3()
        slope = vec3()
        w = s.stiffness[b, q]
        if w > real(0.0) and (s.candidates[b, q, 0] >= 0 or s.limit[b, q] > real(0.0)):
            p = s.x[b, s.first + q]
            if s.candidates[b, q, 0] >= 0:
                face, shape, gap, slope = meet(s, p, b, q, s.x)
                n = vec3()
                for i in range(s.corners):
                    n += shape[i] * s.smooth[b, face, i]
                n = wp.normalize(n)
                if gap < real(0.0):
                    y0 = s.x[b, s.facet[b, q, 0]]
                    own = wp.normalize(wp.cross(s.x[b, s.facet[b, q, 1]] - y0, s.x[b, s.facet[b, q, 2]] - y0))
                    if wp.dot(n, own) > facing:
                        # the nearest way out leads on: the point has passed the middle of the other body
                        wrong = 1
                        gap = real(0.0)
                if gap < real(0.0):
                    push = -w * gap * n
                    push_stiffness = w * wp.outer(n, slope)
                    energy += real(0.5) * w * gap * gap
            limit = s.limit[b, q]
            if limit > real(0.0):
                m = s.across[b, q]
                d = friction.tangential(p - place(s, b, s.anchor_face[b, q], s.anchor_shape[b, q], s.x),
                                        m)
                v = stick * w
                drag = -friction.force(d, v, limit)
                energy += friction.energy(wp.length(d), v, limit)
                along, sideways = friction.hessian_roots(d, m, v, limit)
                drag_stiffness = wp.outer(along, along) + wp.outer(sideways, sideways)
                if not friction.sticks(wp.length(d), v, limit):
                    slips = 1
        s.gap[b, q] = gap
        s.face[b, q] = face
        s.shape[b, q] = shape
        s.normal[b, q] = n
        s.push[b, q] = push
        s.push_stiffness[b, q] = push_stiffness
        s.drag[b, q] = drag
        s.drag_stiffness[b, q] = drag_stiffness
        s.slips[b, q] = slips
        s.wrong_side[b, q] = wrong
        s.energy[b, q] = energy

    @wp.kernel(module=module, enable_backward=False)
    def update_friction(s: Side, columns: wp.array(dtype=wp.int32)):
        # the limit and the tangent plane of the next iteration; anchors of points that came into contact in this step
        q, k = wp.tid()
        b = columns[k]
        limit = real(0.0)
        g = s.gap[b, q]
        if g < real(0.0):
            limit = -s.coefficient * s.stiffness[b, q] * g
            s.across[b, q] = s.normal[b, q]
            if s.anchored[b, q] == 0 or (s.anchored[b, q] == new and s.anchorings[b, q] < most_anchorings):
                s.anchorings[b, q] = s.anchorings[b, q] + 1
                # where the other surface met the point in this step if both had kept their shapes; where the point is
                # now if it did not, because a surface bulged up
                face = s.face[b, q]
                shape = s.shape[b, q]
                face0, _shape0, g0, _n0 = meet(s, s.x_before[b, s.first + q], b, q, s.x_before)
                face1, shape1, g1, n1 = meet(s, s.x_swept[b, s.first + q], b, q, s.x_swept)
                if face1 >= 0 and g1 < real(0.0):
                    face = face1
                    shape = shape1
                    if face0 >= 0 and g0 > real(0.0):
                        part = g0 / (g0 - g1)
                        p = (real(1.0) - part) * s.x_before[b, s.first + q] + part * s.x_swept[b, s.first + q]
                        # the face that it met, at that part of its way
                        c0 = place(s, b, face1, shape1, s.x_before)
                        c1 = place(s, b, face1, shape1, s.x_swept)
                        moved = c1 + friction.tangential(p - ((real(1.0) - part) * c0 + part * c1), n1)
                        face, shape, _g2, _n2 = meet(s, moved, b, q, s.x_swept)
                s.anchor_face[b, q] = face
                s.anchor_shape[b, q] = shape
                s.anchored[b, q] = new
        limit, residual = friction.relaxed(limit, s.limit[b, q], s.renewals[b])
        s.limit[b, q] = limit
        s.residual[b, q] = residual

    @wp.kernel(module=module, enable_backward=False)
    def end_step(s: Side, columns: wp.array(dtype=wp.int32)):
        # points that slipped drag their anchor along, points that left lose it
        q, k = wp.tid()
        b = columns[k]
        if s.gap[b, q] >= real(0.0):
            s.anchored[b, q] = 0
        elif s.anchored[b, q] > 0:
            s.anchored[b, q] = fixed
            m = s.across[b, q]
            at = place(s, b, s.anchor_face[b, q], s.anchor_shape[b, q], s.x)
            d = friction.tangential(s.x[b, s.first + q] - at, m)
            way = wp.length(d)
            v = stick * s.stiffness[b, q]
            if not friction.sticks(way, v, s.limit[b, q]):
                # the place on the surface that the point pulls at with its limit; the surfaces are curved, so it takes
                # a few steps to find
                left = s.limit[b, q] / v
                for _i in range(4):
                    face, shape, _g, _n = meet(s, at + (real(1.0) - left / way) * d, b, q, s.x)
                    if face >= 0:
                        s.anchor_face[b, q] = face
                        s.anchor_shape[b, q] = shape
                        at = place(s, b, face, shape, s.x)
                        d = friction.tangential(s.x[b, s.first + q] - at, m)
                        way = wp.max(wp.length(d), real(1e-15))

    return SimpleNamespace(search=search, evaluate=evaluate, update_friction=update_friction,
                           end_step=end_step, Side=Side, vec3=vec3, vec6=vec6, mat33=mat33)
