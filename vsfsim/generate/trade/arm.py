"""The touches of plants by an arm, made again on shorter beams and in the arm's other mode."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from vsfsim.core.plant import Plant
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.data.records import Touch
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.admit import beams
from vsfsim.generate.plants.prepare import Subject, prepare_job
from vsfsim.generate.plants.touches import finish_touches, solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.run import kernels_of
from vsfsim.generate.trade.curve import Curve
from vsfsim.generate.trade.made import Meter, Run
from vsfsim.generate.trade.setting import Ground, Setting
from vsfsim.physics.runtime import compile_kernels

CANDIDATES = 2
"""Lines that are drawn for each that is taken."""
SLIP = 0.05
"""Share of the largest force that is lost from one frame to the next where a branch slips, lets go or has no
equilibrium [-]."""
MET = 0.2
"""A line that meets less met nothing [N]."""
_NO_LIMIT = 1e6  # [N]; every mesh makes the frames that the scene's own makes


class ArmTouches:
    """Touches of the first plants of a scene with ``[arm]``, aimed once; see `vsfsim.generate.trade.made.Touched`.

    Each follows the line that the arm has found, as far as it goes on the scene's own beams before the force limit, cut
    short where a branch slips, lets go or has no equilibrium: that is another frame on other beams, and what follows is
    of two equilibria, which cannot be compared. Of `CANDIDATES` times as many lines the first are taken that meet more
    than `MET` until then; where these are too few, there are others of one frame, which met nothing.

    Args:
        loaded: the scene.
        touches: of each plant.
        objects: how many plants.
        first: number of the first.
        seed: as of `vsfsim generate`.
        device: Warp device.
        cache: not used; plants have no filled meshes.

    Raises:
        SceneError: nothing can be reached.
    """

    def __init__(self, loaded: SceneFile, *, touches: int, objects: int = 1, first: int = 0, seed: int = 0,
                 device: str = "cpu", cache: Path | None = None):
        recipe = make_recipe(loaded, seed=seed, objects=first + objects, views=1, touches=CANDIDATES * touches,
                             device=device)
        scene = loaded.sample(0)
        self.ground = Ground("rod", None, None, None, ("rod",), device, arm=scene.required_arm.mode)
        compile_kernels(kernels_of(scene), device)
        self._alone: list[Subject] = []  # with one touch each
        self._plants, slips = objects, 0
        for job in jobs_of(recipe, loaded.path, ".", cache)[first:]:
            whole = prepare_job(job, device=device)
            (frames,) = solve([whole], device=device)
            lines = []
            for k, a in enumerate(whole.aims):
                end = min(int(frames.frames[k]), a.inward)
                size = np.linalg.norm(frames.force[:end, k].sum(axis=1), axis=1)
                force = np.where(frames.converged[:end, k], size, 0.0)
                n = held(force)
                lines.append((k, n, n < end) if force[:n].max(initial=0.0) > MET else (k, 1, False))
            for k, n, slipped in sorted(lines, key=lambda one: one[1] == 1)[:touches]:
                slips += slipped
                own = dataclasses.replace(whole.aims[k], plan=whole.aims[k].plan[:n], inward=n)
                self._alone.append(dataclasses.replace(whole, aims=[own], poses=whole.poses[:, k:k + 1],
                                                       scene=_without_limit(whole.scene)))
        self.count = len(self._alone)
        self.what = (f"{self.count} touch{'es' * (self.count > 1)} of {objects} plant{'s' * (objects > 1)} along "
                     f"straight lines, {slips} of them cut short where a branch slips, lets go "
                     f"or has no equilibrium")

    def run(self, setting: Setting) -> Run:
        """All touches."""
        return _run(self._alone, self._plants, setting)

    def near(self, number: int, setting: Setting) -> Run:
        """Touch ``number`` alone; all beams of a ladder are shorter, wherever the touch is."""
        return _run(self._alone[number:number + 1], 1, setting)


def held(force: np.ndarray) -> int:
    """How many frames of a touch with these forces (T,) [N] are compared: as far as there is a force, cut short at
    the last but one before a branch slips, lets go or has no equilibrium."""
    lost = np.flatnonzero(np.diff(force) < -SLIP * force.max(initial=0.0))
    pressed = np.flatnonzero(force > 0.0)
    return max(1, int(lost[0]) if len(lost) else int(pressed[-1]) + 1 if len(pressed) else 1)


def _run(alone: list[Subject], plants: int, setting: Setting) -> Run:
    """The touches of some subjects with one each, of so many plants."""
    meter = Meter()
    models = [(parted(s.plant, setting.parts or 1), s) for s in alone]
    ready = [dataclasses.replace(s, plant=plant, model=beams(plant, s.scene), scene=_in_mode(s.scene, setting.arm))
             for plant, s in models]
    once, _, _ = meter.read()
    meter.restart()
    touches = [touch for s in ready for touch in finish_touches(s, *solve([s], device=setting.device))]
    cpu, wall, memory = meter.read()
    edge = tuple(float(np.mean(s.plant.lengths())) for s in ready)
    return Run(tuple(_curve(t, s) for t, s in zip(touches, ready, strict=True)), once / len(ready) * plants,
               cpu, wall, memory, sum(len(t.time) for t in touches), edge)


def parted(plant: Plant, parts: int) -> Plant:
    """The same plant with every segment cut into ``parts`` of equal length, each with the section and the modulus of
    the whole; a segment's last node stays the one that others grow from."""
    if parts == 1:
        return plant
    n = len(plant.nodes)
    end = np.concatenate([[0], parts * np.arange(1, n)])  # new number of every node
    owner = np.concatenate([[0], np.repeat(np.arange(1, n), parts)])
    share = np.concatenate([[0.0], np.tile(np.arange(1, parts + 1) / parts, n - 1)])[:, None]
    start = plant.nodes[np.maximum(plant.parent, 0)]
    parent = np.arange(-1, parts * (n - 1))
    first = 1 + parts * np.arange(n - 1)
    parent[first] = end[plant.parent[1:]]
    nodes = (1.0 - share) * start[owner] + share * plant.nodes[owner]
    nodes[end] = plant.nodes
    rows = {f.name: value[owner] for f in dataclasses.fields(plant)
            if f.name not in ("nodes", "parent") and isinstance(value := getattr(plant, f.name), np.ndarray)}
    return dataclasses.replace(plant, nodes=nodes, parent=parent, **rows)


def _curve(touch: Touch, subject: Subject) -> Curve:
    """Net force and joint torques over the way of the tool."""
    (a,) = subject.aims
    assert touch.torque is not None
    plan = np.linspace(0.0, 1.0, len(a.plan) + 1)[1:]
    on = np.arange(min(len(plan), len(touch.time)))
    found = touch.converged[on]
    return Curve(plan[on], {"force": np.linalg.norm(np.where(found[:, None], touch.force[on], 0.0), axis=1),
                            "direction": touch.force[on], "torque": touch.torque[on]}, found, ~found)


def _without_limit(scene: Scene) -> Scene:
    return dataclasses.replace(scene, touches=dataclasses.replace(scene.required_touches, force_limit=_NO_LIMIT),
                               arm=dataclasses.replace(scene.required_arm, at_limit="end"))


def _in_mode(scene: Scene, mode: str | None) -> Scene:
    return scene if mode is None else dataclasses.replace(scene, arm=dataclasses.replace(scene.required_arm, mode=mode))
