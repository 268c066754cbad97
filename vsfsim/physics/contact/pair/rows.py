"""Products of sparse rows with compliances: X = J A and G = J X^T, for the links of two bodies that touch.

Row r of J is one direction d of a link: over the nodes i that the link depends on, J_r = sum_i w_i d^T on the columns
of node i. A is block diagonal, A_o of the object (in the world) and A_s of the sensor (in its frame), and d is given
in both frames. A row depends on n nodes, so a product costs (rows x patch x n) where a dense J would cost (rows x
patch x patch).
"""

import functools
from types import SimpleNamespace
from typing import Any

import warp as wp

from vsfsim.physics.runtime import real, vec3


@functools.cache
def kernels() -> Any:
    """The kernels and their types."""
    module = "vsfsim_pair_rows"

    @wp.kernel(module=module, enable_backward=False)
    def responses(
        # model
        columns: wp.array(dtype=wp.int32),
        split: int,
        on_object: wp.array3d(dtype=real),
        on_sensor: wp.array3d(dtype=real),
        # state in
        node_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        world_in: wp.array3d(dtype=vec3),
        own_in: wp.array3d(dtype=vec3),
        # state out
        rows_out: wp.array3d(dtype=vec3),
    ):
        # one node of the patch of one row: the displacement there under a unit force along the row
        k, r, c = wp.tid()
        b = columns[k]
        m = world_in.shape[2]
        a = r // m
        out = vec3()
        if c < split:
            d = world_in[k, a, r - a * m]
            for i in range(node_in.shape[2]):
                n = node_in[k, a, i]
                w = weight_in[k, a, i]
                if n < split and w != real(0.0):
                    for e in range(3):
                        out += (w * d[e]) * vec3(on_object[b, 3 * n + e, 3 * c], on_object[b, 3 * n + e, 3 * c + 1],
                                                 on_object[b, 3 * n + e, 3 * c + 2])
        else:
            d = own_in[k, a, r - a * m]
            q = c - split
            for i in range(node_in.shape[2]):
                n = node_in[k, a, i] - split
                w = weight_in[k, a, i]
                if n >= 0 and w != real(0.0):
                    for e in range(3):
                        out += (w * d[e]) * vec3(on_sensor[b, 3 * n + e, 3 * q], on_sensor[b, 3 * n + e, 3 * q + 1],
                                                 on_sensor[b, 3 * n + e, 3 * q + 2])
        rows_out[k, r, c] = out

    @wp.kernel(module=module, enable_backward=False)
    def gram(
        # model
        split: int,
        # state in
        node_in: wp.array3d(dtype=wp.int32),
        weight_in: wp.array3d(dtype=real),
        world_in: wp.array3d(dtype=vec3),
        own_in: wp.array3d(dtype=vec3),
        rows_in: wp.array3d(dtype=vec3),
        # state out
        gram_out: wp.array3d(dtype=real),
    ):
        # all directions of one link with one row of X; links run fastest, so that the row stays near
        k, s, a = wp.tid()
        m = world_in.shape[2]
        at_object = vec3()
        at_sensor = vec3()
        for i in range(node_in.shape[2]):
            n = node_in[k, a, i]
            w = weight_in[k, a, i]
            if w != real(0.0):
                if n < split:
                    at_object += w * rows_in[k, s, n]
                else:
                    at_sensor += w * rows_in[k, s, n]
        for j in range(m):
            gram_out[k, a * m + j, s] = wp.dot(world_in[k, a, j], at_object) + wp.dot(own_in[k, a, j], at_sensor)

    return SimpleNamespace(responses=responses, gram=gram, vec3=vec3)
