"""Which touches are seen and which are asked: the draws of a task, and the readings behind them.

All draws come from `SeedSequence(protocol.seed, spawn_key=...)`: the query set of an object from (0, object, view), the
support order of a seed from (1, object, view, seed). A support set of k touches is the first k of that order, so the 5
touches of a seed contain its 1 touch.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vsfsim.bench.method import Action, Reading, Specimen, Surface, frozen, frozen_view
from vsfsim.bench.noise import noisy_force
from vsfsim.bench.noise_bubble import noisy_node_force, noisy_nodes, noisy_pressure
from vsfsim.bench.noise_torque import noisy_torque
from vsfsim.bench.task import ALL, Protocol, Task
from vsfsim.core.errors import TaskError
from vsfsim.data.records import ObjectView, Touch


@dataclass(frozen=True)
class Recording:
    """All touches of one object view as the task shows them, and the noise-free readings as the ruler keeps them.

    name: of the object view. readings: noisy, one a touch. clean: noise-free (T, d) each.
    """

    name: str
    readings: tuple[Reading, ...]
    clean: tuple[np.ndarray, ...]


def record(view: ObjectView, task: Task) -> Recording:
    """Reduce the touches of ``view`` to readings, with the task's noise on them.

    Raises:
        TaskError: the task reads the pressure, or the joint torques, and the dataset has none.
    """
    readings, clean = [], []
    for index, touch in enumerate(view.touches):
        action = Action(frozen(touch.time), frozen(touch.mount_pose), frozen(touch.axis), view.probe,
                        task.observation.name, task.observation.size,
                        None if touch.q is None else frozen(touch.q))
        force = np.where(touch.converged[:, None], touch.force, np.nan)
        which = {"object_index": view.object_index, "view_index": view.view_index, "touch_index": index}
        if task.observation.source == "pressure":
            signal = _pressure_change(touch, f"object view '{view.name}' touch {index}", task)
            noisy = noisy_pressure(signal, touch.time, force, task.noise, **which)
        elif task.observation.source == "torque":
            if touch.torque is None or touch.q is None:
                raise TaskError(f"object view '{view.name}' touch {index} has no joint torques, which task {task.name} "
                                f"reads; its dataset must be made by an arm, an [arm] in the scene.")
            signal = np.where(touch.converged[:, None], touch.torque, np.nan)
            noisy = noisy_torque(signal, touch.time, force, task.noise, **which)
        else:
            signal = force
            noisy = noisy_force(force, task.noise, time=touch.time, **which)
        surface = None
        if touch.node_position is not None and touch.node_force is not None:
            noise = task.noise
            nodes = touch.node_position
            if noise.depth_std or noise.depth_quantum or noise.image_lag:
                nodes = noisy_nodes(nodes, touch.mount_pose, touch.time, noise, **which)
            pushed = noisy_node_force(np.where(touch.converged[:, None, None], touch.node_force, np.nan), touch.time,
                                      noise, **which)
            surface = Surface(frozen(nodes), frozen(pushed))
        readings.append(Reading(action, frozen(task.observation.of(noisy, touch.axis)), frozen(touch.converged),
                                surface))
        clean.append(task.observation.of(signal, touch.axis))
    return Recording(view.name, tuple(readings), tuple(clean))


def _pressure_change(touch: Touch, where: str, task: Task) -> np.ndarray:
    if touch.pressure is None or touch.rest_pressure is None:
        raise TaskError(f"{where} has no pressure, which task {task.name} reads; its dataset must be made with a "
                        f"bubble, a [sensor] in the scene.")
    return np.where(touch.converged, touch.pressure - touch.rest_pressure, np.nan)


def specimen(view: ObjectView, task: Task) -> Specimen:
    """A training object as a method sees it: all touches that have a reading."""
    recording = record(view, task)
    return Specimen(view.name, frozen_view(view.view), tuple(r for r in recording.readings if r.valid.any()))


@dataclass(frozen=True)
class Draw:
    """The fixed division of a test object's touches.

    query: indices asked at every shot and seed, ascending. pool: the others that have a reading, ascending.
    """

    query: tuple[int, ...]
    pool: tuple[int, ...]


def divide(view: ObjectView, protocol: Protocol) -> Draw:
    """Choose the query touches of a test object.

    Raises:
        TaskError: too few touches with a reading for the query set and the largest support set.
    """
    usable = np.array([i for i, touch in enumerate(view.touches) if touch.converged.any()], dtype=int)
    need = protocol.query + max(protocol.shots)
    if len(usable) < need:
        raise TaskError(f"object view '{view.name}' has {len(usable)} touches with a converged frame; {protocol.query} "
                        f"query touches and "
                        f"{max(protocol.shots)} shots need {need}. Generate more touches, or lower query or shots in a "
                        f"task of your own.")
    stream = np.random.SeedSequence(protocol.seed, spawn_key=(0, view.object_index, view.view_index))
    order = np.random.default_rng(stream).permutation(usable)
    return Draw(tuple(sorted(int(i) for i in order[:protocol.query])),
                tuple(sorted(int(i) for i in order[protocol.query:])))


def support(view: ObjectView, draw: Draw, label: str, seed: int, protocol: Protocol) -> tuple[int, ...]:
    """Indices of the support touches for shot ``label`` ("0", "5", "all") and ``seed``, in the order they are given."""
    if label == ALL:
        return draw.pool
    stream = np.random.SeedSequence(protocol.seed, spawn_key=(1, view.object_index, view.view_index, seed))
    order = np.random.default_rng(stream).permutation(np.array(draw.pool, dtype=int))
    return tuple(int(i) for i in order[:int(label)])
