"""The plants on the device of the rod solver, and the start of a new touch."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from vsfsim.physics.rods.model import RodModel
from vsfsim.physics.rods.structs import Trees, filled


def make_trees(m: Sequence[RodModel], device: str) -> Any:
    """The plants on a device."""
    total = np.cumsum([0, *(len(x.plant.nodes) for x in m)])
    fibres = np.cumsum([0, *(len(x.radius) for x in m)])
    children, ranks = [_children(x) for x in m], [levels_of(x) for x in m]
    each = {
        "parent": [x.plant.parent for x in m], "rest": [x.plant.nodes for x in m],
        "frame": [quaternions(x.frame) for x in m], "length": [x.plant.lengths() for x in m],
        "kd": [x.kd for x in m], "kphi": [x.kphi for x in m], "wire": [x.wire for x in m],
        "load": [x.weight for x in m], "reach": [x.reach for x in m],
        "bound": [x.plant.radius + x.plant.half_width for x in m],
        "fibre": [*(x.first[:-1] + f for x, f in zip(m, fibres)), fibres[-1:]],
        "child": [child for child, _ in children], "next": [sibling for _, sibling in children],
        "rank": [rank for rank, _ in ranks], "level": [level + o for (_, level), o in zip(ranks, total)],
        "offset": [x.offset for x in m], "radius": [x.radius for x in m], "tip": [x.tip.astype(np.int32) for x in m],
        "softness": [np.cbrt(1.0 / x.penalty) for x in m]}
    with wp.ScopedDevice(device):
        return filled(Trees, first=total, levels=np.cumsum([0, *(len(level) for _, level in ranks)]),
                      floor=np.array([x.floor() for x in m]),
                      **{name: np.concatenate(values) for name, values in each.items()})


def start(work: Any, models: Sequence[RodModel], some: slice, plan: np.ndarray) -> None:
    """Start the touches ``some``, of the plants ``models`` and planned at ``plan`` (b, T): plants at rest, no contact,
    the arm at its first pose."""
    for part in (work.nodes, work.progress, work.guard):
        for name in part._cls.vars:
            getattr(part, name)[some].zero_()
    for side in (0, 1):
        work.contacts.count[side, some].zero_()
    work.system.stale[some].zero_()
    rest = np.zeros((len(models), work.nodes.x.shape[1], 3))
    for row, model in zip(rest, models):
        row[:len(model.plant.nodes)] = model.plant.nodes
    work.nodes.x[some].assign(rest)
    work.nodes.q[some].assign(np.tile([0.0, 0.0, 0.0, 1.0], (*rest.shape[:2], 1)))
    work.guard.pace[some].fill_(1.0)
    for where in (work.guard.position, work.guard.good_position, work.guard.turning_position,
                  work.guard.clear_position):
        where[some].assign(np.ascontiguousarray(plan[:, 0]))


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
