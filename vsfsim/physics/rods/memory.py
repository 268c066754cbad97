"""Memory of the rod solver on its device, and the kernel that initialises the workspace of a new touch."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.model import RodModel
from vsfsim.physics.rods.problem import Results, Touches, Trees
from vsfsim.physics.rods.workspace import (
    Capsules,
    Contacts,
    Guard,
    Nodes,
    Phase,
    Progress,
    Segments,
    Stale,
    System,
    Work,
)

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


def make_trees(m: Sequence[RodModel], device: str) -> Trees:
    """The plants on a device."""
    tree = Trees()
    total = np.cumsum([0, *(len(x.plant.nodes) for x in m)])
    fibres = np.cumsum([0, *(len(x.radius) for x in m)])

    def one(values: list[np.ndarray], dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(np.concatenate(values)), dtype=dtype)

    with wp.ScopedDevice(device):
        tree.first = wp.array(total, dtype=wp.int32)
        tree.parent = one([x.plant.parent for x in m], wp.int32)
        tree.rest = one([x.plant.nodes for x in m], wp.vec3d)
        tree.frame = one([quaternions(x.frame) for x in m], wp.quatd)
        tree.length = one([x.plant.lengths() for x in m], wp.float64)
        tree.kd, tree.kphi = one([x.kd for x in m], wp.vec3d), one([x.kphi for x in m], wp.vec3d)
        tree.wire = one([x.wire for x in m], wp.vec2d)
        tree.load, tree.reach = one([x.weight for x in m], wp.vec3d), one([x.reach for x in m], wp.float64)
        tree.bound = one([x.plant.radius + x.plant.half_width for x in m], wp.float64)
        tree.fibre = one([*(x.first[:-1] + f for x, f in zip(m, fibres)), fibres[-1:]], wp.int32)
        children = [_children(x) for x in m]
        tree.child = one([child for child, _ in children], wp.int32)
        tree.next = one([sibling for _, sibling in children], wp.int32)
        ranks = [levels_of(x) for x in m]
        tree.rank = one([rank for rank, _ in ranks], wp.int32)
        tree.level = one([level + o for (_, level), o in zip(ranks, total, strict=False)], wp.int32)
        tree.levels = wp.array(np.cumsum([0, *(len(level) for _, level in ranks)]), dtype=wp.int32)
        tree.offset, tree.radius = one([x.offset for x in m], wp.vec3d), one([x.radius for x in m], wp.float64)
        tree.tip = one([x.tip.astype(np.int32) for x in m], wp.int32)
        tree.softness = one([np.cbrt(1.0 / x.penalty) for x in m], wp.vec2d)
        tree.floor = wp.array([x.floor() for x in m], dtype=wp.float64)
    return tree


def _allocate(struct: Any, shapes: dict[int, tuple[int, ...]], **others: tuple[int, ...]) -> Any:
    """An instance of a Warp struct with its arrays zeroed; ``shapes`` by their number of dimensions, ``others`` by
    name."""
    out = struct()
    for name, variable in struct.vars.items():
        if isinstance(variable.type, wp.array):
            shape = others.get(name, shapes.get(variable.type.ndim))
            setattr(out, name, wp.zeros(shape, dtype=variable.type.dtype))
    return out


def make_touches(b: int, t: int, p: int, half: Sequence[float], radius: Sequence[float]) -> Touches:
    """Places for B touches of T frames with P poses on the way, by capsules of half lengths and radii [m]."""
    k = len(half)
    touch = _allocate(Touches, {1: (b,), 2: (b, t), 3: (b, p, k)}, half=(k,), radius=(k,))
    touch.half.assign(np.array(half, float))
    touch.radius.assign(np.array(radius, float))
    return touch


def make_work(b: int, n: int, k: int, room: int, levels: int) -> Work:
    """Workspace of B touches of plants with up to N nodes and ``levels`` levels by K capsules, with ``room`` places for
    contacts each; `enter` initialises it for a touch."""
    work = Work()
    work.nodes = _allocate(Nodes, {2: (b, n)}, level=(b, levels + 1))
    work.segments, work.system = _allocate(Segments, {2: (b, n)}), _allocate(System, {2: (b, n)})
    work.capsules = _allocate(Capsules, {2: (b, k)})
    work.contacts = _allocate(Contacts, {2: (b, room), 3: (2, b, room)}, count=(2, b))
    work.progress = _allocate(Progress, {1: (b,)})
    work.guard = _allocate(Guard, {1: (b,), 2: (b, n)}, key=(b, room), stuck=(b, room), stretch=(b, room))
    return work


def make_results(b: int, t: int, k: int, n: int) -> Results:
    """Results of B touches of T frames by K capsules, with the states of N nodes unless ``n`` is 0."""
    nodes = (b, t if n else 0, n)
    return _allocate(Results, {2: (b, t), 3: (b, t, k)}, x=nodes, q=nodes)


@wp.kernel(enable_backward=False)
def enter(
    # model
    tree: Trees,
    touch: Touches,
    first: int,
    # state out
    w: Work,
):
    """Initialises the touches from number ``first`` on: the plant at rest, no contact, the arm at its first pose. One
    thread for each touch and node."""
    row, i = wp.tid()
    b = first + row
    plant = touch.plant[b]
    o = tree.first[plant]
    if i < tree.first[plant + 1] - o:
        w.nodes.x[b, i] = tree.rest[o + i]
        w.nodes.q[b, i] = wp.quatd(wp.float64(0.0), wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    w.nodes.active[b, i] = 0
    w.nodes.strained[b, i] = 0
    w.nodes.plastic[b, i] = wp.vec3d()
    w.nodes.heat[b, i] = wp.float64(0.0)
    w.system.stale[b, i] = Stale.NO
    if i == 0:
        w.contacts.count[0, b] = 0
        w.contacts.count[1, b] = 0
        w.guard.count[b] = 0
        w.progress.list[b] = 0
        w.progress.next[b] = 0
        w.progress.ended[b] = 0
        w.progress.wrong_side[b] = 0
        w.progress.used[b] = 0
        w.progress.broken[b] = 0
        w.progress.total[b] = 0
        w.guard.phase[b] = Phase.AS_PLANNED
        w.guard.turning_frame[b] = 0
        w.guard.touched[b] = 0
        w.guard.failures[b] = 0
        w.progress.part[b] = wp.float64(0.0)
        w.progress.stride[b] = wp.float64(0.0)
        w.guard.position[b] = touch.plan[b, 0]
        w.guard.good_position[b] = touch.plan[b, 0]
        w.guard.pace[b] = wp.float64(1.0)
        w.guard.turning_position[b] = touch.plan[b, 0]
        w.guard.clear_position[b] = touch.plan[b, 0]


def _children(model: RodModel) -> tuple[np.ndarray, np.ndarray]:
    """The child of each node with the highest number, and the sibling with the next lower one (n,); -1 for none."""
    parent = model.plant.parent
    child, sibling = np.full(len(parent), -1), np.full(len(parent), -1)
    for i in range(1, len(parent)):
        sibling[i] = child[parent[i]]
        child[parent[i]] = i
    return child, sibling


def levels_of(model: RodModel) -> tuple[np.ndarray, np.ndarray]:
    """The nodes sorted by level, their number of segments from the root (n,), and the first place of each level and the
    end (levels + 1,)."""
    parent = model.plant.parent
    depth = np.zeros(len(parent), int)
    for i in range(1, len(parent)):
        depth[i] = depth[parent[i]] + 1
    rank = np.argsort(depth, kind="stable")
    return rank, np.searchsorted(depth[rank], np.arange(depth.max() + 2))


def quaternions(rotation: np.ndarray) -> np.ndarray:
    """x y z w (..., 4) of rotations (..., 3, 3)."""
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat()
    return flat.reshape(*rotation.shape[:-2], 4)
