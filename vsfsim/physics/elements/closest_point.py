"""The nearest point of a surface of triangles, flat or quadratic, and whether it goes around a point, as Warp
functions."""

import numpy as np
import warp as wp

from vsfsim.physics.runtime import real, vec3

vec6 = wp.types.vector(length=6, dtype=real)
# the four flat triangles between the six nodes, and the barycentric coordinates of these
parts = wp.constant(wp.types.matrix(shape=(4, 3), dtype=wp.int32)([[0, 3, 5], [3, 1, 4], [5, 4, 2], [3, 4, 5]]))
at_nodes = wp.constant(wp.types.matrix(shape=(6, 3), dtype=real)(
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]))
half_turn = wp.constant(real(np.pi))
plain = wp.constant(real(0.999))  # cosine between a normal and the way to a point; above, the nearest is on no edge
same = wp.constant(real(1e-12))  # difference of two distances [m] under which they are one

@wp.func
def on_triangle(p: vec3, a: vec3, b: vec3, c: vec3):
    # barycentric coordinates of the nearest point of a flat triangle, by Voronoi regions of its corners, edges and
    # face (Ericson 2005, Real-Time Collision Detection, section 5.1.5)
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


@wp.func
def quadratic(l: vec3):  # noqa: E741
    # shape functions of the six nodes at barycentric coordinates
    two = real(2.0)
    four = real(4.0)
    one = real(1.0)
    return vec6(l[0] * (two * l[0] - one), l[1] * (two * l[1] - one), l[2] * (two * l[2] - one),
                four * l[0] * l[1], four * l[1] * l[2], four * l[2] * l[0])


@wp.func
def nearest(p: vec3, b: int, face: int, nodes: int, faces: wp.array3d(dtype=wp.int32), x: wp.array2d(dtype=vec3)):
    # nearest point of one face: shape values of its six nodes (three if flat), the point, and the face's outward
    # normal there
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
        y0 = x[b, faces[b, face, parts[part, 0]]]
        y1 = x[b, faces[b, face, parts[part, 1]]]
        y2 = x[b, faces[b, face, parts[part, 2]]]
        m = on_triangle(p, y0, y1, y2)
        far = wp.length_sq(p - (m[0] * y0 + m[1] * y1 + m[2] * y2))
        if far < least:
            least = far
            at = m[0] * at_nodes[parts[part, 0]] + m[1] * at_nodes[parts[part, 1]] + m[2] * at_nodes[parts[part, 2]]
    # Gauss and Newton's method for the curved one: the nearest point of the flat triangle that touches it
    four = real(4.0)
    one = real(1.0)
    tu = vec3()
    tv = vec3()
    for _ in range(4):
        n = quadratic(at)
        c = n[0] * x0 + n[1] * x1 + n[2] * x2 + n[3] * x3 + n[4] * x4 + n[5] * x5
        # derivatives by the coordinates 1 and 2, coordinate 0 being what is left
        tu = ((one - four * at[0]) * x0 + (four * at[1] - one) * x1
              + four * ((at[0] - at[1]) * x3 + at[2] * x4 - at[2] * x5))
        tv = ((one - four * at[0]) * x0 + (four * at[2] - one) * x2
              + four * (at[1] * x4 - at[1] * x3 + (at[0] - at[2]) * x5))
        corner = c - at[1] * tu - at[2] * tv
        at = on_triangle(p, corner, corner + tu, corner + tv)
    n = quadratic(at)
    c = n[0] * x0 + n[1] * x1 + n[2] * x2 + n[3] * x3 + n[4] * x4 + n[5] * x5
    return n, c, wp.normalize(wp.cross(tu, tv))


@wp.func
def half_angle(p: vec3, x0: vec3, x1: vec3, x2: vec3):
    # half the solid angle of a flat triangle seen from p (van Oosterom and Strackee 1983)
    a0 = x0 - p
    a1 = x1 - p
    a2 = x2 - p
    l0 = wp.length(a0)
    l1 = wp.length(a1)
    l2 = wp.length(a2)
    return wp.atan2(wp.dot(a0, wp.cross(a1, a2)),
                    l0 * l1 * l2 + wp.dot(a0, a1) * l2 + wp.dot(a1, a2) * l0 + wp.dot(a2, a0) * l1)


@wp.func
def nearer(p: vec3, at: vec3, normal: vec3, face: int, least: real, height: real, known: int):
    # of two faces that share the nearest point, the one that the point is higher over tells the side
    away = wp.length(p - at)
    above = wp.dot(p - at, normal)
    if away < least - same:
        return away, above, face
    if away < least + same and wp.abs(above) > wp.abs(height):
        return away, above, known
    return least, height, known


@wp.func
def encloses(p: vec3, height: real, least: real, b: int, nodes: int, faces: wp.array3d(dtype=wp.int32),
             closing: wp.array2d(dtype=wp.int32), x: wp.array2d(dtype=vec3)):
    # where the nearest point is on an edge, the normal of one face may not tell the side: inside, the halves of the
    # solid angles add up to a whole turn
    if -height > plain * least:
        return True
    angle = real(0.0)
    for f in range(faces.shape[1]):
        if nodes == 3:
            angle += half_angle(p, x[b, faces[b, f, 0]], x[b, faces[b, f, 1]], x[b, faces[b, f, 2]])
        else:
            for part in range(4):
                angle += half_angle(p, x[b, faces[b, f, parts[part, 0]]], x[b, faces[b, f, parts[part, 1]]],
                                    x[b, faces[b, f, parts[part, 2]]])
    for f in range(closing.shape[0]):
        angle += half_angle(p, x[b, closing[f, 0]], x[b, closing[f, 1]], x[b, closing[f, 2]])
    return wp.abs(angle) > half_turn
