"""Gas: the air inside a closed surface, at one uniform pressure.

    p V^gamma = p0 V0^gamma,    E(V) = integral from V to V0 of (p - ambient) dV
      = p0 V0 [(V0/V)^(gamma-1) - 1]/(gamma - 1) + ambient (V - V0)
      = p0 V0 ln(V0/V) + ambient (V - V0)                             for gamma = 1

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

from vsfsim.physics.elements import deformation
from vsfsim.physics.elements.block import Block, nodal, struct_of
from vsfsim.physics.runtime import mat33, real

COLLECTIVE = True
RESPONSES = 3
"""Rows of the response to a volume: gauge pressure [Pa], -dp/dV [Pa/m^3], energy [J]."""
_SMALLEST_VOLUME = 1e-3
"""Fraction of V0 below which the energy is `_INFINITE`, so that no step leads there; no sensor gets there."""
_INFINITE = 1e30


def block(faces: np.ndarray, points: np.ndarray, *, pressure: float, volume: float, gamma: float = 1.4,
          ambient: float = 101325.0, dead_volume: float = 0.0) -> Block:
    """The gas of one chamber.

    Args:
        faces: of the closed surface, wound outwards (m, 3).
        points: positions at u = 0 (n, 3) [m].
        pressure: gauge pressure when the surface encloses ``volume`` [Pa].
        volume: inside the surface at that pressure [m^3].
        gamma: exponent of p V^gamma [-].
        ambient: absolute pressure outside [Pa].
        dead_volume: of the chamber outside the surface [m^3].
    """
    faces = np.asarray(faces, np.int32)
    whole = volume + dead_volume
    assert (whole > 0.0 and dead_volume >= 0.0 and gamma >= 1.0 and ambient >= 0.0
            and ambient + pressure > 0.0)
    law = np.array([ambient + pressure, whole, gamma, ambient, dead_volume])
    return Block("gas", faces, {"points": corners(points, faces), "law": law})


def cap(rim: np.ndarray) -> np.ndarray:
    """Triangles (r - 2, 3) that close the loop ``rim`` (r,), which runs counter-clockwise when viewed from the side to
    which the sheet bulges."""
    return np.array([(rim[0], rim[i + 1], rim[i]) for i in range(1, len(rim) - 1)], np.int32)


def corners(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Corners of the faces (m, 3, 3) [m] about the middle of their nodes: so a sum of volumes keeps its digits."""
    return points[faces] - points[np.unique(faces)].mean(axis=0)


def _slopes(x: np.ndarray) -> np.ndarray:
    """Derivatives of the volume (m, 3, 3) [m^2] by the corners x (m, 3, 3) [m] of each face."""
    return np.cross(np.roll(x, -1, axis=1), np.roll(x, -2, axis=1)) / 6.0


def volume(points: np.ndarray, faces: np.ndarray) -> float:
    """Volume [m^3] inside a closed surface; points (n, 3) [m], faces (m, 3)."""
    x = corners(points, faces)
    return float((x[:, 0] * _slopes(x)[:, 0]).sum())


def gradient(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Derivative of the volume by the nodes' positions (3 n,) [m^2]."""
    out = np.zeros_like(points)
    np.add.at(out, faces, _slopes(corners(points, faces)))
    return out.ravel()


def hessian(x: np.ndarray) -> np.ndarray:
    """Second derivatives of the volume by the corners x (m, 3, 3) [m] of each face (m, 9, 9) [m]."""
    out = np.zeros((len(x), 3, 3, 3, 3))
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        turn = np.cross(np.eye(3), x[:, c, None]) / 6.0  # row j: of the gradient at a, by coordinate j of node b
        out[:, a, :, b, :] = np.swapaxes(turn, 1, 2)
        out[:, b, :, a, :] = turn
    return out.reshape(len(x), 9, 9)


def at_rest(block: Block) -> tuple[float, float, float, float]:
    """Volume inside the surface [m^3], gauge pressure [Pa], -dp/dV [Pa/m^3] and energy [J] at u = 0."""
    x, out = block.parameters["points"], wp.zeros((RESPONSES, 1), dtype=real, device="cpu")
    inside = float((x[:, 0] * _slopes(x)[:, 0]).sum())
    wp.launch(kernels().respond, dim=1, device="cpu", inputs=[
        law_on(block, "cpu"), wp.zeros(1, dtype=wp.int32, device="cpu"), wp.array([inside], dtype=real, device="cpu"),
        out])
    return inside, *map(float, out.numpy()[:, 0])


def rest_stiffness(block: Block) -> np.ndarray:
    """The sparse part of the tangent at u = 0, -g V'' (m, 9, 9) [N/m]; `rest_coupling` gives the other part."""
    return -at_rest(block)[1] * hessian(block.parameters["points"])


def rest_coupling(block: Block, points: int) -> tuple[np.ndarray, float]:
    """The part of the tangent at u = 0 that couples all nodes: grad V (3 n,) [m^2] for a body of n = ``points`` nodes,
    and -dp/dV [Pa/m^3]."""
    out = np.zeros((points, 3))
    np.add.at(out, block.nodes, _slopes(block.parameters["points"]))
    return out.ravel(), at_rest(block)[2]


@functools.cache
def kernels() -> Any:
    """The kernels of this element."""
    module = "vsfsim_gas"
    sixth, nought = wp.constant(real(1.0 / 6.0)), wp.constant(real(0.0))
    least, infinite = wp.constant(real(_SMALLEST_VOLUME)), wp.constant(real(_INFINITE))
    arguments = struct_of(module, points=wp.array(dtype=mat33))
    nodes, turn = nodal(module, arguments, 3), deformation.functions(module)
    load, store, cofactor, cofactor_change = nodes.load, nodes.store, turn.cofactor, turn.cofactor_change

    @wp.func(module=module)
    def area(of: arguments, u: wp.array2d(dtype=real), t: int, b: int):
        # the corners, one a row, and the gradient of the volume by them
        x = of.points[t] + load(of, u, t, b)
        return x, sixth * cofactor(x)

    @wp.kernel(module=module, enable_backward=False)
    def share(
        of: arguments,
        index: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        # state out
        share_out: wp.array2d(dtype=real),
    ):
        t, k = wp.tid()
        x, slope = area(of, u_in, t, index[k])
        share_out[t, index[k]] = wp.dot(x[0], slope[0])

    @wp.kernel(module=module, enable_backward=False)
    def respond(
        # model
        law: wp.array(dtype=real),
        index: wp.array(dtype=wp.int32),
        # state in
        number_in: wp.array(dtype=real),
        # state out
        response_out: wp.array2d(dtype=real),
    ):
        b = index[wp.tid()]
        ambient = law[3]
        now = number_in[b] + law[4]
        gamma = law[2]
        held = wp.max(now, least * law[1])
        ratio = law[1] / held
        p = law[0] * wp.pow(ratio, gamma)
        work = wp.log(ratio)
        if gamma != real(1.0):
            work = (wp.pow(ratio, gamma - real(1.0)) - real(1.0)) / (gamma - real(1.0))
        response_out[0, b] = p - ambient
        response_out[1, b] = gamma * p / held
        response_out[2, b] = law[0] * law[1] * work + ambient * (held - law[1])
        if now < held:
            response_out[2, b] = infinite

    @wp.kernel(module=module, enable_backward=False)
    def forces(
        of: arguments,
        index: wp.array(dtype=wp.int32),
        # state in
        u_in: wp.array2d(dtype=real),
        response_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
        energy_out: wp.array2d(dtype=real),
        det_out: wp.array2d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        _, slope = area(of, u_in, t, b)
        store(-response_in[0, b] * slope, force_out, t, b)
        energy_out[t, b] = wp.where(t == 0, response_in[2, b], nought)
        det_out[t, b] = real(1.0)

    @wp.kernel(module=module, enable_backward=False)
    def share_change(
        of: arguments,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        share_out: wp.array2d(dtype=real),
    ):
        t, k = wp.tid()
        _, slope = area(of, at_in, t, index[k])
        share_out[t, k] = wp.ddot(load(of, x_in, t, k), slope)

    @wp.kernel(module=module, enable_backward=False)
    def multiply(
        of: arguments,
        index: wp.array(dtype=wp.int32),
        # state in
        at_in: wp.array2d(dtype=real),
        response_in: wp.array2d(dtype=real),
        true_in: wp.array(dtype=real),
        change_in: wp.array(dtype=real),
        x_in: wp.array2d(dtype=real),
        # state out
        force_out: wp.array3d(dtype=real),
    ):
        t, k = wp.tid()
        b = index[k]
        x, slope = area(of, at_in, t, b)
        change = sixth * cofactor_change(x, load(of, x_in, t, k))
        store((response_in[1, b] * change_in[k]) * slope - (response_in[0, b] * true_in[b]) * change, force_out, t, k)

    return SimpleNamespace(share=share, respond=respond, forces=forces, share_change=share_change, multiply=multiply,
                           tangent=None, arguments=arguments, law=law_on)


def law_on(block: Block, device: str) -> wp.array:
    """What `respond` takes."""
    return wp.array(block.parameters["law"], dtype=real, device=device)
