"""Support and query touches: the draws of a task, and the readings behind them.

All draws come from `SeedSequence(protocol.seed, spawn_key=...)`: the query set of an object from (0, object, view), the
support order of a seed from (1, object, view, seed). A support set of k touches is the first k of that order, so the 5
touches of a seed contain its 1 touch.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from vsfsim.bench.method import Action, Reading, Specimen, Surface, frozen, frozen_view
from vsfsim.bench.noise import Noise
from vsfsim.bench.noise_bubble import noisy_node_force, noisy_nodes
from vsfsim.bench.task import ALL, Protocol, Task
from vsfsim.core.errors import TaskError
from vsfsim.data.records import ObjectView, Touch


@dataclass(frozen=True)
class Recording:
    """All touches of one object view as the task shows them, with their noise-free readings."""

    name: str
    """Of the object view."""
    readings: tuple[Reading, ...]
    """Noisy, one a touch."""
    clean: tuple[np.ndarray, ...]
    """Noise-free, (T, d) in the task's unit, one a touch."""


def record(view: ObjectView, task: Task) -> Recording:
    """Reduce the touches of ``view`` to readings, with the task's noise on them.

    Raises:
        TaskError: the dataset does not hold what the task reads.
    """
    row = task.observation
    readings, clean = [], []
    for index, touch in enumerate(view.touches):
        which = {"object_index": view.object_index, "view_index": view.view_index, "touch_index": index}
        values = row.channel.clean(touch)
        if values is None:
            raise TaskError(f"object view '{view.name}' touch {index} has no {row.channel.name}, which task "
                            f"{task.name} reads; its dataset must be made with {row.channel.made_with}.")
        values, force = _where_converged(values, touch), _where_converged(touch.force, touch)
        noisy = row.channel.noisy(values, touch.time, force, task.noise, **which)
        action = Action(frozen(touch.time), frozen(touch.mount_pose), frozen(touch.axis), view.probe, row.name,
                        row.size, None if touch.q is None else frozen(touch.q))
        readings.append(Reading(action, frozen(row.reading(noisy, touch.axis)), frozen(touch.converged),
                                _surface(touch, task.noise, which)))
        clean.append(row.reading(values, touch.axis))
    return Recording(view.name, tuple(readings), tuple(clean))


def _where_converged(values: np.ndarray, touch: Touch) -> np.ndarray:
    """``values`` (T, ...), NaN in the frames that did not converge."""
    return np.where(touch.converged.reshape(-1, *[1] * (values.ndim - 1)), values, np.nan)


def _surface(touch: Touch, noise: Noise, which: Mapping[str, int]) -> Surface | None:
    """The sensor's surface with the noise of its inside camera; None where the dataset does not hold one."""
    if touch.node_position is None or touch.node_force is None:
        return None
    nodes = touch.node_position
    if noise.depth_std or noise.depth_quantum or noise.image_lag:
        nodes = noisy_nodes(nodes, touch.mount_pose, touch.time, noise, **which)  # type: ignore[arg-type]
    force = noisy_node_force(_where_converged(touch.node_force, touch), touch.time, noise, **which)
    return Surface(frozen(nodes), frozen(force))


def specimen(view: ObjectView, task: Task) -> Specimen:
    """A training object as methods receive it: all touches that have a reading."""
    recording = record(view, task)
    return Specimen(view.name, frozen_view(view.view), tuple(r for r in recording.readings if r.valid.any()))


@dataclass(frozen=True)
class Draw:
    """The fixed division of a test object's touches."""

    query: tuple[int, ...]
    """Indices of the touches that are predicted at every shot and seed, ascending."""
    pool: tuple[int, ...]
    """Indices of the other touches that have a reading, ascending."""


def divide(view: ObjectView, protocol: Protocol) -> Draw:
    """Choose the query touches of a test object.

    Raises:
        TaskError: there are too few touches with a reading for the query set and the largest support set.
    """
    usable = np.array([i for i, touch in enumerate(view.touches) if touch.converged.any()], dtype=int)
    need = protocol.query + max(protocol.shots)
    if len(usable) < need:
        raise TaskError(f"object view '{view.name}' has {len(usable)} touches with a converged frame; {protocol.query} "
                        f"query touches and {max(protocol.shots)} shots need {need}. Generate more touches, or lower "
                        f"query or shots in a task of your own.")
    stream = np.random.SeedSequence(protocol.seed, spawn_key=(0, view.object_index, view.view_index))
    order = np.random.default_rng(stream).permutation(usable)
    return Draw(tuple(sorted(int(i) for i in order[:protocol.query])),
                tuple(sorted(int(i) for i in order[protocol.query:])))


class Numbered(typing.Protocol):
    """An object view, or what stands for one, with the numbers that choose its random streams."""

    @property
    def object_index(self) -> int:
        """From 0."""

    @property
    def view_index(self) -> int:
        """Of the view of that object, from 0."""


def support(view: Numbered, draw: Draw, label: str, seed: int, protocol: Protocol) -> tuple[int, ...]:
    """Indices of the support touches for shot ``label`` ("0", "5", "all") and ``seed``, in the order they are given."""
    if label == ALL:
        return draw.pool
    stream = np.random.SeedSequence(protocol.seed, spawn_key=(1, view.object_index, view.view_index, seed))
    order = np.random.default_rng(stream).permutation(np.array(draw.pool, dtype=int))
    return tuple(int(i) for i in order[:int(label)])
