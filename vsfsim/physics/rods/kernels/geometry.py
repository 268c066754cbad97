"""Segments and contacts of a plant in a state (x, q) of its nodes.

``b`` is the touch, ``o`` the first node of its plant in the trees, ``i`` a segment and ``p`` its parent node, both
counted within the plant, ``j`` a fibre of the segment, ``s`` a place on it and ``k`` a capsule.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.kernels.fibre import child_share, fibre_in_capsule, fibre_point, touching_patch
from vsfsim.physics.rods.kernels.segment import ONE, quat, real, strain, vec3
from vsfsim.physics.rods.structs import Touches, Trees, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.func
def segment_strain(tree: Trees, b: int, o: int, p: int, i: int, x: wp.array2d(dtype=vec3), q: wp.array2d(dtype=quat)):
    """Strains of a segment."""
    return strain(x[b, p], q[b, p], x[b, i], q[b, i], tree.frame[o + i], tree.length[o + i])


@wp.func
def surface_point(tree: Trees, w: Work, b: int, o: int, p: int, i: int, j: int, s: real, lever: vec3,
                  x: wp.array2d(dtype=vec3), q: wp.array2d(dtype=quat)):
    """World position of the point on the branch's surface that was ``lever`` away from the fibre at the start of the
    stride; both nodes carry it along [m]."""
    share = child_share(s)
    lp = wp.quat_rotate(q[b, p], wp.quat_rotate_inv(w.nodes.q_start[b, p], lever))
    lc = wp.quat_rotate(q[b, i], wp.quat_rotate_inv(w.nodes.q_start[b, i], lever))
    return fibre_point(tree, b, o, p, i, j, s, x, q) + (ONE - share) * lp + share * lc


@wp.func
def fibre_patch(tree: Trees, touch: Touches, b: int, o: int, p: int, i: int, j: int, k: int, x: wp.array2d(dtype=vec3),
                q: wp.array2d(dtype=quat), cx: vec3, cq: quat):
    """The patch of a fibre beside a capsule at (cx, cq)."""
    f = fibre_in_capsule(tree, b, o, p, i, j, x, q, cx, cq)
    return touching_patch(f, tree.tip[j], touch.half[k], touch.radius[k] + tree.radius[j], tree.length[o + i])
