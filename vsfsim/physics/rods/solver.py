"""The host side of the rod solver: touches of plants by the capsules of an arm.

The touches of a batch advance together but independently, and may be of different plants.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.shape import Capsule
from vsfsim.physics.rods.kernels.advance import advance
from vsfsim.physics.rods.kernels.lanes import LANES
from vsfsim.physics.rods.model import BLADE_SPACING, ENDLESS, RodError, RodModel, RodOptions
from vsfsim.physics.rods.structs import Results, Touches, Work, allocate, levels_of, make_trees, quaternions, start

SMALL_FORCE = 0.1  # least force that an imbalance is compared with in `RodFrames.force_balance` [N]
CPU_SHARE = 1000  # Newton iterations of a touch in one launch on a CPU: some seconds for a view on a core
# Duration of a launch on a GPU [s]. It ends up to 1 s later, as an attempt at a stride is not interrupted. Touches for
# which it had no multiprocessor go first in the next one.
GPU_SPAN = 10.0
MOST_CAPSULES = 31  # the contact search has a bit for each


class Ended(IntEnum):
    """Why a touch has no more frames."""

    WHOLE = 0
    """It has all of them."""
    FORCE = 1
    """The force limit, or the protective stop of a guarded touch."""
    PATIENCE = 2
    """`RodOptions.patience`."""


@dataclass(frozen=True)
class RodFrames:
    """T frames of B touches by K capsules. Frames after the last one of a touch are NaN (False, 0)."""

    frames: np.ndarray
    """Number of solved frames of each touch (B,)."""
    ended: np.ndarray
    """`Ended` (B,)."""
    force: np.ndarray
    """Force on each capsule (T, B, K, 3) [N]."""
    moment: np.ndarray
    """Moment on each capsule about its origin, in the world (T, B, K, 3) [N m]."""
    reaction: np.ndarray
    """Force of the pot on the plant (T, B, 3) [N]."""
    reaction_moment: np.ndarray
    """Moment of the pot on the plant about the clamped node (T, B, 3) [N m]."""
    converged: np.ndarray
    """Whether the frame is an equilibrium (T, B) bool."""
    reason: np.ndarray
    """`frames.Reason` (T, B)."""
    residual: np.ndarray
    """Unbalanced force over contact force (T, B) [-]."""
    iterations: np.ndarray
    """Newton iterations (T, B)."""
    energy: np.ndarray
    """Elastic energy (T, B) [J]."""
    heat: np.ndarray
    """Work that yielding wires have turned into heat since the touch began (T, B) [J]."""
    penetration: np.ndarray
    """Depth of the deepest point inside a capsule (T, B) [m]."""
    contacts: np.ndarray
    """Number of patches in contact, pairs of a fibre of the plant and a capsule (T, B)."""
    slipping: np.ndarray
    """Share of the points in contact that slip (T, B) [-]."""
    force_balance: np.ndarray
    """|force on the capsules - reaction - weight| over the larger of force and reaction, or over 0.1 N (T, B) [-]."""
    where: np.ndarray
    """Position of the arm on its way (T, B) [poses]."""
    nodes: np.ndarray | None
    """Positions of the nodes (T, B, N, 3) [m], or None."""
    turns: np.ndarray | None
    """Rotations of the nodes since rest, quaternions x y z w (T, B, N, 4), or None."""

    @staticmethod
    def joined(parts: Sequence[RodFrames]) -> RodFrames:
        """The touches of several batches with the same number of frames."""

        def one(name: str) -> np.ndarray | None:
            arrays = [getattr(p, name) for p in parts]
            return None if arrays[0] is None else np.concatenate(arrays, axis=min(arrays[0].ndim - 1, 1))

        return RodFrames(**{f.name: one(f.name) for f in dataclasses.fields(RodFrames)})  # type: ignore[arg-type]


class RodSolver:
    """Touches of some plants by K capsules.

    Args:
        models: the plants.
        shapes: the capsules; one of length 0 is a ball.
        device: Warp device.
        options: limits.

    Raises:
        RodError: there is no plant or no capsule, a shape is not a capsule, there are too many, or a capsule is so thin
            that it would slip between the contact fibres of a leaf blade.
    """

    def __init__(self, models: Sequence[RodModel], shapes: Sequence[Capsule], *, device: str = "cpu",
                 options: RodOptions | None = None):
        self.models, self.shapes = list(models), list(shapes)
        self.device, self.options = device, options or RodOptions()
        if not self.models or not self.shapes:
            raise RodError("a rod solver needs at least one plant and one capsule.")
        for shape in self.shapes:
            if not isinstance(shape, Capsule):
                raise RodError(f"plants are touched by capsules only, not by {shape!r}; give "
                               f"vsfsim.core.shape.Capsule, of length 0 for a ball.")
        if len(self.shapes) > MOST_CAPSULES:
            raise RodError(f"{len(self.shapes)} capsules, at most {MOST_CAPSULES} can touch plants together.")
        thinnest = min(shape.radius for shape in self.shapes)
        if thinnest < BLADE_SPACING and any(m.plant.half_width.max() > 0.0 for m in self.models):
            raise RodError(f"a capsule has a radius of {1e3 * thinnest:g} mm, and a plant has leaf blades, which are "
                           f"felt along lines {1e3 * BLADE_SPACING:g} mm apart: it would pass between them. Give at "
                           f"least that radius.")
        self.trees = make_trees(self.models, device)
        self.weighs = int(any(m.weight.any() for m in self.models))

    def run(self, plant: np.ndarray, poses: np.ndarray, *, friction: np.ndarray | float = 0.0,
            plan: np.ndarray | None = None, inward: np.ndarray | None = None, keep_nodes: bool = False) -> RodFrames:
        """Carry out touches.

        Args:
            plant: number of the touched plant (B,).
            poses: poses of the capsules along the way, z along their axes (P, B, K, 4, 4) [m].
            friction: coefficient of friction (B,), or one for all [-].
            plan: position of each frame on the way, in numbers of poses (B, T); None for one frame a pose.
            inward: number of frames before the planned way out (B,), None for all.
            keep_nodes: return the states of the nodes.

        Raises:
            RodError: shapes do not fit, or poses are not finite.
        """
        p, b = len(poses), len(np.asarray(plant))
        plan = np.tile(np.arange(p, dtype=float), (b, 1)) if plan is None else np.asarray(plan, float)
        batch = RodBatch(self, b, frames=plan.shape[1], poses=p, keep_nodes=keep_nodes)
        batch.add(plant, poses, plan=plan, friction=friction, inward=inward)
        while batch.live:
            batch.advance()
        return batch.take(slice(0, b))


class RodBatch:
    """Places for touches on a device. Touches may be added and taken while others are computed.

    Args:
        solver: the solver with the plants.
        places: number of touches.
        frames, poses: largest number of frames of a touch, and of poses on its way.
        keep_nodes: return the states of the nodes.
    """

    def __init__(self, solver: RodSolver, places: int, *, frames: int, poses: int, keep_nodes: bool = False):
        self.solver, self.keep_nodes, self._poses = solver, keep_nodes, poses
        self._wide, options, shapes = max(len(m.plant.nodes) for m in solver.models), solver.options, solver.shapes
        self._plant = np.zeros(places, np.int32)
        self._frames, self._next, self._ended = np.zeros((3, places), np.int32)
        self._taken = np.zeros(places, bool)
        sizes = {"B": places, "N": self._wide, "T": frames, "W": poses, "K": len(shapes), "C": options.room,
                 "D": max(len(levels_of(m)[1]) for m in solver.models) + 1, "V": frames if keep_nodes else 0}
        with wp.ScopedDevice(solver.device):
            self._touch, self._work = allocate(Touches, **sizes), allocate(Work, **sizes)
            self._out = allocate(Results, **(sizes if keep_nodes else {**sizes, "N": 0}))
            touch = self._touch
            touch.half.assign(np.array([0.5 * s.length for s in shapes]))
            touch.radius.assign(np.array([s.radius for s in shapes], float))
            for field in dataclasses.fields(options):
                setattr(touch.limits, field.name, getattr(options, field.name))
            self._clock = wp.zeros(1, dtype=wp.uint64)
        self._gpu = wp.get_device(solver.device).is_cuda

    @property
    def live(self) -> int:
        """Number of unfinished touches."""
        return int(self._going().sum())

    def _going(self) -> np.ndarray:
        return self._taken & (self._next < self._frames) & (self._ended == 0)

    def room(self, touches: int) -> bool:
        """Whether there are free places for so many touches."""
        return self._free(touches) is not None

    def _free(self, touches: int) -> int | None:
        """The first of so many consecutive free places."""
        begin = 0
        for place in range(len(self._taken)):
            if self._taken[place]:
                begin = place + 1
            elif place + 1 - begin == touches:
                return begin
        return None

    def add(self, plant: np.ndarray, poses: np.ndarray, *, plan: np.ndarray, friction: np.ndarray | float = 0.0,
            inward: np.ndarray | None = None) -> slice:
        """Adds touches; the arguments are those of `RodSolver.run`.

        Returns:
            Their places, which are free again after `take`.

        Raises:
            RodError: shapes do not fit, poses are not finite, or there is no room.
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
        friction = np.broadcast_to(np.asarray(friction, float), (b,))
        if not ((friction >= 0.0) & (friction <= 10.0)).all():
            raise RodError(f"friction is {friction.min():g} to {friction.max():g}; it must be from 0 to 10.")
        begin = self._free(b)
        if begin is None or p > self._poses or t > self._touch.plan.shape[1]:
            raise RodError(f"no room for {b} touches of {t} frames and {p} poses: {int((~self._taken).sum())} places "
                           f"for {self._touch.plan.shape[1]} and {self._poses} are free.")
        some = slice(begin, begin + b)
        self._taken[some], self._plant[some], self._next[some], self._ended[some] = True, plant, 0, 0
        self._frames[some] = t

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
            put(touch.last_pose, np.full(b, p - 1))
            put(touch.inward, self._frames[some] if inward is None else np.asarray(inward))
            put(touch.plan, np.pad(plan, ((0, 0), (0, touch.plan.shape[1] - t))))
            put(touch.position, along(poses[..., :3, 3]))
            put(touch.rotation, along(quaternions(poses[..., :3, :3])))
            start(self._work, [models[p] for p in plant], some, plan)
        return some

    def advance(self, *, seconds: float = GPU_SPAN) -> int:
        """One launch for all unfinished touches, on a GPU for about ``seconds`` [s]. Returns the number of new frames.

        The touches with most frames to go come first, in case the device cannot hold all of them at once.
        """
        live = np.flatnonzero(self._going())
        if not len(live):
            return 0
        options, before = self.solver.options, int(self._next[self._taken].sum())
        if self._gpu:
            live = live[np.argsort(self._next[live] - self._frames[live], kind="stable")]
        if self._gpu:
            lanes, share, span = LANES, options.share or ENDLESS, round(1e9 * seconds)
        else:
            lanes, share, span = options.lanes, options.share or CPU_SHARE, 0
        with wp.ScopedDevice(self.solver.device):
            self._clock.zero_()
            inputs = [self.solver.trees, self._touch, wp.array(live, dtype=wp.int32), lanes, share, span,
                      self.solver.weighs]
            wp.launch(advance, dim=len(live) * lanes, inputs=inputs, outputs=[self._clock, self._work, self._out],
                      block_dim=lanes)
            progress = self._work.progress.numpy()
            self._next[:], self._ended[:] = progress["next"], progress["ended"]
        return int(self._next[self._taken].sum()) - before

    def done(self, some: slice) -> bool:
        """Whether all of these touches have ended."""
        return not self._going()[some].any()

    def take(self, some: slice) -> RodFrames:
        """The frames of some touches, as far as they are solved; frees their places."""
        out, models = self._out, self.solver.models
        count, ended, plant = np.minimum(self._frames[some], self._next[some]), self._ended[some], self._plant[some]
        done = np.where(ended > 0, np.minimum(ended - 1, count), count)
        # a frame above the force limit is not kept and precedes `next`; the frame that exhausted the patience is kept
        why = np.where((ended == 0) | (done == self._frames[some]), Ended.WHOLE,
                       np.where(ended <= self._next[some], Ended.FORCE, Ended.PATIENCE))
        rows = np.swapaxes(out.frame[some].numpy(), 0, 1)
        solved = np.arange(len(rows))[:, None] < done[None, :]
        of_frame = {name: np.where(solved, rows[name], np.nan if rows[name].dtype == float else 0)
                    for name in rows.dtype.names if name != "reaction"}

        def of(array: wp.array) -> np.ndarray:
            return np.ascontiguousarray(np.swapaxes(array[some].numpy(), 0, 1))

        force, moment, reaction = of(out.force), of(out.moment), rows["reaction"].copy()
        for values in (force, moment, reaction):
            values[~solved] = np.nan
        root, root_moment = reaction[..., :3], reaction[..., 3:]
        # the load on the clamped node bends nothing
        weight = np.stack([models[p].weight[1:].sum(axis=0) for p in plant])
        whole = force.sum(axis=2)
        size = np.maximum(np.maximum(np.linalg.norm(whole, axis=-1), np.linalg.norm(root, axis=-1)), SMALL_FORCE)
        self._taken[some] = False
        return RodFrames(frames=done, ended=why, force=force, moment=moment, reaction=root, reaction_moment=root_moment,
                         converged=solved & (of_frame["reason"] == 0), **of_frame,
                         force_balance=np.linalg.norm(whole - root - weight, axis=-1) / size,
                         nodes=of(out.x) if self.keep_nodes else None, turns=of(out.q) if self.keep_nodes else None)
