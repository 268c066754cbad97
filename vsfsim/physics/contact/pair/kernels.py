"""The contact points of two deformable surfaces, one of which, the sensor's, is carried along, as a source of
`contact.kernels`: g = +-|x_q - c(x_q)|, c the nearest point of the other surface.

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

from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.contact import friction
from vsfsim.physics.contact.kernels import contact_kernels
from vsfsim.physics.contact.law import PENALTY
from vsfsim.physics.elements import closest_point
from vsfsim.physics.elements.closest_point import vec6
from vsfsim.physics.runtime import mat33, real, vec3

CANDIDATES = 12
"""Number of faces of the other surface that one node may meet in one step."""
_MODULE = "vsfsim_pair_contact"
_most, _vec_most = wp.constant(CANDIDATES), wp.types.vector(length=CANDIDATES, dtype=real)


class Surface:
    """The F faces of the other surface, of B touches, beside what `Points` says of the f nodes of one surface."""

    corners: int  # nodes of a face, 3 or 6
    x_swept: wp.array2d(dtype=vec3)  # the nodes if both bodies had kept their shapes since the step began [m]
    faces: wp.array3d(dtype=wp.int32)  # (B, F, corners)
    count: wp.array(dtype=wp.int32)  # faces in use (B,)
    smooth: wp.array3d(dtype=vec3)  # blended normals at the corners of the faces (B, F, corners) [-]
    candidates: wp.array3d(dtype=wp.int32)  # faces that each node may meet (B, f, CANDIDATES); -1 is padding
    anchor: wp.array3d(dtype=vec6)  # shape values on the face that is its owner
    there: wp.array2d(dtype=vec6)  # shape values of the nearest point, on the face `body` (B, f)


def _source(Points: Any, place: Any) -> Any:
    """The functions of a surface, see `contact.kernels.contact_kernels`; every part has one point."""
    @wp.func(module=_MODULE)
    def closest(c: Points, p: vec3, b: int, f: int, x: wp.array2d(dtype=vec3)):
        # the nearest point among the candidates: face (-1: none), shape values, signed distance, unit normal out of the
        # other body
        found = int(-1)  # noqa: UP018, RUF046
        shape = vec6()
        gap = real(1e30)
        normal = vec3()
        least = real(1e30)
        best_height = real(0.0)
        for k in range(_most):
            face = c.candidates[b, f, k]
            if face >= 0:
                n, at, out = closest_point.nearest(p, b, face, c.corners, c.faces, x)
                delta = p - at
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

    @wp.func(module=_MODULE)
    def on_face(c: Points, b: int, face: int, shape: vec6, x: wp.array2d(dtype=vec3)):
        out = vec3()
        for i in range(c.corners):
            out += shape[i] * x[b, c.faces[b, face, i]]
        return out

    @wp.func(module=_MODULE)
    def meet(c: Points, b: int, f: int, q: int, p: vec3):
        face, shape, gap, along_gap = closest(c, p, b, f, c.x)
        c.there[b, f] = shape
        n = vec3()
        if gap < real(0.0):
            for i in range(c.corners):
                n += shape[i] * c.smooth[b, face, i]
            n = wp.normalize(n)
        return wp.max(face, 0), gap, n, along_gap, mat33()

    @wp.func(module=_MODULE)
    def held(c: Points, b: int, f: int, q: int, owner: int):
        return on_face(c, b, owner, c.anchor[b, f, q], c.x)

    @wp.func(module=_MODULE)
    def anchors(c: Points, b: int, f: int, q: int, j: int):
        # where the other surface met the point in this step if both had kept their shapes; where the point is now if it
        # did not, because a surface bulged up
        face = c.body[b, f, q]
        shape = c.there[b, f]
        before = place(c, c.x_before, b, f, q)
        swept = place(c, c.x_swept, b, f, q)
        face0, _shape0, g0, _n0 = closest(c, before, b, f, c.x_before)
        face1, shape1, g1, n1 = closest(c, swept, b, f, c.x_swept)
        if face1 >= 0 and g1 < real(0.0):
            face = face1
            shape = shape1
            if face0 >= 0 and g0 > real(0.0):
                part = g0 / (g0 - g1)
                p = (real(1.0) - part) * before + part * swept
                # the face that it met, at that part of its way
                c0 = on_face(c, b, face1, shape1, c.x_before)
                c1 = on_face(c, b, face1, shape1, c.x_swept)
                moved = c1 + friction.tangential(p - ((real(1.0) - part) * c0 + part * c1), n1)
                face, shape, _g2, _n2 = closest(c, moved, b, f, c.x_swept)
        c.anchor[b, f, q] = shape
        c.owner[b, f, q] = -2 - face

    @wp.func(module=_MODULE)
    def drags(c: Points, b: int, f: int, q: int, at: vec3, d: vec3, left: real):
        # the place on the surface that the point pulls at with its limit; the surfaces are curved, so it takes a few
        # steps to find
        way = wp.length(d)
        for _i in range(4):
            face, shape, _g, _n = closest(c, at + (real(1.0) - left / way) * d, b, f, c.x)
            if face >= 0:
                c.owner[b, f, q] = face
                c.anchor[b, f, q] = shape
                at = on_face(c, b, face, shape, c.x)
                d = friction.tangential(place(c, c.x, b, f, q) - at, c.across[b, f, q])
                way = wp.max(wp.length(d), real(1e-15))

    return SimpleNamespace(place=place, meet=meet, held=held, anchors=anchors, drags=drags)


# pressure acts at the nearest place of the other surface, friction at the anchor
KERNELS = contact_kernels(_MODULE, Surface, _source, PENALTY.push(_MODULE), on_faces=True)
"""The kernels of the pair and their types. ``Points`` are the f nodes of one surface, with one point each, and the F
faces of the other one that they may meet."""
Points, place = KERNELS.Points, KERNELS.place


@wp.kernel(module=_MODULE, enable_backward=False)
def search(c: Points, columns: wp.array(dtype=wp.int32), within: real):
    # the nearest faces of the other surface to every point, no further than ``within``, nearest first
    f, k = wp.tid()
    b = columns[k]
    for i in range(_most):
        c.candidates[b, f, i] = -1
    if c.stiffness[b, f, 0] <= real(0.0):
        return
    p = place(c, c.x, b, f, 0)
    held = int(0)  # noqa: UP018, RUF046
    worst = within
    far_of = _vec_most()
    for face in range(c.count[b]):
        x0 = c.x[b, c.faces[b, face, 0]]
        x1 = c.x[b, c.faces[b, face, 1]]
        x2 = c.x[b, c.faces[b, face, 2]]
        middle = (x0 + x1 + x2) / real(3.0)
        reach = wp.max(wp.length(x0 - middle), wp.max(wp.length(x1 - middle), wp.length(x2 - middle)))
        if wp.length(p - middle) - reach < worst:
            m = closest_point.on_triangle(p, x0, x1, x2)
            far = wp.length(p - (m[0] * x0 + m[1] * x1 + m[2] * x2))
            if far < worst:
                if held < _most:
                    held += 1
                at = held - 1
                while at > 0 and far_of[wp.max(at - 1, 0)] > far:
                    far_of[at] = far_of[at - 1]
                    c.candidates[b, f, at] = c.candidates[b, f, at - 1]
                    at -= 1
                far_of[at] = far
                c.candidates[b, f, at] = face
                if held == _most:
                    worst = far_of[_most - 1]
