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

from vsfsim.physics.contact import closest_point, friction
from vsfsim.physics.contact.rigid_kernels import FACING
from vsfsim.physics.runtime import mat33, real, vec3

CANDIDATES = 12
"""Number of faces of the other surface that one node may meet in one step."""
FIXED, NEW = 1, 2
"""States of an anchor: from a step before, or made in this one, which may still move it; 0 is none."""


@functools.cache
def kernels() -> Any:
    """The kernels of the pair and their types."""
    vec6 = wp.types.vector(length=6, dtype=real)
    vec_most = wp.types.vector(length=CANDIDATES, dtype=real)
    module = "vsfsim_pair_contact"
    near = closest_point.functions(module)
    facing = wp.constant(real(FACING))
    most = wp.constant(CANDIDATES)
    most_anchorings = wp.constant(friction.ANCHORINGS)
    fixed, new = wp.constant(FIXED), wp.constant(NEW)

    @wp.func(module=module)
    def meet(p: vec3, b: int, q: int, nodes: int, candidates: wp.array3d(dtype=wp.int32),
             faces: wp.array3d(dtype=wp.int32),
             x: wp.array2d(dtype=vec3)):
        # the nearest point among the candidates: face (-1: none), shape values, signed distance, unit normal out of the
        # other body
        found = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        gap = real(1e30)
        normal = vec3()
        least = real(1e30)
        best_height = real(0.0)
        for k in range(most):
            face = candidates[b, q, k]
            if face >= 0:
                n, c, out = near.nearest(p, b, face, nodes, faces, x)
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
    def place(b: int, face: int, nodes: int, shape: vec6, faces: wp.array3d(dtype=wp.int32), x: wp.array2d(dtype=vec3)):
        out = vec3()
        for i in range(nodes):
            out += shape[i] * x[b, faces[b, face, i]]
        return out

    @wp.kernel(module=module, enable_backward=False)
    def search(
        # model
        columns: wp.array(dtype=wp.int32),
        within: real,
        first: int,
        stiffness: wp.array2d(dtype=real),
        faces: wp.array3d(dtype=wp.int32),
        count: wp.array(dtype=wp.int32),
        # state in
        x_in: wp.array2d(dtype=vec3),
        # state out
        candidates_out: wp.array3d(dtype=wp.int32),
    ):
        # the nearest faces of the other surface to every point, no further than ``within``, nearest first
        q, k = wp.tid()
        b = columns[k]
        for i in range(most):
            candidates_out[b, q, i] = -1
        if stiffness[b, q] <= real(0.0):
            return
        p = x_in[b, first + q]
        held = int(0)  # noqa: UP018, RUF046
        worst = within
        far_of = vec_most()
        for face in range(count[b]):
            x0 = x_in[b, faces[b, face, 0]]
            x1 = x_in[b, faces[b, face, 1]]
            x2 = x_in[b, faces[b, face, 2]]
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
                        candidates_out[b, q, at] = candidates_out[b, q, at - 1]
                        at -= 1
                    far_of[at] = far
                    candidates_out[b, q, at] = face
                    if held == most:
                        worst = far_of[most - 1]

    @wp.kernel(module=module, enable_backward=False)
    def mark(
        # model
        nodes: int,
        columns: wp.array(dtype=wp.int32),
        first: int,
        faces: wp.array3d(dtype=wp.int32),
        # state in
        candidates_in: wp.array3d(dtype=wp.int32),
        anchored_in: wp.array2d(dtype=wp.int32),
        anchor_face_in: wp.array2d(dtype=wp.int32),
        # state out
        near_out: wp.array2d(dtype=wp.int32),
    ):
        # nodes that may take part in this step; all threads write the same value
        q, k = wp.tid()
        b = columns[k]
        if candidates_in[b, q, 0] >= 0 or anchored_in[b, q] > 0:
            near_out[b, first + q] = 1
            for c in range(most):
                face = candidates_in[b, q, c]
                if face >= 0:
                    for i in range(nodes):
                        near_out[b, faces[b, face, i]] = 1
            if anchored_in[b, q] > 0:
                for i in range(nodes):
                    near_out[b, faces[b, anchor_face_in[b, q], i]] = 1

    @wp.kernel(module=module, enable_backward=False)
    def evaluate(
        # model
        nodes: int,
        columns: wp.array(dtype=wp.int32),
        first: int,
        facet: wp.array3d(dtype=wp.int32),
        stiffness: wp.array2d(dtype=real),
        faces: wp.array3d(dtype=wp.int32),
        smooth: wp.array3d(dtype=vec3),
        softening: wp.array(dtype=real),
        stick: real,
        # state in
        x_in: wp.array2d(dtype=vec3),
        candidates_in: wp.array3d(dtype=wp.int32),
        anchored_in: wp.array2d(dtype=wp.int32),
        anchor_face_in: wp.array2d(dtype=wp.int32),
        anchor_shape_in: wp.array2d(dtype=vec6),
        limit_in: wp.array2d(dtype=real),
        across_in: wp.array2d(dtype=vec3),
        # state out
        gap_out: wp.array2d(dtype=real),
        face_out: wp.array2d(dtype=wp.int32),
        shape_out: wp.array2d(dtype=vec6),
        normal_out: wp.array2d(dtype=vec3),
        slope_out: wp.array2d(dtype=vec3),
        push_out: wp.array2d(dtype=vec3),
        drag_out: wp.array2d(dtype=vec3),
        slip_out: wp.array2d(dtype=vec3),
        rows_out: wp.array2d(dtype=mat33),
        slips_out: wp.array2d(dtype=wp.int32),
        wrong_side_out: wp.array2d(dtype=wp.int32),
        energy_out: wp.array2d(dtype=real),
    ):
        q, k = wp.tid()
        b = columns[k]
        push = vec3()
        drag = vec3()
        d = vec3()
        rows = mat33()
        energy = real(0.0)
        gap = real(1e30)
        slips = int(0)  # noqa: UP018, RUF046
        wrong = int(0)  # noqa: UP018, RUF046
        face = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        n = vec3()
        slope = vec3()
        w = softening[b] * stiffness[b, q]
        if w > real(0.0) and (candidates_in[b, q, 0] >= 0 or limit_in[b, q] > real(0.0)):
            p = x_in[b, first + q]
            if candidates_in[b, q, 0] >= 0:
                face, shape, gap, slope = meet(p, b, q, nodes, candidates_in, faces, x_in)
                n = vec3()
                for i in range(nodes):
                    n += shape[i] * smooth[b, face, i]
                n = wp.normalize(n)
                if gap < real(0.0):
                    y0 = x_in[b, facet[b, q, 0]]
                    own = wp.normalize(wp.cross(x_in[b, facet[b, q, 1]] - y0, x_in[b, facet[b, q, 2]] - y0))
                    if wp.dot(n, own) > facing:
                        # the nearest way out leads on: the point has passed the middle of the other body
                        wrong = 1
                        gap = real(0.0)
                if gap < real(0.0):
                    push = -w * gap * n
                    for c in range(3):
                        rows[0, c] = wp.sqrt(w) * n[c]
                    energy += real(0.5) * w * gap * gap
            limit = limit_in[b, q]
            if limit > real(0.0):
                m = across_in[b, q]
                d = friction.tangential(p - place(b, anchor_face_in[b, q], nodes, anchor_shape_in[b, q], faces, x_in),
                                        m)
                v = stick * w
                drag = -friction.force(d, v, limit)
                energy += friction.energy(wp.length(d), v, limit)
                along, sideways = friction.hessian_roots(d, m, v, limit)
                for c in range(3):
                    rows[1, c] = along[c]
                    rows[2, c] = sideways[c]
                if not friction.sticks(wp.length(d), v, limit):
                    slips = 1
        gap_out[b, q] = gap
        face_out[b, q] = face
        shape_out[b, q] = shape
        normal_out[b, q] = n
        slope_out[b, q] = slope
        push_out[b, q] = push
        drag_out[b, q] = drag
        slip_out[b, q] = d
        rows_out[b, q] = rows
        slips_out[b, q] = slips
        wrong_side_out[b, q] = wrong
        energy_out[b, q] = energy

    @wp.kernel(module=module, enable_backward=False)
    def update_friction(
        # model
        nodes: int,
        columns: wp.array(dtype=wp.int32),
        first: int,
        stiffness: wp.array2d(dtype=real),
        faces: wp.array3d(dtype=wp.int32),
        softening: wp.array(dtype=real),
        coefficient: real,
        renewals: wp.array(dtype=wp.int32),
        # state in
        candidates_in: wp.array3d(dtype=wp.int32),
        x_before: wp.array2d(dtype=vec3),
        x_swept: wp.array2d(dtype=vec3),
        gap_in: wp.array2d(dtype=real),
        face_in: wp.array2d(dtype=wp.int32),
        shape_in: wp.array2d(dtype=vec6),
        normal_in: wp.array2d(dtype=vec3),
        # state out
        anchored_out: wp.array2d(dtype=wp.int32),
        anchor_face_out: wp.array2d(dtype=wp.int32),
        anchor_shape_out: wp.array2d(dtype=vec6),
        limit_out: wp.array2d(dtype=real),
        across_out: wp.array2d(dtype=vec3),
        anchorings_out: wp.array2d(dtype=wp.int32),
        damping_out: wp.array2d(dtype=real),
        change_out: wp.array2d(dtype=real),
        residual_out: wp.array2d(dtype=real),
    ):
        # the limit and the tangent plane of the next iteration; anchors of points that came into contact in this step
        q, k = wp.tid()
        b = columns[k]
        limit = real(0.0)
        g = gap_in[b, q]
        if g < real(0.0):
            limit = -coefficient * softening[b] * stiffness[b, q] * g
            across_out[b, q] = normal_in[b, q]
            if anchored_out[b, q] == 0 or (anchored_out[b, q] == new and anchorings_out[b, q] < most_anchorings):
                anchorings_out[b, q] = anchorings_out[b, q] + 1
                # where the other surface met the point in this step if both had kept their shapes; where the point is
                # now if it did not, because a surface bulged up
                face = face_in[b, q]
                shape = shape_in[b, q]
                face0, _shape0, g0, _n0 = meet(x_before[b, first + q], b, q, nodes, candidates_in, faces, x_before)
                face1, shape1, g1, n1 = meet(x_swept[b, first + q], b, q, nodes, candidates_in, faces, x_swept)
                if face1 >= 0 and g1 < real(0.0):
                    face = face1
                    shape = shape1
                    if face0 >= 0 and g0 > real(0.0):
                        part = g0 / (g0 - g1)
                        p = (real(1.0) - part) * x_before[b, first + q] + part * x_swept[b, first + q]
                        # the face that it met, at that part of its way
                        c0 = place(b, face1, nodes, shape1, faces, x_before)
                        c1 = place(b, face1, nodes, shape1, faces, x_swept)
                        moved = c1 + friction.tangential(p - ((real(1.0) - part) * c0 + part * c1), n1)
                        face, shape, _g2, _n2 = meet(moved, b, q, nodes, candidates_in, faces, x_swept)
                anchor_face_out[b, q] = face
                anchor_shape_out[b, q] = shape
                anchored_out[b, q] = new
        limit, damping, change, residual = friction.relaxed(limit, limit_out[b, q], damping_out[b, q],
                                                            change_out[b, q], renewals[b])
        limit_out[b, q] = limit
        damping_out[b, q] = damping
        change_out[b, q] = change
        residual_out[b, q] = residual

    @wp.kernel(module=module, enable_backward=False)
    def end_step(
        # model
        nodes: int,
        columns: wp.array(dtype=wp.int32),
        first: int,
        stiffness: wp.array2d(dtype=real),
        faces: wp.array3d(dtype=wp.int32),
        stick: real,
        # state in
        x_in: wp.array2d(dtype=vec3),
        candidates_in: wp.array3d(dtype=wp.int32),
        gap_in: wp.array2d(dtype=real),
        limit_in: wp.array2d(dtype=real),
        across_in: wp.array2d(dtype=vec3),
        # state out
        anchored_out: wp.array2d(dtype=wp.int32),
        anchor_face_out: wp.array2d(dtype=wp.int32),
        anchor_shape_out: wp.array2d(dtype=vec6),
    ):
        # points that slipped drag their anchor along, points that left lose it
        q, k = wp.tid()
        b = columns[k]
        if gap_in[b, q] >= real(0.0):
            anchored_out[b, q] = 0
        elif anchored_out[b, q] > 0:
            anchored_out[b, q] = fixed
            m = across_in[b, q]
            at = place(b, anchor_face_out[b, q], nodes, anchor_shape_out[b, q], faces, x_in)
            d = friction.tangential(x_in[b, first + q] - at, m)
            way = wp.length(d)
            v = stick * stiffness[b, q]
            if not friction.sticks(way, v, limit_in[b, q]):
                # the place on the surface that the point pulls at with its limit; the surfaces are curved, so it takes
                # a few steps to find
                left = limit_in[b, q] / v
                for _i in range(4):
                    face, shape, _g, _n = meet(at + (real(1.0) - left / way) * d, b, q, nodes, candidates_in, faces,
                                               x_in)
                    if face >= 0:
                        anchor_face_out[b, q] = face
                        anchor_shape_out[b, q] = shape
                        at = place(b, face, nodes, shape, faces, x_in)
                        d = friction.tangential(x_in[b, first + q] - at, m)
                        way = wp.max(wp.length(d), real(1e-15))

    return SimpleNamespace(search=search, mark=mark, evaluate=evaluate, update_friction=update_friction,
                           end_step=end_step, vec3=vec3, vec6=vec6, mat33=mat33)
