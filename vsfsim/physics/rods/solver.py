"""The host side of the rod solver: touches of plants by the capsules of an arm.

The touches of a batch advance together but independently, and may be of different plants.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core.shape import Capsule
from vsfsim.physics.rods import structs
from vsfsim.physics.rods.kernels.advance import advance
from vsfsim.physics.rods.kernels.lanes import LANES
from vsfsim.physics.rods.model import BLADE_SPACING, RodError, RodModel, RodOptions, quaternions
from vsfsim.physics.rods.structs import allocate, filled, make_trees, started

SMALL_FORCE = 0.1  # least force that an imbalance is compared with in `RodFrames.force_balance` [N]
MOST_CAPSULES = 31  # the contact search has a bit for each


@dataclass(frozen=True)
class RodFrames:
    """T frames of B touches by K capsules. Frames after the last one of a touch are NaN (False, 0)."""

    frames: np.ndarray
    """Number of solved frames of each touch (B,)."""
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
    force_balance: np.ndarray
    """|force on the capsules - reaction - weight| over the larger of force and reaction, or over 0.1 N (T, B) [-]."""
    nodes: np.ndarray | None
    """Positions of the nodes (T, B, N, 3) [m], or None."""
    turns: np.ndarray | None
    """Rotations of the nodes since rest, quaternions x y z w (T, B, N, 4), or None."""

    def of(self, some: slice) -> RodFrames:
        """The frames of some of the touches."""
        def one(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else values[some] if values.ndim == 1 else values[:, some]

        return RodFrames(**{f.name: one(getattr(self, f.name)) for f in dataclasses.fields(self)})  # type: ignore


class RodSolver:
    """Touches of some plants by K capsules.

    Args:
        models: the plants.
        shapes: the capsules; one of length 0 is a ball.
        device: Warp device.
        options: limits.

    Raises:
        RodError: there are too many capsules, or one is so thin that it would slip between the contact fibres of a leaf
            blade.
    """

    def __init__(self, models: Sequence[RodModel], shapes: Sequence[Capsule], *, device: str = "cpu",
                 options: RodOptions | None = None):
        self.models, self.shapes = list(models), list(shapes)
        self.device, self.options = device, options or RodOptions()
        if len(self.shapes) > MOST_CAPSULES:
            raise RodError(f"{len(self.shapes)} capsules, at most {MOST_CAPSULES} can touch plants together.")
        thinnest = min(shape.radius for shape in self.shapes)
        if thinnest < BLADE_SPACING and any(m.plant.half_width.max() > 0.0 for m in self.models):
            raise RodError(f"a capsule has a radius of {1e3 * thinnest:g} mm, and a plant has leaf blades, which are "
                           f"felt along lines {1e3 * BLADE_SPACING:g} mm apart: it would pass between them. Give at "
                           f"least that radius.")
        self.trees = make_trees(self.models, device)

    def run(self, plant: np.ndarray, poses: np.ndarray, *, friction: np.ndarray | float = 0.0,
            plan: np.ndarray | None = None, keep_nodes: bool = False,
            progress: Callable[[int], None] = lambda _: None) -> RodFrames:
        """Carry out touches.

        Args:
            plant: number of the touched plant (B,).
            poses: poses of the capsules along the way, z along their axes (P, B, K, 4, 4) [m].
            friction: coefficient of friction (B,), or one for all [-].
            plan: number of the pose on the way of each frame (B, T); None for one frame a pose.
            keep_nodes: return the states of the nodes.
            progress: called with the number of frames newly done, launch by launch.

        Raises:
            RodError: poses, friction or plan are of another shape or out of their range.
        """
        plant, poses = np.asarray(plant, np.int32), np.asarray(poses, float)
        p, b = len(poses), len(plant)
        plan = np.tile(np.arange(p), (b, 1)) if plan is None else np.asarray(plan)
        friction = np.broadcast_to(np.asarray(friction, float), (b,))
        if poses.shape != (p, b, len(self.shapes), 4, 4) or not (poses.size and np.isfinite(poses).all()):
            raise RodError(f"poses are {poses.shape}; give finite ones of {b} touches by {len(self.shapes)} capsules.")
        if not (friction.min() >= 0 and plan.shape[:-1] == (b,) and np.isin(plan, range(p)).all()):
            raise RodError(f"friction is {friction} and plan {plan}; give friction of 0 at least, "
                           f"and in plan numbers of the {p} poses, a row for each of {b} touches.")
        t, options = plan.shape[1], self.options
        sizes = {"B": b, "N": max(len(m.plant.nodes) for m in self.models), "T": t, "K": len(self.shapes),
                 "C": options.room, "D": max(len(m.arrays["level"]) for m in self.models) + 1,
                 "V": t if keep_nodes else 0}
        sizes["M"] = max(sizes["N"], sizes["K"])
        lanes = LANES if wp.get_device(self.device).is_cuda else 1
        with wp.ScopedDevice(self.device):
            limits = structs.Limits()
            for field in dataclasses.fields(options):
                setattr(limits, field.name, getattr(options, field.name))
            touch = filled(
                structs.Touches, limits=limits, plant=plant, friction=friction, plan=plan,
                half=np.array([0.5 * s.length for s in self.shapes]), radius=np.array([s.radius for s in self.shapes]),
                position=np.swapaxes(poses[..., :3, 3], 0, 1),
                rotation=np.swapaxes(quaternions(poses[..., :3, :3]), 0, 1))
            work = started([self.models[k] for k in plant], **sizes)
            out = allocate(structs.Results, **sizes)
            live, before = np.arange(b), 0
            while len(live):
                # the touches with most frames to go come first, in case the device cannot hold all of them at once
                wp.launch(advance, dim=len(live) * lanes, block_dim=lanes, outputs=[work, out],
                          inputs=[self.trees, touch, wp.array(live, dtype=wp.int32), lanes])
                at = work.progress.numpy()
                live = np.flatnonzero((at["next"] < t) & (at["ended"] == 0))
                live = live[np.argsort(at["next"][live], kind="stable")]
                progress(int(at["next"].sum()) - before)
                before = int(at["next"].sum())
        return self._frames(plant, at["next"] - at["ended"], out, keep_nodes)

    def _frames(self, plant: np.ndarray, done: np.ndarray, out: Any, keep_nodes: bool) -> RodFrames:
        """What the touches of ``plant`` have given, of which ``done`` frames are kept."""
        def of(array: wp.array) -> np.ndarray:
            return np.ascontiguousarray(np.swapaxes(array.numpy(), 0, 1))

        rows, force, moment = of(out.frame), of(out.force), of(out.moment)
        solved = np.arange(len(rows))[:, None] < done[None, :]
        of_frame = {name: np.where(solved, rows[name], np.nan if rows[name].dtype == float else 0)
                    for name in rows.dtype.names or () if name != "reaction"}
        reaction = rows["reaction"].copy()
        for values in (force, moment, reaction):
            values[~solved] = np.nan
        root, root_moment = reaction[..., :3], reaction[..., 3:]
        # the load on the clamped node bends nothing
        weight = np.stack([self.models[p].arrays["load"][1:].sum(axis=0) for p in plant])
        whole = force.sum(axis=2)
        size = np.maximum(np.maximum(np.linalg.norm(whole, axis=-1), np.linalg.norm(root, axis=-1)), SMALL_FORCE)
        return RodFrames(frames=done, force=force, moment=moment, reaction=root, reaction_moment=root_moment,
                         converged=solved & (of_frame["reason"] == 0), **of_frame,
                         force_balance=np.linalg.norm(whole - root - weight, axis=-1) / size,
                         nodes=of(out.x) if keep_nodes else None, turns=of(out.q) if keep_nodes else None)
