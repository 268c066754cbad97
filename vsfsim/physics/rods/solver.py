"""Touches of plants by an arm's capsules: the host's side of the rod solver.

All touches of a batch advance together, each by itself, and may be of different plants; the host only counts them between launches.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

import vsfsim.physics.device  # noqa: F401  starts Warp quietly
from vsfsim.core.shape import Capsule
from vsfsim.physics.rods.advance import advance
from vsfsim.physics.rods.arrays import Results, Touches, Trees, Work
from vsfsim.physics.rods.lanes import LANES
from vsfsim.physics.rods.model import RodError, RodModel

SMALL_FORCE = 0.1  # N: forces under it are measured against it in `force_balance`
ROOM = 512  # places for contacts (sample, capsule) of a touch
CPU_SHARE, GPU_SHARE = 1000, 1000  # Newton iterations of a touch in one launch: some seconds for a view on a CPU core, and for thousands of touches on a GPU


@dataclass(frozen=True)
class RodOptions:
    """Limits. tolerance: largest sum of unbalanced forces over the sum of contact forces [-]. faint: contact forces under this count as this there [N]; with the defaults a joint is off by under
    0.1 mN m, a thousandth of the noise of its sensor. force_limit: a touch ends before the first frame past it [N].
    room: places for contacts of a touch. share: Newton iterations of a touch in one launch, None for as many as suit the device; it changes no bit.
    lanes: threads of a CPU that work on a touch, 1, or 32 with `warp.config.enable_cpu_blocks` (slow, for tests); a GPU always has 32."""

    tolerance: float = 1e-4
    faint: float = 1.0
    force_limit: float = np.inf
    room: int = ROOM
    share: int | None = None
    lanes: int = 1


@dataclass(frozen=True)
class RodFrames:
    """T frames of B touches by K capsules. Frames after a touch's last one are NaN (False, 0).

    frames: of each touch that were solved (B,). force: on each capsule (T, B, K, 3) [N]; moment: about its origin, world (T, B, K, 3) [N m].
    reaction: force of the pot on the plant (T, B, 3) [N]; reaction_moment: about the clamped node (T, B, 3) [N m]. converged: (T, B). reason: `frames.Reason`
    (T, B). residual: (T, B) [-]. iterations: Newton's (T, B). energy: elastic (T, B) [J]. penetration: deepest sample inside a capsule (T, B) [m].
    contacts: samples in contact (T, B). slipping: their share that slips (T, B) [-]. force_balance: |force on capsules - reaction - weight| over the larger, or over 0.1 N
    (T, B) [-].
    nodes: positions (T, B, N, 3) [m], turns: quaternions x y z w (T, B, N, 4), or None.
    """

    frames: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    reaction: np.ndarray
    reaction_moment: np.ndarray
    converged: np.ndarray
    reason: np.ndarray
    residual: np.ndarray
    iterations: np.ndarray
    energy: np.ndarray
    penetration: np.ndarray
    contacts: np.ndarray
    slipping: np.ndarray
    force_balance: np.ndarray
    nodes: np.ndarray | None
    turns: np.ndarray | None

    def columns(self, some: slice) -> RodFrames:
        """Those of some touches."""
        parts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return RodFrames(**{name: None if a is None else a[some] if name == "frames" else a[:, some] for name, a in parts.items()})


class RodSolver:
    """Touches of some plants by K capsules.

    Args:
        models: the plants. shapes: of the capsules; one of length 0 is a ball. device: Warp device. options: limits.

    Raises:
        RodError: no plant, or a shape that is no capsule.
    """

    def __init__(self, models: Sequence[RodModel], shapes: Sequence[Capsule], *, device: str = "cpu", options: RodOptions | None = None):
        self.models, self.shapes, self.device, self.options = list(models), list(shapes), device, options or RodOptions()
        if not self.models or not self.shapes:
            raise RodError("a rod solver needs at least one plant and one capsule.")
        for shape in self.shapes:
            if not isinstance(shape, Capsule):
                raise RodError(f"plants are touched by capsules only, not by {shape!r}; give vsfsim.core.shape.Capsule, of length 0 for a ball.")
        self._trees = self._make_trees()
        self._weighs = int(any(m.weight.any() for m in self.models))

    def run(self, plant: np.ndarray, poses: np.ndarray, *, friction: np.ndarray | float = 0.0, frames: np.ndarray | None = None, keep_nodes: bool = False,
            progress: Callable[[int, int], None] | None = None, seconds: float | None = None) -> RodFrames:
        """Carry out touches.

        Args:
            plant: number of the touched plant of each touch (B,). poses: of the capsules, z along their axes (T, B, K, 4, 4) [m]. friction: (B,) or one for all [-].
            frames: of each touch (B,), None for T. keep_nodes: return where the nodes are. progress: called with the number of frames newly done and of the touches that go on.
            seconds: after this time on the clock no launch is begun; touches then end early. For measurements.

        Raises:
            RodError: shapes that do not fit, or poses that are not finite.
        """
        plant, poses = np.asarray(plant, np.int32), np.asarray(poses, float)
        t, b, k = poses.shape[0], len(plant), len(self.shapes)
        if poses.shape != (t, b, k, 4, 4) or t == 0 or b == 0:
            raise RodError(f"poses have the shape {poses.shape} for {b} touches and {k} capsules; give (T, {b}, {k}, 4, 4).")
        if not np.isfinite(poses).all():
            raise RodError("a pose is not finite; leave out frames that the arm cannot reach.")
        if plant.min() < 0 or plant.max() >= len(self.models):
            raise RodError(f"a touch is of plant {int(plant.max())}, but there are {len(self.models)}, counted from 0.")
        friction = np.broadcast_to(np.asarray(friction, float), (b,))
        if not ((friction >= 0.0) & (friction <= 10.0)).all():
            raise RodError(f"friction is {friction.min():g} to {friction.max():g}; it must be from 0 to 10.")
        count = np.full(b, t, np.int32) if frames is None else np.asarray(frames, np.int32)
        wide = max(len(m.plant.nodes) for m in self.models)
        with wp.ScopedDevice(self.device):
            touch = Touches()
            touch.plant, touch.friction = wp.array(plant, dtype=wp.int32), wp.array(friction, dtype=wp.float64)
            touch.frames = wp.array(count, dtype=wp.int32)
            touch.half = wp.array([0.5 * s.length for s in self.shapes], dtype=wp.float64)
            touch.radius = wp.array([s.radius for s in self.shapes], dtype=wp.float64)
            touch.place = wp.array(np.ascontiguousarray(poses[..., :3, 3]), dtype=wp.vec3d)
            touch.turn = wp.array(quaternions(poses[..., :3, :3]), dtype=wp.quatd)
            touch.force_limit, touch.tolerance, touch.faint = float(self.options.force_limit), float(self.options.tolerance), float(self.options.faint)
            work = self._make_work(plant, b, wide, k)
            out = _make_results(t, b, k, wide if keep_nodes else 0)
            gpu = wp.get_device(self.device).is_cuda
            lanes, share = (LANES, GPU_SHARE) if gpu else (self.options.lanes, CPU_SHARE)
            live, done, until = np.arange(b), 0, None if seconds is None else time.perf_counter() + seconds
            while len(live) and (until is None or time.perf_counter() < until):
                wp.launch(advance, dim=len(live) * lanes, inputs=[self._trees, touch, wp.array(live, dtype=wp.int32), lanes, self.options.share or share, self._weighs],
                          outputs=[work, out], block_dim=lanes)
                there = work.next.numpy()
                live = np.flatnonzero((there < count) & (work.ended.numpy() == 0))
                if progress is not None:
                    progress(int(there.sum()) - done, len(live))
                done = int(there.sum())
            ended = work.ended.numpy()
            return self._frames(out, np.minimum(count, work.next.numpy()), ended, plant, keep_nodes)

    def _make_trees(self) -> Trees:
        m, tree = self.models, Trees()
        total = np.cumsum([0, *(len(x.plant.nodes) for x in m)])
        samples = np.cumsum([0, *(len(x.along) for x in m)])

        def one(values: list[np.ndarray], dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(np.concatenate(values)), dtype=dtype)

        with wp.ScopedDevice(self.device):
            tree.first = wp.array(total, dtype=wp.int32)
            tree.parent = one([x.plant.parent for x in m], wp.int32)
            tree.rest = one([x.plant.nodes for x in m], wp.vec3d)
            tree.frame = one([quaternions(x.frame) for x in m], wp.quatd)
            tree.length = one([x.plant.lengths() for x in m], wp.float64)
            tree.kd, tree.kphi = one([x.kd for x in m], wp.vec3d), one([x.kphi for x in m], wp.vec3d)
            tree.load, tree.reach = one([x.weight for x in m], wp.vec3d), one([x.reach for x in m], wp.float64)
            tree.bound = one([x.plant.radius + x.plant.half_width for x in m], wp.float64)
            tree.sample = one([*(x.first[:-1] + s for x, s in zip(m, samples)), samples[-1:]], wp.int32)
            tree.child, tree.next = one([c for c, _ in map(_children, m)], wp.int32), one([c for _, c in map(_children, m)], wp.int32)
            ranks = [_levels(x) for x in m]
            tree.rank = one([rank for rank, _ in ranks], wp.int32)
            tree.level = one([level + o for (_, level), o in zip(ranks, total, strict=False)], wp.int32)
            tree.levels = wp.array(np.cumsum([0, *(len(level) for _, level in ranks)]), dtype=wp.int32)
            tree.along, tree.offset = one([x.along for x in m], wp.float64), one([x.offset for x in m], wp.vec3d)
            tree.radius, tree.penalty = one([x.radius for x in m], wp.float64), one([x.penalty for x in m], wp.float64)
            tree.floor = wp.array([x.floor() for x in m], dtype=wp.float64)
        return tree

    def _make_work(self, plant: np.ndarray, b: int, n: int, k: int) -> Work:
        w, room = Work(), self.options.room
        rest = np.zeros((b, n, 3))
        for i, p in enumerate(plant):
            nodes = self.models[p].plant.nodes
            rest[i, :len(nodes)] = nodes
        turn = np.zeros((b, n, 4))
        turn[..., 3] = 1.0
        for name in ("x", "x_start", "x_try", "x_keep"):
            setattr(w, name, wp.array(rest, dtype=wp.vec3d))
        for name in ("q", "q_start", "q_try", "q_keep"):
            setattr(w, name, wp.array(turn, dtype=wp.quatd))
        for name in ("active", "order", "strained", "first", "many", "stale"):
            setattr(w, name, wp.zeros((b, n), dtype=wp.int32))
        w.level = wp.zeros((b, max(len(_levels(m)[1]) for m in self.models) + 1), dtype=wp.int32)
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
        for name in ("arm_p", "arm_c", "rub_p", "rub_c", "fn", "ft", "slid", "out_f", "out_m"):
            setattr(w, name, wp.zeros((b, room), dtype=wp.vec3d))
        for name in ("hn", "ht", "hc"):
            setattr(w, name, wp.zeros((b, room), dtype=wp.mat33d))
        w.count = wp.zeros((2, b), dtype=wp.int32)
        w.side, w.next, w.ended, w.astray = (wp.zeros(b, dtype=wp.int32) for _ in range(4))
        return w

    def _frames(self, out: Results, count: np.ndarray, ended: np.ndarray, plant: np.ndarray, keep_nodes: bool) -> RodFrames:
        done = np.where(ended > 0, np.minimum(ended - 1, count), count)
        t = out.residual.shape[0]
        solved = np.arange(t)[:, None] < done[None, :]
        reaction = out.reaction.numpy()
        # spatial vectors come out as (top, bottom)
        root, root_moment = reaction[..., :3].copy(), reaction[..., 3:].copy()
        force, moment = out.force.numpy(), out.moment.numpy()
        reason = np.where(solved, out.reason.numpy(), 0)
        weight = np.stack([self.models[p].weight.sum(axis=0) for p in plant])
        weight -= np.stack([self.models[p].weight[0] for p in plant])  # what rests on the clamp itself bends nothing
        whole = force.sum(axis=2)
        gap = np.linalg.norm(whole - root - weight, axis=-1)
        size = np.maximum(np.maximum(np.linalg.norm(whole, axis=-1), np.linalg.norm(root, axis=-1)), SMALL_FORCE)
        floats = [np.where(solved, a.numpy(), np.nan) for a in (out.residual, out.energy, out.penetration, out.slipping)]
        for array in (force, moment, root, root_moment):
            array[~solved] = np.nan
        return RodFrames(done, force, moment, root, root_moment, solved & (reason == 0), reason, floats[0], np.where(solved, out.iterations.numpy(), 0), floats[1], floats[2],
                         np.where(solved, out.contacts.numpy(), 0), floats[3], np.where(solved, gap / size, np.nan), out.x.numpy() if keep_nodes else None, out.q.numpy() if keep_nodes else None)


def _children(model: RodModel) -> tuple[np.ndarray, np.ndarray]:
    """The highest child of each node, and the next lower one of the same parent (n,); -1 for none."""
    parent = model.plant.parent
    child, following = np.full(len(parent), -1), np.full(len(parent), -1)
    for i in range(1, len(parent)):
        following[i] = child[parent[i]]
        child[parent[i]] = i
    return child, following


def _levels(model: RodModel) -> tuple[np.ndarray, np.ndarray]:
    """The nodes by their number of segments from the root (n,), and the first of each number in this order, and the end (levels + 1,)."""
    parent = model.plant.parent
    depth = np.zeros(len(parent), int)
    for i in range(1, len(parent)):
        depth[i] = depth[parent[i]] + 1
    rank = np.argsort(depth, kind="stable")
    return rank, np.searchsorted(depth[rank], np.arange(depth.max() + 2))


def _make_results(t: int, b: int, k: int, n: int) -> Results:
    out = Results()
    out.force, out.moment = wp.zeros((t, b, k), dtype=wp.vec3d), wp.zeros((t, b, k), dtype=wp.vec3d)
    out.reaction = wp.zeros((t, b), dtype=wp.spatial_vectord)
    for name in ("residual", "energy", "penetration", "slipping"):
        setattr(out, name, wp.full((t, b), np.nan, dtype=wp.float64))
    for name in ("iterations", "reason", "contacts"):
        setattr(out, name, wp.zeros((t, b), dtype=wp.int32))
    rows = t if n else 0
    out.x, out.q = wp.zeros((rows, b, n), dtype=wp.vec3d), wp.zeros((rows, b, n), dtype=wp.quatd)
    return out


def quaternions(turn: np.ndarray) -> np.ndarray:
    """x y z w (..., 4) of rotations (..., 3, 3): the largest of the four components first, the others from it (Shepperd 1978)."""
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
    out[s] = np.stack([m[s, 2, 1] - m[s, 1, 2], m[s, 0, 2] - m[s, 2, 0], m[s, 1, 0] - m[s, 0, 1], 1.0 + trace[s]], axis=1)
    return (out / np.linalg.norm(out, axis=1, keepdims=True)).reshape(*turn.shape[:-2], 4)
