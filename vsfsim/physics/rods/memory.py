"""Memory of the rod solver on its device: trees, touches, workspace, results; and the kernel that puts a new touch into
its place."""

from collections.abc import Sequence

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.model import RodModel
from vsfsim.physics.rods.state import Results, Touches, Trees, Work

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


def make_trees(m: Sequence[RodModel], device: str) -> Trees:
    """The plants on a device."""
    tree = Trees()
    total = np.cumsum([0, *(len(x.plant.nodes) for x in m)])
    samples = np.cumsum([0, *(len(x.along) for x in m)])

    def one(values: list[np.ndarray], dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(np.concatenate(values)), dtype=dtype)

    with wp.ScopedDevice(device):
        tree.first = wp.array(total, dtype=wp.int32)
        tree.parent = one([x.plant.parent for x in m], wp.int32)
        tree.rest = one([x.plant.nodes for x in m], wp.vec3d)
        tree.frame = one([quaternions(x.frame) for x in m], wp.quatd)
        tree.length = one([x.plant.lengths() for x in m], wp.float64)
        tree.kd, tree.kphi = one([x.kd for x in m], wp.vec3d), one([x.kphi for x in m], wp.vec3d)
        tree.load, tree.reach = one([x.weight for x in m], wp.vec3d), one([x.reach for x in m], wp.float64)
        tree.bound = one([x.plant.radius + x.plant.half_width for x in m], wp.float64)
        tree.sample = one([*(x.first[:-1] + s for x, s in zip(m, samples)), samples[-1:]], wp.int32)
        tree.child, tree.next = one([c for c, _ in map(_children, m)],
                                    wp.int32), one([c for _, c in map(_children, m)], wp.int32)
        ranks = [levels_of(x) for x in m]
        tree.rank = one([rank for rank, _ in ranks], wp.int32)
        tree.level = one([level + o for (_, level), o in zip(ranks, total, strict=False)], wp.int32)
        tree.levels = wp.array(np.cumsum([0, *(len(level) for _, level in ranks)]), dtype=wp.int32)
        tree.along, tree.offset = one([x.along for x in m], wp.float64), one([x.offset for x in m], wp.vec3d)
        tree.radius, tree.penalty = one([x.radius for x in m], wp.float64), one([x.penalty for x in m], wp.float64)
        tree.floor = wp.array([x.floor() for x in m], dtype=wp.float64)
    return tree


def make_touches(b: int, t: int, p: int, half: Sequence[float], radius: Sequence[float]) -> Touches:
    """Places for B touches of T frames with P poses on the way, by capsules of half lengths and radii [m]."""
    touch, k = Touches(), len(half)
    for name in ("plant", "frames", "last", "inward"):
        setattr(touch, name, wp.zeros(b, dtype=wp.int32))
    touch.friction, touch.plan = wp.zeros(b, dtype=wp.float64), wp.zeros((b, t), dtype=wp.float64)
    touch.half, touch.radius = wp.array(half, dtype=wp.float64), wp.array(radius, dtype=wp.float64)
    touch.place, touch.turn = wp.zeros((b, p, k), dtype=wp.vec3d), wp.zeros((b, p, k), dtype=wp.quatd)
    return touch


def make_work(b: int, n: int, k: int, room: int, levels: int) -> Work:
    """Workspace of B touches of plants with up to N nodes and ``levels`` levels by K capsules, with ``room`` places for
    contacts each; `enter` puts a touch in."""
    w = Work()
    for name in ("x", "x_start", "x_try", "x_keep", "x_good"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.vec3d))
    for name in ("q", "q_start", "q_try", "q_keep", "q_good"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.quatd))
    for name in ("active", "order", "strained", "first", "many", "stale", "strained_good"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.int32))
    w.level = wp.zeros((b, levels + 1), dtype=wp.int32)
    for name in ("rider", "clear", "room"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.float64))
    for name in ("g", "g_on", "g_up", "elastic", "elastic_up", "right", "right_on", "right_up", "held", "step"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.spatial_vectord))
    for name in ("own", "own_up", "mixed", "diagonal", "diagonal_on", "diagonal_up", "coupling", "across", "passed"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.spatial_matrixd))
    w.mid = wp.zeros((b, n), dtype=wp.quatd)
    for name in ("stretch", "half_turn", "rate", "relative"):
        setattr(w, name, wp.zeros((b, n), dtype=wp.vec3d))
    for name, dtype in (("cap_x", wp.vec3d), ("cap_q", wp.quatd), ("cap_x_start", wp.vec3d), ("cap_q_start", wp.quatd)):
        setattr(w, name, wp.zeros((b, k), dtype=dtype))
    for name in ("key", "sample", "node", "body", "stuck", "on"):
        setattr(w, name, wp.zeros((2, b, room), dtype=wp.int32))
    for name in ("anchor", "local0", "lever", "normal", "hold"):
        setattr(w, name, wp.zeros((2, b, room), dtype=wp.vec3d))
    for name in ("gap0", "tau", "depth"):
        setattr(w, name, wp.zeros((2, b, room), dtype=wp.float64))
    for name in ("arm_p", "arm_c", "rub_p", "rub_c", "fn", "ft", "slid", "out_f", "out_m", "anchor_good"):
        setattr(w, name, wp.zeros((b, room), dtype=wp.vec3d))
    for name in ("hn", "ht", "hc"):
        setattr(w, name, wp.zeros((b, room), dtype=wp.mat33d))
    for name in ("key_good", "stuck_good"):
        setattr(w, name, wp.zeros((b, room), dtype=wp.int32))
    w.count = wp.zeros((2, b), dtype=wp.int32)
    for name in ("side", "next", "ended", "astray", "used", "total", "phase", "turned", "met", "fails", "count_good"):
        setattr(w, name, wp.zeros(b, dtype=wp.int32))
    for name in ("part", "stride", "at", "good", "pace", "top", "low"):
        setattr(w, name, wp.zeros(b, dtype=wp.float64))
    return w


def make_results(b: int, t: int, k: int, n: int) -> Results:
    """Results of B touches of T frames by K capsules; ``n`` > 0: and where so many nodes are."""
    out = Results()
    out.force, out.moment = wp.zeros((b, t, k), dtype=wp.vec3d), wp.zeros((b, t, k), dtype=wp.vec3d)
    out.reaction = wp.zeros((b, t), dtype=wp.spatial_vectord)
    for name in ("residual", "energy", "penetration", "slipping", "where"):
        setattr(out, name, wp.full((b, t), np.nan, dtype=wp.float64))
    for name in ("iterations", "reason", "contacts"):
        setattr(out, name, wp.zeros((b, t), dtype=wp.int32))
    rows = t if n else 0
    out.x, out.q = wp.zeros((b, rows, n), dtype=wp.vec3d), wp.zeros((b, rows, n), dtype=wp.quatd)
    return out


@wp.kernel(enable_backward=False)
def enter(
    # model
    tree: Trees,
    touch: Touches,
    first: int,
    # state out
    w: Work,
):
    """Touches from number ``first`` on begin: the plant at rest, nothing touched, the arm at its first pose. One thread
    a touch and node."""
    row, i = wp.tid()
    b = first + row
    plant = touch.plant[b]
    o = tree.first[plant]
    if i < tree.first[plant + 1] - o:
        w.x[b, i] = tree.rest[o + i]
        w.q[b, i] = wp.quatd(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    w.active[b, i] = 0
    w.strained[b, i] = 0
    w.stale[b, i] = 0
    if i == 0:
        w.count[0, b] = 0
        w.count[1, b] = 0
        w.count_good[b] = 0
        w.side[b] = 0
        w.next[b] = 0
        w.ended[b] = 0
        w.astray[b] = 0
        w.used[b] = 0
        w.total[b] = 0
        w.phase[b] = 0
        w.turned[b] = 0
        w.met[b] = 0
        w.fails[b] = 0
        w.part[b] = wp.float64(0.0)
        w.stride[b] = wp.float64(0.0)
        w.at[b] = touch.plan[b, 0]
        w.good[b] = touch.plan[b, 0]
        w.pace[b] = wp.float64(1.0)
        w.top[b] = touch.plan[b, 0]
        w.low[b] = touch.plan[b, 0]


def _children(model: RodModel) -> tuple[np.ndarray, np.ndarray]:
    """The highest child of each node, and the next lower one of the same parent (n,); -1 for none."""
    parent = model.plant.parent
    child, following = np.full(len(parent), -1), np.full(len(parent), -1)
    for i in range(1, len(parent)):
        following[i] = child[parent[i]]
        child[parent[i]] = i
    return child, following


def levels_of(model: RodModel) -> tuple[np.ndarray, np.ndarray]:
    """The nodes by their number of segments from the root (n,), and the first of each number in this order, and the end
    (levels + 1,)."""
    parent = model.plant.parent
    depth = np.zeros(len(parent), int)
    for i in range(1, len(parent)):
        depth[i] = depth[parent[i]] + 1
    rank = np.argsort(depth, kind="stable")
    return rank, np.searchsorted(depth[rank], np.arange(depth.max() + 2))


def quaternions(turn: np.ndarray) -> np.ndarray:
    """x y z w (..., 4) of rotations (..., 3, 3): the largest of the four components first, the others from it (Shepperd
    1978)."""
    m = turn.reshape(-1, 3, 3)
    trace = np.trace(m, axis1=1, axis2=2)
    which = np.argmax(np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2], trace], axis=1), axis=1)
    out = np.empty((len(m), 4))
    for k in range(3):
        s = which == k
        i, j = (k + 1) % 3, (k + 2) % 3
        out[s, k] = 1.0 - trace[s] + 2.0 * m[s, k, k]
        out[s, i], out[s, j] = m[s, i, k] + m[s, k, i], m[s, j, k] + m[s, k, j]
        out[s, 3] = m[s, j, i] - m[s, i, j]
    s = which == 3
    out[s] = np.stack([m[s, 2, 1] - m[s, 1, 2], m[s, 0, 2] - m[s, 2, 0], m[s, 1, 0] - m[s, 0, 1], 1.0 + trace[s]],
                      axis=1)
    return (out / np.linalg.norm(out, axis=1, keepdims=True)).reshape(*turn.shape[:-2], 4)
