"""Conjugate gradients for several touches at once, vectors (3 n, k), one column a touch.

The matrix is the object's projected tangent plus the contact block of each touch; the preconditioner is the rest-state
factor with the contact block added exactly (Woodbury):

    (K0 + G^T D G)^-1 = K0^-1 (I - S T S^T K0^-1),   T = G^T (D^-1 + G A G^T)^-1 G,   A = S^T K0^-1 S

with S the patch's degrees of freedom and A its compliance. Columns stop together; one that is done is frozen by a zero step.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly


@functools.cache
def kernels(real: type) -> Any:
    """Vector kernels for one scalar type."""
    module = f"vsfsim_pcg_{real.__name__}"

    @wp.kernel(module=module, enable_backward=False)
    def dot(a_in: wp.array2d(dtype=real), b_in: wp.array2d(dtype=real), chunk: int, sum_out: wp.array2d(dtype=wp.float64)):
        c, k = wp.tid()
        total = wp.float64(0.0)
        for i in range(c * chunk, wp.min((c + 1) * chunk, a_in.shape[0])):
            total += wp.float64(a_in[i, k]) * wp.float64(b_in[i, k])
        sum_out[c, k] = total

    @wp.kernel(module=module, enable_backward=False)
    def combine(a_in: wp.array2d(dtype=real), scale: wp.array(dtype=real), b_in: wp.array2d(dtype=real), out: wp.array2d(dtype=real)):
        # out = a + scale b
        i, k = wp.tid()
        out[i, k] = a_in[i, k] + scale[k] * b_in[i, k]

    @wp.kernel(module=module, enable_backward=False)
    def patch(
        # model
        block: wp.array3d(dtype=real),
        nodes: wp.array2d(dtype=wp.int32),
        columns: wp.array(dtype=wp.int32),
        sign: real,
        # state in
        x_in: wp.array2d(dtype=real),
        # state out
        y_out: wp.array2d(dtype=real),
    ):
        # y += sign * S block S^T x, rows of one touch's patch; -1 pads the node list
        r, k = wp.tid()
        b = columns[k]
        i = nodes[b, r // 3]
        if i >= 0:
            total = real(0.0)
            for s in range(nodes.shape[1]):
                j = nodes[b, s]
                if j >= 0:
                    for c in range(3):
                        total += block[b, r, 3 * s + c] * x_in[3 * j + c, k]
            at = 3 * i + r % 3
            y_out[at, k] = y_out[at, k] + sign * total

    class Kernels:
        pass

    out = Kernels()
    out.dot, out.combine, out.patch, out.real = dot, combine, patch, real
    return out


_CHUNKS = 64


def column_dots(k: Any, a: wp.array, b: wp.array) -> np.ndarray:
    """Dot product of every column, (k,), summed in double and in a fixed order."""
    rows, columns = a.shape
    chunk = -(-rows // _CHUNKS)
    out = wp.empty((_CHUNKS, columns), dtype=wp.float64, device=a.device)
    wp.launch(k.dot, dim=(_CHUNKS, columns), inputs=[a, b, chunk, out], device=a.device)
    return out.numpy().sum(axis=0)


def solve(k: Any, multiply: Callable[[wp.array], wp.array], precondition: Callable[[wp.array], wp.array],
          right: wp.array, *, tolerance: np.ndarray, iterations: int) -> tuple[wp.array, int, np.ndarray]:
    """Solve A x = ``right`` from x = 0.

    Args:
        k: `kernels` of the scalar type. multiply, precondition: A p and M^-1 r, on (3 n, k) arrays.
        tolerance: relative residual in the preconditioner's norm, per column (k,). iterations: the limit.

    Returns:
        x (3 n, k), iterations done, and which columns met negative curvature (k,) bool: those keep what they have so far
        (their first direction at the least).
    """
    shape, device = right.shape, right.device

    def upload(values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=k.real, device=device)

    def combine(a: wp.array, scale: np.ndarray, b: wp.array, out: wp.array) -> None:
        wp.launch(k.combine, dim=shape, inputs=[a, upload(scale), b, out], device=device)

    x = wp.zeros(shape, dtype=k.real, device=device)
    r = wp.clone(right)
    z = precondition(r)
    p = wp.clone(z)
    rz = column_dots(k, r, z)
    start = np.maximum(rz, 1e-300)
    running = rz > 0.0
    done = 0
    negative = np.zeros(shape[1], bool)
    for step in range(iterations):
        ap = multiply(p)
        pap = column_dots(k, p, ap)
        bad = running & (pap <= 0.0)
        negative |= bad
        if step == 0 and bad.any():
            combine(x, np.where(bad, 1.0, 0.0), p, x)
        running = running & ~bad
        alpha = np.where(running, rz / np.where(pap > 0.0, pap, 1.0), 0.0)
        combine(x, alpha, p, x)
        combine(r, -alpha, ap, r)
        z = precondition(r)
        fresh = column_dots(k, r, z)
        done = step + 1
        running = running & (fresh > tolerance**2 * start)
        if not running.any():
            rz = np.where(alpha != 0.0, fresh, rz)
            break
        beta = np.where(running, fresh / np.where(rz > 0.0, rz, 1.0), 0.0)
        combine(z, beta, p, p)
        rz = np.where(alpha != 0.0, fresh, rz)
    return x, done, negative
