"""Touches of plants by an arm's capsules: the host's side of the rod solver.

All touches of a batch advance together, each by itself, and may be of different plants; the host only counts them
between launches.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.shape import Capsule
from vsfsim.physics.rods.kernels.advance import advance
from vsfsim.physics.rods.kernels.lanes import LANES
from vsfsim.physics.rods.memory import enter, levels_of, make_results, make_touches, make_trees, make_work, quaternions
from vsfsim.physics.rods.model import RodError, RodModel

SMALL_FORCE = 0.1  # N: forces under it are measured against it in `force_balance`
ROOM = 512  # places for contacts (sample, capsule) of a touch
CPU_SHARE = 1000  # Newton iterations of a touch in one launch on a CPU: some seconds for a view on a core
# s: a launch on a GPU, which ends up to 1 s later, as a try at a stride is not cut short; touches that found no room on
# it go first in the next one
GPU_SPAN = 10.0
ENDLESS = 2**31 - 1  # Newton iterations
MOST = 31  # capsules: `search` keeps a bit for each


class Ended(IntEnum):
    """Why a touch has fewer frames than it was to have: it has them all, the force limit or the protective stop (a
    guarded one's), or its `RodOptions.patience`."""

    WHOLE = 0
    FORCE = 1
    PATIENCE = 2


@dataclass(frozen=True)
class RodOptions:
    """Limits. tolerance: largest sum of unbalanced forces over the sum of contact forces [-]. faint: contact forces
    under this count as this there [N]; with the defaults a joint is off by under 0.1 mN m, a thousandth of the noise of
    its sensor. force_limit: on the way in no frame is kept that is past it [N]. guarded: False, a touch ends there, on
    the way out too; True, the arm slows down, turns back and keeps its number of frames, as `guard` says, unless it
    comes to a protective stop on the way back;
    hold, out: frames that it then stands still, and at least goes back. newton: iterations of one try at a stride,
    travel: with those in which something goes as far as it may, which `newton` does not count. work: of a frame, after
    which no stride is tried again in shorter ones. patience: of a touch, after which it ends, None for no end.
    room: places for contacts of a touch. share: Newton iterations of a touch in one launch, None for as many as suit
    the device; it changes no bit.
    lanes: threads of a CPU that work on a touch, 1, or 32 with `warp.config.enable_cpu_blocks` (slow, for tests); a GPU
    always has 32."""

    tolerance: float = 1e-4
    faint: float = 1.0
    force_limit: float = np.inf
    guarded: bool = False
    hold: int = 0
    out: int = 0
    newton: int = 60
    travel: int = 400
    work: int = 800
    patience: int | None = None
    room: int = ROOM
    share: int | None = None
    lanes: int = 1


@dataclass(frozen=True)
class RodFrames:
    """T frames of B touches by K capsules. Frames after a touch's last one are NaN (False, 0).

    frames: of each touch that were solved (B,); ended: why no more, `Ended` (B,). force: on each capsule (T, B, K, 3)
    [N]; moment: about its origin, world (T, B, K, 3) [N m].
    reaction: force of the pot on the plant (T, B, 3) [N]; reaction_moment: about the clamped node (T, B, 3) [N m].
    converged: (T, B). reason: `frames.Reason` (T, B). residual: (T, B) [-]. iterations: Newton's (T, B). energy:
    elastic (T, B) [J]. penetration: deepest sample inside a capsule (T, B) [m].
    contacts: samples in contact (T, B). slipping: their share that slips (T, B) [-]. force_balance: |force on capsules
    - reaction - weight| over the larger, or over 0.1 N (T, B) [-].
    where: the arm on its way (T, B), in numbers of poses.
    nodes: positions (T, B, N, 3) [m], turns: quaternions x y z w (T, B, N, 4), or None.
    """

    frames: np.ndarray
    ended: np.ndarray
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
    where: np.ndarray
    nodes: np.ndarray | None
    turns: np.ndarray | None

    def columns(self, some: slice) -> RodFrames:
        """Those of some touches."""
        parts = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return RodFrames(**{name: None if a is None else a[some] if a.ndim == 1 else a[:, some] for name,
                            a in parts.items()})

    @staticmethod
    def joined(parts: Sequence[RodFrames]) -> RodFrames:
        """Those of some batches of as many frames, one after the other."""

        def one(name: str) -> np.ndarray | None:
            arrays = [getattr(p, name) for p in parts]
            return None if arrays[0] is None else np.concatenate(arrays, axis=min(arrays[0].ndim - 1, 1))

        return RodFrames(**{f.name: one(f.name) for f in dataclasses.fields(RodFrames)})  # type: ignore[arg-type]


class RodSolver:
    """Touches of some plants by K capsules.

    Args:
        models: the plants. shapes: of the capsules; one of length 0 is a ball. device: Warp device. options: limits.

    Raises:
        RodError: no plant, a shape that is no capsule, or too many of them.
    """

    def __init__(self, models: Sequence[RodModel], shapes: Sequence[Capsule], *, device: str = "cpu",
                 options: RodOptions | None = None):
        self.models, self.shapes, self.device, self.options = (list(models), list(shapes), device,
                                                               options or RodOptions())
        if not self.models or not self.shapes:
            raise RodError("a rod solver needs at least one plant and one capsule.")
        for shape in self.shapes:
            if not isinstance(shape, Capsule):
                raise RodError(f"plants are touched by capsules only, not by {shape!r}; give "
                               f"vsfsim.core.shape.Capsule, of length 0 for a ball.")
        if len(self.shapes) > MOST:
            raise RodError(f"{len(self.shapes)} capsules, at most {MOST} can touch plants together.")
        self.trees = make_trees(self.models, device)
        self.weighs = int(any(m.weight.any() for m in self.models))

    def run(self, plant: np.ndarray, poses: np.ndarray, *, friction: np.ndarray | float = 0.0,
            frames: np.ndarray | None = None, plan: np.ndarray | None = None, inward: np.ndarray | None = None,
            keep_nodes: bool = False, progress: Callable[[int, int], None] | None = None) -> RodFrames:
        """Carry out touches.

        Args:
            plant: number of the touched plant of each touch (B,). poses: of the capsules along the way, z along their
            axes (P, B, K, 4, 4) [m]. friction: (B,) or one for all [-].
            plan: where on the way, in numbers of poses, each frame is (B, T), None for one frame a pose. frames: of
            each touch (B,), None for T. inward: those before the planned way out (B,), None for all.
            keep_nodes: return where the nodes are. progress: called with the number of frames newly done and of the
            touches that go on.

        Raises:
            RodError: shapes that do not fit, or poses that are not finite.
        """
        p, b = len(poses), len(np.asarray(plant))
        plan = np.tile(np.arange(p, dtype=float), (b, 1)) if plan is None else np.asarray(plan, float)
        batch = RodBatch(self, b, frames=plan.shape[1], poses=p, keep_nodes=keep_nodes)
        batch.add(plant, poses, plan=plan, friction=friction, frames=frames, inward=inward)
        while batch.live:
            new = batch.advance()
            if progress is not None:
                progress(new, batch.live)
        return batch.take(slice(0, b))


class RodBatch:
    """Places for touches on a device; they come and go while others are under way.

    Args:
        solver: with the plants. places: for how many touches. frames, poses: the most of a touch, and of its way.
        keep_nodes: return where the nodes are.
    """

    def __init__(self, solver: RodSolver, places: int, *, frames: int, poses: int, keep_nodes: bool = False):
        self.solver, self.keep_nodes, self._poses = solver, keep_nodes, poses
        self._wide, options, shapes = max(len(m.plant.nodes) for m in solver.models), solver.options, solver.shapes
        self._plant = np.zeros(places, np.int32)
        self._frames, self._next, self._ended = np.zeros((3, places), np.int32)
        self._taken = np.zeros(places, bool)
        with wp.ScopedDevice(solver.device):
            self._touch = make_touches(places, frames, poses, [0.5 * s.length for s in shapes],
                                       [s.radius for s in shapes])
            touch = self._touch
            touch.guarded, touch.hold, touch.out = int(options.guarded), options.hold, options.out
            touch.newton, touch.travel, touch.work = options.newton, options.travel, options.work
            touch.patience = ENDLESS if options.patience is None else options.patience
            touch.force_limit, touch.tolerance, touch.faint = (float(options.force_limit), float(options.tolerance),
                                                               float(options.faint))
            self._work = make_work(places, self._wide, len(shapes), options.room,
                                   max(len(levels_of(m)[1]) for m in solver.models))
            self._out = make_results(places, frames, len(shapes), self._wide if keep_nodes else 0)
            self._clock = wp.zeros(1, dtype=wp.uint64)
        self._gpu = wp.get_device(solver.device).is_cuda

    @property
    def live(self) -> int:
        """Touches that go on."""
        return int(self._going().sum())

    def _going(self) -> np.ndarray:
        return self._taken & (self._next < self._frames) & (self._ended == 0)

    def room(self, touches: int) -> bool:
        """Whether there are places for so many touches more."""
        return self._free(touches) is not None

    def _free(self, touches: int) -> int | None:
        """The first of so many free places in a row."""
        begin = 0
        for place in range(len(self._taken)):
            if self._taken[place]:
                begin = place + 1
            elif place + 1 - begin == touches:
                return begin
        return None

    def add(self, plant: np.ndarray, poses: np.ndarray, *, plan: np.ndarray, friction: np.ndarray | float = 0.0,
            frames: np.ndarray | None = None, inward: np.ndarray | None = None) -> slice:
        """Begin touches; the arguments are those of `RodSolver.run`.

        Returns:
            Their places; they are free again after `take`.

        Raises:
            RodError: shapes that do not fit, poses that are not finite, or no room.
        """
        models, k = self.solver.models, len(self.solver.shapes)
        plant, poses = np.asarray(plant, np.int32), np.asarray(poses, float)
        p, b, t = poses.shape[0], len(plant), plan.shape[1] if plan.ndim == 2 else 0
        if poses.shape != (p, b, k, 4, 4) or p == 0 or b == 0:
            raise RodError(f"poses have the shape {poses.shape} for {b} touches and {k} capsules; give (T, {b}, "
                           f"{k}, 4, 4).")
        if not np.isfinite(poses).all():
            raise RodError("a pose is not finite; leave out frames that the arm cannot reach.")
        if plan.shape != (b, t) or not ((plan >= 0.0) & (plan <= p - 1)).all():
            raise RodError(f"the plan has the shape {plan.shape} and numbers {plan.min():g} to {plan.max():g}; give "
                           f"({b}, frames) numbers of the {p} poses, from 0.")
        if plant.min() < 0 or plant.max() >= len(models):
            raise RodError(f"a touch is of plant {int(plant.max())}, but there are {len(models)}, counted from 0.")
        friction = np.broadcast_to(np.asarray(friction, float), (b,))
        if not ((friction >= 0.0) & (friction <= 10.0)).all():
            raise RodError(f"friction is {friction.min():g} to {friction.max():g}; it must be from 0 to 10.")
        begin = self._free(b)
        if begin is None or p > self._poses or t > self._touch.plan.shape[1]:
            raise RodError(f"no room for {b} touches of {t} frames and {p} poses: {int((~self._taken).sum())} places "
                           f"for {self._touch.plan.shape[1]} and {self._poses} are free.")
        some = slice(begin, begin + b)
        self._taken[some], self._plant[some], self._next[some], self._ended[some] = True, plant, 0, 0
        self._frames[some] = t if frames is None else frames

        def put(array: wp.array, values: np.ndarray) -> None:
            array[some].assign(np.ascontiguousarray(values.astype(np.int32 if array.dtype is wp.int32 else np.float64)))

        def along(values: np.ndarray) -> np.ndarray:
            """(P, B, ...) as the device has it; poses past the last one are never read."""
            return np.concatenate([np.swapaxes(values, 0, 1), np.repeat(values[-1][:, None], self._poses - p, axis=1)],
                                  axis=1)

        with wp.ScopedDevice(self.solver.device):
            touch = self._touch
            put(touch.plant, plant)
            put(touch.friction, friction)
            put(touch.frames, self._frames[some])
            put(touch.last, np.full(b, p - 1))
            put(touch.inward, self._frames[some] if inward is None else np.asarray(inward))
            put(touch.plan, np.pad(plan, ((0, 0), (0, touch.plan.shape[1] - t))))
            put(touch.place, along(poses[..., :3, 3]))
            put(touch.turn, along(quaternions(poses[..., :3, :3])))
            wp.launch(enter, dim=(b, self._wide), inputs=[self.solver.trees, touch, begin], outputs=[self._work])
        return some

    def advance(self, *, seconds: float = GPU_SPAN) -> int:
        """One launch for all touches that go on, on a GPU for about so many seconds [s]; the number of frames newly
        done.

        Those with most frames before them go first: if not all find room at once, the hardest do.
        """
        live = np.flatnonzero(self._going())
        if not len(live):
            return 0
        options, before = self.solver.options, int(self._next[self._taken].sum())
        if self._gpu:
            live = live[np.argsort(self._next[live] - self._frames[live], kind="stable")]
        lanes, share, span = (LANES, options.share or ENDLESS,
                              round(1e9 * seconds)) if self._gpu else (options.lanes, options.share or CPU_SHARE, 0)
        with wp.ScopedDevice(self.solver.device):
            self._clock.zero_()
            wp.launch(advance, dim=len(live) * lanes, inputs=[self.solver.trees, self._touch,
                                                              wp.array(live, dtype=wp.int32), lanes, share, span,
                                                              self.solver.weighs],
                      outputs=[self._clock, self._work, self._out], block_dim=lanes)
            self._next[:], self._ended[:] = self._work.next.numpy(), self._work.ended.numpy()
        return int(self._next[self._taken].sum()) - before

    def done(self, some: slice) -> bool:
        """Whether all of these touches have ended."""
        return not self._going()[some].any()

    def take(self, some: slice) -> RodFrames:
        """The frames of some touches, as far as they are; their places are free."""
        out, models = self._out, self.solver.models
        count, ended, plant = np.minimum(self._frames[some], self._next[some]), self._ended[some], self._plant[some]
        done = np.where(ended > 0, np.minimum(ended - 1, count), count)
        # a frame past the force limit was the one before `next`, and is not kept; a frame after which the patience was
        # over is
        why = np.where(done == self._frames[some], Ended.WHOLE,
                       np.where(ended <= self._next[some], Ended.FORCE, Ended.PATIENCE))
        why = np.where(ended > 0, why, Ended.WHOLE)
        t = out.residual.shape[1]
        solved = np.arange(t)[:, None] < done[None, :]

        def of(array: wp.array) -> np.ndarray:
            return np.ascontiguousarray(np.swapaxes(array[some].numpy(), 0, 1))

        reaction = of(out.reaction)
        # spatial vectors come out as (top, bottom)
        root, root_moment = reaction[..., :3].copy(), reaction[..., 3:].copy()
        force, moment = of(out.force), of(out.moment)
        reason = np.where(solved, of(out.reason), 0)
        weight = np.stack([models[p].weight.sum(axis=0) for p in plant])
        weight -= np.stack([models[p].weight[0] for p in plant])  # what rests on the clamp itself bends nothing
        whole = force.sum(axis=2)
        gap = np.linalg.norm(whole - root - weight, axis=-1)
        size = np.maximum(np.maximum(np.linalg.norm(whole, axis=-1), np.linalg.norm(root, axis=-1)), SMALL_FORCE)
        floats = [np.where(solved, of(a), np.nan) for a in (out.residual, out.energy, out.penetration, out.slipping,
                                                            out.where)]
        for array in (force, moment, root, root_moment):
            array[~solved] = np.nan
        self._taken[some] = False
        return RodFrames(done, why, force, moment, root, root_moment, solved & (reason == 0), reason, floats[0],
                         np.where(solved, of(out.iterations), 0), floats[1], floats[2],
                         np.where(solved, of(out.contacts), 0), floats[3], np.where(solved, gap / size, np.nan),
                         floats[4], of(out.x) if self.keep_nodes else None, of(out.q) if self.keep_nodes else None)
