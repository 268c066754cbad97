"""Contact of two deformable surfaces, one of which (the sensor's) is carried along: a stiff penalty along the normal, Coulomb friction across it.

    Pi_n = sum_q w_q/2 <-g>^2,     g = +-|x_q - c(x_q)|,    c the nearest point of the other surface
    Pi_t as in `contact`,          d = tangential part of x_q - X(anchor),  the anchor a material point of the other surface

Both surfaces push: every node of the sensor against the object's quadratic triangles, and every surface node of the object against the sensor's
triangles, so that neither a bump of the one nor an edge of the other gets through between nodes; w_q is the node's share of its faces' area times
a pressure for each metre. At the nearest point
the way along the surface costs nothing, so the force on x_q is -w_q g n and the one on the other surface is its opposite, shared out by the
shape functions at c: forces balance exactly. n is not the normal of the one face at c, which jumps where a node rolls from face to face and would
never let the forces settle, but blended from those of the faces around (where they meet smoothly), as they were when the step began. The change of n with the deformation is left out of the stiffness (where points
stick, as they do on rubber, its part vanishes).
Positions and forces are in the world; `pair` turns the sensor's into its own frame.
"""

import functools
from typing import Any

import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.physics.contact import FACING

CANDIDATES = 12  # faces of the other surface that one point may meet in one step
FIXED, NEW = 1, 2  # an anchor: from a step before, or made in this one, which may still move it


@functools.cache
def kernels() -> Any:
    """The kernels of the pair and their types."""
    real = wp.float64
    vec3 = wp.types.vector(length=3, dtype=real)
    vec6 = wp.types.vector(length=6, dtype=real)
    vec_most = wp.types.vector(length=CANDIDATES, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)
    module = "vsfsim_pair_contact"
    facing = wp.constant(real(FACING))
    most = wp.constant(CANDIDATES)

    @wp.func(module=module)
    def on_triangle(p: vec3, a: vec3, b: vec3, c: vec3):
        # barycentric coordinates of the nearest point of a flat triangle, by Voronoi regions of its corners, edges and face
        ab = b - a
        ac = c - a
        ap = p - a
        d1 = wp.dot(ab, ap)
        d2 = wp.dot(ac, ap)
        out = vec3(real(1.0), real(0.0), real(0.0))
        if d1 <= real(0.0) and d2 <= real(0.0):
            return out
        bp = p - b
        d3 = wp.dot(ab, bp)
        d4 = wp.dot(ac, bp)
        if d3 >= real(0.0) and d4 <= d3:
            return vec3(real(0.0), real(1.0), real(0.0))
        vc = d1 * d4 - d3 * d2
        if vc <= real(0.0) and d1 >= real(0.0) and d3 <= real(0.0):
            v = d1 / (d1 - d3)
            return vec3(real(1.0) - v, v, real(0.0))
        cp = p - c
        d5 = wp.dot(ab, cp)
        d6 = wp.dot(ac, cp)
        if d6 >= real(0.0) and d5 <= d6:
            return vec3(real(0.0), real(0.0), real(1.0))
        vb = d5 * d2 - d1 * d6
        if vb <= real(0.0) and d2 >= real(0.0) and d6 <= real(0.0):
            w = d2 / (d2 - d6)
            return vec3(real(1.0) - w, real(0.0), w)
        va = d3 * d6 - d5 * d4
        if va <= real(0.0) and d4 - d3 >= real(0.0) and d5 - d6 >= real(0.0):
            w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
            return vec3(real(0.0), real(1.0) - w, w)
        scale = real(1.0) / (va + vb + vc)
        return vec3(va * scale, vb * scale, vc * scale)

    @wp.func(module=module)
    def quadratic(l: vec3):  # noqa: E741
        # shape functions of the six nodes at barycentric coordinates
        two = real(2.0)
        four = real(4.0)
        one = real(1.0)
        return vec6(l[0] * (two * l[0] - one), l[1] * (two * l[1] - one), l[2] * (two * l[2] - one),
                    four * l[0] * l[1], four * l[1] * l[2], four * l[2] * l[0])

    @wp.func(module=module)
    def sub_triangle(part: int, i: int):
        # node i of the four flat triangles between the six nodes
        if part == 3:
            return 3 + i
        if i == part:
            return part
        if i == (part + 1) % 3:
            return 3 + part
        return 3 + (part + 2) % 3

    @wp.func(module=module)
    def corner(node: int):
        # barycentric coordinates of node 0..5
        half = real(0.5)
        nought = real(0.0)
        if node < 3:
            out = vec3()
            out[node] = real(1.0)
            return out
        if node == 3:
            return vec3(half, half, nought)
        if node == 4:
            return vec3(nought, half, half)
        return vec3(half, nought, half)

    @wp.func(module=module)
    def nearest(p: vec3, b: int, face: int, nodes: int, faces: wp.array3d(dtype=wp.int32), x: wp.array2d(dtype=vec3)):
        # nearest point of one face: shape values of its six nodes (three if flat), the point, and the face's outward normal there
        x0 = x[b, faces[b, face, 0]]
        x1 = x[b, faces[b, face, 1]]
        x2 = x[b, faces[b, face, 2]]
        if nodes == 3:
            l = on_triangle(p, x0, x1, x2)  # noqa: E741
            normal = wp.normalize(wp.cross(x1 - x0, x2 - x0))
            return vec6(l[0], l[1], l[2], real(0.0), real(0.0), real(0.0)), l[0] * x0 + l[1] * x1 + l[2] * x2, normal
        x3 = x[b, faces[b, face, 3]]
        x4 = x[b, faces[b, face, 4]]
        x5 = x[b, faces[b, face, 5]]
        # begin on the nearest of the four flat triangles between the nodes
        at = vec3()
        least = real(1e300)
        for part in range(4):
            i0 = sub_triangle(part, 0)
            i1 = sub_triangle(part, 1)
            i2 = sub_triangle(part, 2)
            y0 = x[b, faces[b, face, i0]]
            y1 = x[b, faces[b, face, i1]]
            y2 = x[b, faces[b, face, i2]]
            m = on_triangle(p, y0, y1, y2)
            far = wp.length_sq(p - (m[0] * y0 + m[1] * y1 + m[2] * y2))
            if far < least:
                least = far
                at = m[0] * corner(i0) + m[1] * corner(i1) + m[2] * corner(i2)
        # Gauss and Newton's method for the curved one, held inside the triangle
        four = real(4.0)
        one = real(1.0)
        tu = vec3()
        tv = vec3()
        for _ in range(4):
            n = quadratic(at)
            c = n[0] * x0 + n[1] * x1 + n[2] * x2 + n[3] * x3 + n[4] * x4 + n[5] * x5
            # derivatives by the coordinates 1 and 2, coordinate 0 being what is left
            tu = (one - four * at[0]) * x0 + (four * at[1] - one) * x1 + four * ((at[0] - at[1]) * x3 + at[2] * x4 - at[2] * x5)
            tv = (one - four * at[0]) * x0 + (four * at[2] - one) * x2 + four * (at[1] * x4 - at[1] * x3 + (at[0] - at[2]) * x5)
            r = p - c
            a11 = wp.dot(tu, tu)
            a12 = wp.dot(tu, tv)
            a22 = wp.dot(tv, tv)
            b1 = wp.dot(tu, r)
            b2 = wp.dot(tv, r)
            det = wp.max(a11 * a22 - a12 * a12, real(1e-300))
            u = at[1] + (a22 * b1 - a12 * b2) / det
            v = at[2] + (a11 * b2 - a12 * b1) / det
            if u < real(0.0) or v < real(0.0) or u + v > one:
                # the best of the three edges, each in its own linear model
                best = real(1e300)
                for edge in range(3):
                    # from the present point to a start on the edge, then along its direction
                    su = real(0.0)
                    sv = real(0.0)
                    eu = real(0.0)
                    ev = one
                    if edge == 1:
                        eu = one
                        ev = real(0.0)
                    if edge == 2:
                        su = one
                        eu = -one
                    du = su - at[1]
                    dv = sv - at[2]
                    along = eu * eu * a11 + real(2.0) * eu * ev * a12 + ev * ev * a22
                    rest1 = b1 - a11 * du - a12 * dv
                    rest2 = b2 - a12 * du - a22 * dv
                    t = wp.clamp((eu * rest1 + ev * rest2) / wp.max(along, real(1e-300)), real(0.0), one)
                    fu = du + t * eu
                    fv = dv + t * ev
                    value = a11 * fu * fu + real(2.0) * a12 * fu * fv + a22 * fv * fv - real(2.0) * (b1 * fu + b2 * fv)
                    if value < best:
                        best = value
                        u = at[1] + fu
                        v = at[2] + fv
            at = vec3(one - u - v, u, v)
        n = quadratic(at)
        c = n[0] * x0 + n[1] * x1 + n[2] * x2 + n[3] * x3 + n[4] * x4 + n[5] * x5
        return n, c, wp.normalize(wp.cross(tu, tv))

    @wp.func(module=module)
    def meet(p: vec3, b: int, q: int, nodes: int, candidates: wp.array3d(dtype=wp.int32), faces: wp.array3d(dtype=wp.int32),
             x: wp.array2d(dtype=vec3)):
        # the nearest point among the candidates: face (-1: none), shape values, signed distance, unit normal out of the other body
        found = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        gap = real(1e30)
        normal = vec3()
        least = real(1e30)
        plumb = real(0.0)
        for k in range(most):
            face = candidates[b, q, k]
            if face >= 0:
                n, c, out = nearest(p, b, face, nodes, faces, x)
                delta = p - c
                far = wp.length(delta)
                height = wp.dot(delta, out)
                # two faces that share the nearest point: the one that sees the point more plainly knows the side
                if far < least - real(1e-12) or (far < least + real(1e-12) and wp.abs(height) > plumb):
                    least = far
                    plumb = wp.abs(height)
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

    @wp.func(module=module)
    def axis_across(m: vec3):
        out = wp.cross(m, vec3(real(0.0), real(0.0), real(1.0)))
        if wp.abs(m[2]) > real(0.9):
            out = wp.cross(m, vec3(real(1.0), real(0.0), real(0.0)))
        return wp.normalize(out)

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
                m = on_triangle(p, x0, x1, x2)
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
        # nodes that may take part in this step: all writers write the same
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
        push_out: wp.array2d(dtype=vec3),
        drag_out: wp.array2d(dtype=vec3),
        way_out: wp.array2d(dtype=vec3),
        rows_out: wp.array2d(dtype=mat33),
        slips_out: wp.array2d(dtype=wp.int32),
        astray_out: wp.array2d(dtype=wp.int32),
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
        astray = int(0)  # noqa: UP018, RUF046
        face = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        n = vec3()
        w = softening[b] * stiffness[b, q]
        if w > real(0.0) and (candidates_in[b, q, 0] >= 0 or limit_in[b, q] > real(0.0)):
            p = x_in[b, first + q]
            if candidates_in[b, q, 0] >= 0:
                face, shape, gap, n = meet(p, b, q, nodes, candidates_in, faces, x_in)
                n = vec3()
                for i in range(nodes):
                    n += shape[i] * smooth[b, face, i]
                n = wp.normalize(n)
                if gap < real(0.0):
                    y0 = x_in[b, facet[b, q, 0]]
                    own = wp.normalize(wp.cross(x_in[b, facet[b, q, 1]] - y0, x_in[b, facet[b, q, 2]] - y0))
                    if wp.dot(n, own) > facing:
                        # the nearest way out leads on: the point has come past the other body's middle
                        astray = 1
                        gap = real(0.0)
                if gap < real(0.0):
                    push = -w * gap * n
                    for c in range(3):
                        rows[0, c] = wp.sqrt(w) * n[c]
                    energy += real(0.5) * w * gap * gap
            limit = limit_in[b, q]
            if limit > real(0.0):
                m = across_in[b, q]
                d = p - place(b, anchor_face_in[b, q], nodes, anchor_shape_in[b, q], faces, x_in)
                d = d - wp.dot(d, m) * m
                way = wp.length(d)
                e = axis_across(m)
                if way > real(0.0):
                    e = d / way
                side = wp.cross(m, e)
                v = stick * w
                if v * way <= limit:
                    drag = -v * d
                    energy += real(0.5) * v * way * way
                    for c in range(3):
                        rows[1, c] = wp.sqrt(v) * e[c]
                        rows[2, c] = wp.sqrt(v) * side[c]
                else:
                    drag = -limit * e
                    energy += limit * way - real(0.5) * limit * limit / v
                    slips = 1
                    for c in range(3):
                        rows[2, c] = wp.sqrt(limit / way) * side[c]
        gap_out[b, q] = gap
        face_out[b, q] = face
        shape_out[b, q] = shape
        normal_out[b, q] = n
        push_out[b, q] = push
        drag_out[b, q] = drag
        way_out[b, q] = d
        rows_out[b, q] = rows
        slips_out[b, q] = slips
        astray_out[b, q] = astray
        energy_out[b, q] = energy

    @wp.kernel(module=module, enable_backward=False)
    def lag(
        # model
        nodes: int,
        columns: wp.array(dtype=wp.int32),
        first: int,
        stiffness: wp.array2d(dtype=real),
        faces: wp.array3d(dtype=wp.int32),
        softening: wp.array(dtype=real),
        friction: real,
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
    ):
        # the limit and the tangent plane of the next iteration; anchors of points that have come into touch in this step
        q, k = wp.tid()
        b = columns[k]
        limit = real(0.0)
        g = gap_in[b, q]
        if g < real(0.0):
            limit = -friction * softening[b] * stiffness[b, q] * g
            across_out[b, q] = normal_in[b, q]
            if anchored_out[b, q] != 1:
                # where the other surface came upon the point in this step, had both kept their shapes; where it is now, if it bulged up
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
                        # the face that it met, half-way between its two places
                        c0 = place(b, face1, nodes, shape1, faces, x_before)
                        c1 = place(b, face1, nodes, shape1, faces, x_swept)
                        shift = p - ((real(1.0) - part) * c0 + part * c1)
                        shift = shift - wp.dot(shift, n1) * n1
                        moved = c1 + shift
                        face, shape, _g2, _n2 = meet(moved, b, q, nodes, candidates_in, faces, x_swept)
                anchor_face_out[b, q] = face
                anchor_shape_out[b, q] = shape
                anchored_out[b, q] = 2
        limit_out[b, q] = limit

    @wp.kernel(module=module, enable_backward=False)
    def settle(
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
        # the step is done: points that slipped drag their anchor along, points that left forget it
        q, k = wp.tid()
        b = columns[k]
        if gap_in[b, q] >= real(0.0):
            anchored_out[b, q] = 0
        elif anchored_out[b, q] > 0:
            anchored_out[b, q] = 1
            m = across_in[b, q]
            at = place(b, anchor_face_out[b, q], nodes, anchor_shape_out[b, q], faces, x_in)
            d = x_in[b, first + q] - at
            d = d - wp.dot(d, m) * m
            way = wp.length(d)
            v = stick * stiffness[b, q]
            if v * way > limit_in[b, q]:
                face, shape, _g, _n = meet(at + (real(1.0) - limit_in[b, q] / (v * way)) * d, b, q, nodes, candidates_in, faces, x_in)
                if face >= 0:
                    anchor_face_out[b, q] = face
                    anchor_shape_out[b, q] = shape

    class Kernels:
        pass

    out = Kernels()
    out.search, out.mark, out.evaluate, out.lag, out.settle = search, mark, evaluate, lag, settle
    out.vec3, out.vec6, out.mat33 = vec3, vec6, mat33
    return out
