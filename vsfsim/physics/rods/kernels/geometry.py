"""Segments and contact samples of a plant in a state (x, q) of its nodes.

``b`` is the touch, ``o`` the first node of its plant in the trees, ``i`` a segment and ``p`` its parent node, both
counted within the plant, and ``j`` a sample of the segment.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.contact_law import material_point
from vsfsim.physics.rods.kernels.segment import ONE, quat, strain, vec3
from vsfsim.physics.rods.problem import Trees
from vsfsim.physics.rods.workspace import Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def segment_strain(tree: Trees, b: int, o: int, p: int, i: int, x: wp.array2d(dtype=vec3), q: wp.array2d(dtype=quat)):
    """Strains of a segment."""
    return strain(x[b, p], q[b, p], x[b, i], q[b, i], tree.frame[o + i], tree.length[o + i])


@wp.func
def sample_point(tree: Trees, b: int, p: int, i: int, j: int, x: wp.array2d(dtype=vec3), q: wp.array2d(dtype=quat)):
    """World position of a sample [m]."""
    return material_point(tree.along[j], tree.offset[j], x[b, p], q[b, p], x[b, i], q[b, i])


@wp.func
def surface_point(tree: Trees, w: Work, b: int, p: int, i: int, j: int, lever: vec3, x: wp.array2d(dtype=vec3),
                  q: wp.array2d(dtype=quat)):
    """World position of the point on the branch's surface that was ``lever`` away from the sample at the start of the
    stride; both nodes carry it along [m]."""
    s = tree.along[j]
    lp = wp.quat_rotate(q[b, p], wp.quat_rotate_inv(w.nodes.q_start[b, p], lever))
    lc = wp.quat_rotate(q[b, i], wp.quat_rotate_inv(w.nodes.q_start[b, i], lever))
    return sample_point(tree, b, p, i, j, x, q) + (ONE - s) * lp + s * lc
