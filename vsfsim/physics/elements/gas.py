"""Gas: the air inside a closed surface, at one uniform pressure.

    sealed: p V^gamma = p0 V0^gamma,    E(V) = integral from V to V0 of (p - ambient) dV
              = p0 V0 [(V0/V)^(gamma-1) - 1]/(gamma - 1) + ambient (V - V0)
              = p0 V0 ln(V0/V) + ambient (V - V0)                             for gamma = 1
    open:   the supply holds p - ambient at g,    E(V) = -g (V - V0)

p and ambient are absolute pressures [Pa], and g = p - ambient is the gauge pressure. V is the volume inside the surface
plus a constant dead volume [m^3]. gamma is 1 for isothermal and 1.4 for adiabatic air.

The volume inside the surface is a sum over the tetrahedra of its triangles and one fixed point, V = sum x0 . (x1 x x2)
/ 6, with the gradient x1 x x2 / 6 at x0, and cyclically. A sheet is closed by a cap over its rim, so that a rigid
motion leaves V unchanged. The tangent is -g V'' + (-dp/dV) (grad V)(grad V)^T. Its last term couples all nodes and is
applied as a product of vectors, never as a matrix. The first term is indefinite for g > 0, and the projected tangent
omits it.
"""

import functools
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements.block import Block
from vsfsim.physics.runtime import real, vec3

NODES = 3
COLLECTIVE = True
RESPONSES = 3
"""Rows of the response to a volume: gauge pressure [Pa], -dp/dV [Pa/m^3], energy [J]."""
_SMALLEST_VOLUME = 1e-3
"""Fraction of V0 below which the energy is `_INFINITE`, so that no step leads there; no sensor gets there."""
_INFINITE = 1e30


def block(faces: np.ndarray, points: np.ndarray, *, pressure: float, volume: float, gamma: float = 1.4,
          ambient: float = 101325.0, dead_volume: float = 0.0, sealed: bool = True) -> Block:
    """The gas of one chamber.

    Args:
        faces: of the closed surface, wound outwards (m, 3).
        points: positions at u = 0 (n, 3) [m].
        pressure: gauge pressure when the surface encloses ``volume`` [Pa]; in an open chamber it is constant.
        volume: inside the surface at that pressure [m^3].
        gamma: exponent of p V^gamma [-].
        ambient: absolute pressure outside [Pa].
        dead_volume: of the chamber outside the surface [m^3].
        sealed: whether the chamber is sealed rather than open to its supply.
    """
    faces = np.asarray(faces, np.int32)
    whole = volume + dead_volume
    assert (whole > 0.0 and dead_volume >= 0.0 and gamma >= 1.0 and ambient >= 0.0
            and (not sealed or ambient + pressure > 0.0))
    local = points[faces] - points[np.unique(faces)].mean(axis=0)
    law = np.array([ambient + pressure, whole, gamma, ambient, float(sealed), dead_volume])
    return Block("gas", faces, {"points": local, "law": law})


def cap(rim: np.ndarray) -> np.ndarray:
    """Triangles (r - 2, 3) that close the loop ``rim`` (r,), which runs counter-clockwise when viewed from the side to
    which the sheet bulges."""
    return np.array([(rim[0], rim[i + 1], rim[i]) for i in range(1, len(rim) - 1)], np.int32)


def volume(points: np.ndarray, faces: np.ndarray) -> float:
    """Volume [m^3] inside a closed surface; points (n, 3) [m], faces (m, 3)."""
    x = points[faces] - points[np.unique(faces)].mean(axis=0)
    return float(np.einsum("mi,mi->m", x[:, 0], np.cross(x[:, 1], x[:, 2])).sum() / 6.0)


def gradient(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Derivative of the volume by the nodes' positions (3 n,) [m^2]."""
    x = points[faces] - points[np.unique(faces)].mean(axis=0)
    out = np.zeros_like(points)
    for a in range(3):
        np.add.at(out, faces[:, a], np.cross(x[:, (a + 1) % 3], x[:, (a + 2) % 3]) / 6.0)
    return out.ravel()


def hessian(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Second derivatives of the volume by the nodes' positions, one matrix per triangle (m, 9, 9) [m]."""
    x = points[faces] - points[np.unique(faces)].mean(axis=0)
    out = np.zeros((len(faces), 3, 3, 3, 3))
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        turn = np.zeros((len(faces), 3, 3))  # v -> v x x_c / 6: the gradient at a as a function of node b
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            turn[:, i, j], turn[:, j, i] = x[:, c, k] / 6.0, -x[:, c, k] / 6.0
        out[:, a, :, b, :] = turn
        out[:, b, :, a, :] = np.swapaxes(turn, 1, 2)
    return out.reshape(len(faces), 9, 9)


def _response(block: Block, inside: float) -> tuple[float, float, float]:
    """Gauge pressure [Pa], -dp/dV [Pa/m^3] and energy [J] when the surface encloses the volume ``inside`` [m^3]."""
    p0, v0, gamma, ambient, sealed, dead = block.parameters["law"]
    now = inside + dead
    if not sealed:
        return p0 - ambient, 0.0, -(p0 - ambient) * (now - v0)
    x = np.log(now / v0)
    p = p0 * np.exp(-gamma * x)
    work = -x if gamma == 1.0 else np.expm1(-(gamma - 1.0) * x) / (gamma - 1.0)
    return p - ambient, gamma * p / now, p0 * v0 * work + ambient * (now - v0)


def _surface(block: Block) -> tuple[np.ndarray, np.ndarray]:
    """The surface at u = 0: its nodes (n', 3) [m] and its triangles (m, 3), numbered among these nodes."""
    used, faces = np.unique(block.nodes, return_inverse=True)
    faces = faces.reshape(-1, 3)
    points = np.zeros((len(used), 3))
    points[faces.ravel()] = block.parameters["points"].reshape(-1, 3)
    return points, faces


def at_rest(block: Block) -> tuple[float, float, float, float]:
    """Volume inside the surface [m^3], gauge pressure [Pa], -dp/dV [Pa/m^3] and energy [J] at u = 0."""
    inside = volume(*_surface(block))
    return inside, *_response(block, inside)


def state_size(block: Block) -> int:
    """0: the state of the tangent belongs to the whole block, not to an element."""
    return 0


def rest_stiffness(block: Block) -> np.ndarray:
    """The sparse part of the tangent at u = 0, -g V'' (m, 9, 9) [N/m]; `rest_coupling` gives the other part."""
    points, faces = _surface(block)
    return -at_rest(block)[1] * hessian(points, faces)


def rest_coupling(block: Block, points: int) -> tuple[np.ndarray, float]:
    """The part of the tangent at u = 0 that couples all nodes: grad V (3 n,) [m^2] for a body of n = ``points`` nodes,
    and -dp/dV [Pa/m^3]."""
    local, faces = _surface(block)
    out = np.zeros((points, 3))
    out[np.unique(block.nodes)] = gradient(local, faces).reshape(-1, 3)
    return out.ravel(), at_rest(block)[2]


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    double = wp.float64
    module = "vsfsim_gas"
    sixth = wp.constant(double(1.0 / 6.0))
    least = wp.constant(double(_SMALLEST_VOLUME))
    infinite = wp.constant(double(_INFINITE))

    class Gas:  # see `block`
        nodes: wp.array2d(dtype=wp.int32)
        points: wp.array2d(dtype=vec3)

    Gas = wp.struct(Gas, module=module)

    @wp.func(module=module)
    def vector(of: Gas, x: wp.array2d(dtype=real), t: int, a: int, b: int):
        i = 3 * of.nodes[t, a]
        return vec3(double(x[i, b]), double(x[i + 1, b]), double(x[i + 2, b]))

    @wp.kernel(module=module, enable_backward=False)
    def share(
        of: Gas,
        index: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        share_out: wp.array2d(dtype=double),
    ):
        t, k = wp.tid()
        b = index[k]
        x0 = of.points[t, 0] + vector(of, u_in, t, 0, b)
        x1 = of.points[t, 1] + vector(of, u_in, t, 1, b)
        x2 = of.points[t, 2] + vector(of, u_in, t, 2, b)
        share_out[t, b] = sixth * wp.dot(x0, wp.cross(x1, x2))

    @wp.kernel(module=module, enable_backward=False)
    def respond(
        # model
        law: wp.array(dtype=double),
        index: wp.array(dtype=wp.int32),
        # state in
        number_in: wp.array(dtype=double),
        # state out
        response_out: wp.array2d(dtype=double),
    ):
        b = index[wp.tid()]
        ambient = law[3]
        now = number_in[b] + law[5]
        if law[4] == double(0.0):
            response_out[0, b] = law[0] - ambient
            response_out[1, b] = double(0.0)
            response_out[2, b] = -(law[0] - ambient) * (now - law[1])
        else:
            gamma = law[2]
            held = wp.max(now, least * law[1])
            ratio = law[1] / held
            p = law[0] * wp.pow(ratio, gamma)
            work = wp.log(ratio)
            if gamma != double(1.0):
                work = (wp.pow(ratio, gamma - double(1.0)) - double(1.0)) / (gamma - double(1.0))
            response_out[0, b] = p - ambient
            response_out[1, b] = gamma * p / held
            response_out[2, b] = law[0] * law[1] * work + ambient * (held - law[1])
            if now < held:
                response_out[2, b] = infinite

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        of: Gas,
        index: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        response_in: wp.array2d(dtype=double),
        # state out
        force_out: wp.array3d(dtype=real),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        x0 = of.points[t, 0] + vector(of, u_in, t, 0, b)
        x1 = of.points[t, 1] + vector(of, u_in, t, 1, b)
        x2 = of.points[t, 2] + vector(of, u_in, t, 2, b)
        push = -sixth * response_in[0, b]
        f0 = push * wp.cross(x1, x2)
        f1 = push * wp.cross(x2, x0)
        f2 = push * wp.cross(x0, x1)
        for c in range(3):
            force_out[t, c, b] = real(f0[c])
            force_out[t, 3 + c, b] = real(f1[c])
            force_out[t, 6 + c, b] = real(f2[c])
        energy_out[t, b] = real(0.0)
        if t == 0:
            energy_out[t, b] = real(response_in[2, b])
        det_out[t, b] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def share_change(
        of: Gas,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        share_out: wp.array2d(dtype=double),
    ):
        t, k = wp.tid()
        b = index[k]
        x0 = of.points[t, 0] + vector(of, at_in, t, 0, b)
        x1 = of.points[t, 1] + vector(of, at_in, t, 1, b)
        x2 = of.points[t, 2] + vector(of, at_in, t, 2, b)
        share_out[t, k] = sixth * (wp.dot(vector(of, x_in, t, 0, k), wp.cross(x1, x2))
                                   + wp.dot(vector(of, x_in, t, 1, k), wp.cross(x2, x0))
                                   + wp.dot(vector(of, x_in, t, 2, k), wp.cross(x0, x1)))

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        of: Gas,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        response_in: wp.array2d(dtype=double),
        true_in: wp.array(dtype=double),
        change_in: wp.array(dtype=double),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        x0 = of.points[t, 0] + vector(of, at_in, t, 0, b)
        x1 = of.points[t, 1] + vector(of, at_in, t, 1, b)
        x2 = of.points[t, 2] + vector(of, at_in, t, 2, b)
        d0 = vector(of, x_in, t, 0, k)
        d1 = vector(of, x_in, t, 1, k)
        d2 = vector(of, x_in, t, 2, k)
        push = -sixth * response_in[0, b] * true_in[b]
        swell = sixth * response_in[1, b] * change_in[k]
        f0 = push * (wp.cross(d1, x2) + wp.cross(x1, d2)) + swell * wp.cross(x1, x2)
        f1 = push * (wp.cross(d2, x0) + wp.cross(x2, d0)) + swell * wp.cross(x2, x0)
        f2 = push * (wp.cross(d0, x1) + wp.cross(x0, d1)) + swell * wp.cross(x0, x1)
        for c in range(3):
            force_out[t, c, k] = real(f0[c])
            force_out[t, 3 + c, k] = real(f1[c])
            force_out[t, 6 + c, k] = real(f2[c])

    def law(block: Block, device: str) -> wp.array:
        return wp.array(block.parameters["law"], dtype=double, device=device)

    return SimpleNamespace(share=share, respond=respond, forces=forces, share_change=share_change, multiply=multiply,
                           tangent=None, arguments=Gas, law=law)
