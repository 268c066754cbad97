"""The same touches of a scene under one setting after another: their curves, and what they cost."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.generate.aim import Aim
from vsfsim.generate.effector import effector_of, kernels_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import Subject, prepare
from vsfsim.generate.trade.curve import of_press, of_touch
from vsfsim.generate.trade.made import Meter, Run, Touched, together
from vsfsim.generate.trade.near import contact_edge, near, touch_near
from vsfsim.generate.trade.setting import Ground, Setting
from vsfsim.generate.truth import probe_stiffness
from vsfsim.physics import tiers
from vsfsim.physics.runtime import compile_kernels

CANDIDATES = 3
"""Touches that are drawn for each that is taken."""


class DatasetTouches:
    """Touches of the first objects of a scene with ``[touches]``, aimed once.

    Of `CANDIDATES` times as many that are drawn, those are taken that cover depths and places: one from each part of
    the depths, the farthest from those taken before.

    Args:
        loaded: the scene.
        touches: of each object.
        objects: how many.
        first: number of the first.
        seed: as of `vsfsim generate`.
        device: Warp device.
        cache: folder of filled meshes, or None for the user's own.

    Raises:
        SceneError: the scene cannot be touched so.
    """

    def __init__(self, loaded: SceneFile, *, touches: int, objects: int = 1, first: int = 0, seed: int = 0,
                 device: str = "cpu", cache: Path | None = None):
        recipe = make_recipe(loaded, seed=seed, objects=first + objects, views=1, touches=CANDIDATES * touches)
        scene = loaded.sample(0)
        self.ground = _ground(scene, recipe.tier, scene.required_touches.frames[1], device)
        effector = effector_of(scene)
        assert isinstance(effector, OnSolids)
        self._effector, self._warm = effector, set[str | None]()
        compile_kernels(kernels_of(scene), device)
        self.subjects: list[Subject] = []
        self.aims: list[list[Aim]] = []
        for job in jobs_of(recipe, loaded.path, ".", cache)[first:]:
            subject = prepare(job, device=device)
            drawn = effector.aim(subject, device=device)
            self.subjects.append(subject)
            self.aims.append([drawn[k] for k in spread([a.depth for a in drawn], np.stack([a.target for a in drawn]),
                                                       touches)])
        self.count = sum(map(len, self.aims))
        depths = sorted({f"{1e3 * a.depth:.1f}" for own in self.aims for a in own}, key=float)
        self.what = (f"{self.count} touch{'es' * (self.count > 1)} of {objects} object{'s' * (objects > 1)}, "
                     f"{' to '.join(dict.fromkeys((depths[0], depths[-1])))} mm deep")

    def run(self, setting: Setting) -> Run:
        """See `Touched`."""
        if setting.tier not in self._warm:
            self._warm.add(setting.tier)
            self._run(self.subjects[0], self.aims[0][:1], _brief(setting))
        parts = [self._run(subject, aims, setting) for subject, aims in zip(self.subjects, self.aims, strict=True)]
        return together(parts)

    def near(self, number: int, setting: Setting) -> Run:
        """See `Touched`."""
        flat = [(subject, a) for subject, own in zip(self.subjects, self.aims, strict=True) for a in own]
        subject, a = flat[number]
        return self._run(subject, [a], setting, alone=True)

    def _run(self, subject: Subject, aims: list[Aim], setting: Setting, alone: bool = False) -> Run:
        meter = Meter()
        tier = setting.tier
        assert tier is not None
        reach = self._effector.manner(subject.scene).reach
        own = (near(subject, aims[0], reach, setting.options()) if alone
               else subject.again(tier, setting.options()))
        once, _, _ = meter.read()
        meter.restart()
        touches = (self._effector.touch(own, aims, device=setting.device) if alone
                   else touch_near(self._effector, own, aims, device=setting.device))
        cpu, wall, memory = meter.read()
        curves = [of_touch(touch, a) for touch, a in zip(touches, aims, strict=True)]
        if tier in ("linear", "fem-coarse", "fem", "fem-fine"):  # with tetrahedra
            soft = probe_stiffness(own.model, np.stack([a.target for a in aims]), np.stack([a.normal for a in aims]))
            curves = [dataclasses.replace(c, readings={**c.readings, "stiffness": soft[k:k + 1]})
                      for k, c in enumerate(curves)]
        return Run(tuple(curves), once, cpu, wall, memory, sum(len(t.time) for t in touches),
                   tuple(own.model.element_size if setting.level is None else contact_edge(a, reach, setting.level)[1]
                         for a in aims))


class ScenePress:
    """The ``[press]`` of a scene, of one seed or of several.

    Args:
        loaded: the scene.
        touches: seeds, from ``seed`` on; one for a scene without distributions.
        seed: of the first.
        device: Warp device.
        cache: folder of filled meshes, or None for the user's own.
    """

    def __init__(self, loaded: SceneFile, *, touches: int, seed: int = 0, device: str = "cpu",
                 cache: Path | None = None):
        self._loaded, self._cache, self._warm = loaded, cache, False
        scenes = [loaded.sample(seed + k) for k in range(touches)]
        self._seeds = [seed + k for k in range(touches) if k == 0 or scenes[k] != scenes[0]]
        scene = scenes[0]
        assert scene.press is not None
        tier = None if scene.object is None else tiers.choose(scene)
        self.count = len(self._seeds)
        self.ground = _ground(scene, tier, scene.press.frames[0] if len(scene.press.frames) == 1 else None, device)
        self.what = f"the press of the scene{f', {self.count} seeds' * (self.count > 1)}"

    def run(self, setting: Setting) -> Run:
        """See `Touched`."""
        if setting.level is not None:
            raise SceneError("a press has small elements where it touches at every setting.")
        if not self._warm:
            self._warm = True
            self._run(self._seeds[0], _brief(setting))
        return together([self._run(seed, setting) for seed in self._seeds])

    def near(self, number: int, setting: Setting) -> Run:
        """See `Touched`; a press has its elements where it touches on every mesh."""
        return self._run(self._seeds[number], setting)

    def _run(self, seed: int, setting: Setting) -> Run:
        meter = Meter()
        varied = _varied(self._loaded, setting)
        request = Request(seed=seed, tier=setting.tier, device=setting.device, cache=self._cache,
                               tolerance=setting.tolerance)
        result = effector_of(varied.sample(seed)).press(varied, request)
        cpu, wall, memory = meter.read()
        solve = float(np.sum(result.more["seconds"]))
        return Run((of_press(result),), max(cpu - solve, 0.0), solve, max(wall - result.more["build_seconds"], 0.0),
                   memory, len(result.depth), (result.edge,))


def touched(loaded: SceneFile, *, touches: int, objects: int, seed: int, device: str, cache: Path | None,
            first: int = 0) -> Touched:
    """The touches of a scene's objects from the ``first`` one on, or its press.

    Raises:
        SceneError: it has neither.
    """
    if "touches" in loaded.tree:
        return DatasetTouches(loaded, touches=touches, objects=objects, first=first, seed=seed, device=device,
                              cache=cache)
    if "press" not in loaded.tree:
        raise SceneError(f"{loaded.path}: there is neither [touches] nor [press], so there is nothing whose error and "
                         f"time could be measured. Add one of them.")
    return ScenePress(loaded, touches=touches, seed=seed, device=device, cache=cache)


def spread(depth: Sequence[float], place: np.ndarray, count: int) -> list[int]:
    """``count`` of the candidates, one from each part of their depths, far from one another.

    Args:
        depth: of each candidate [m].
        place: of each (n, 3) [m].
        count: how many.
    """
    parts = np.array_split(np.argsort(depth, kind="stable"), count)
    taken = [int(parts[0][0])]
    for part in parts[1:]:
        away = np.linalg.norm(place[part][:, None] - place[taken][None], axis=2).min(axis=1)
        taken.append(int(part[away.argmax()]))
    return taken


def _ground(scene: Scene, tier: str | None, frames: int | None, device: str) -> Ground:
    effector = effector_of(scene)
    if not isinstance(effector, OnSolids):
        raise SceneError(f"{scene.source}: what a [{effector.table}] touches cannot be touched again on another mesh. "
                         f"Speed against accuracy is measured for a [probe] and a [sensor] on a solid object.")
    manner, order = effector.manner(scene), list(tiers.TIERS)
    if tier is None:
        return Ground(None, None, frames, manner.nodes, (), device)
    start = max(tier, "fem-coarse", key=order.index)
    return Ground(start, tiers.element_size(scene.required_object, start, scene.probe), frames, manner.nodes,
                  tuple(name for name in manner.tiers if name != "fem-fine"), device)


def _brief(setting: Setting) -> Setting:
    """What loads kernels and packages before the clock runs."""
    return dataclasses.replace(setting, frames=1, tolerance=0.05)


def _varied(loaded: SceneFile, setting: Setting) -> SceneFile:
    """The scene file with what a setting says of it, and without needs, which would refuse cheap tiers."""
    tree: dict[str, Any] = {key: dict(value) if isinstance(value, dict) else value for key, value in loaded.tree.items()
                            if key != "needs"}
    for table, key, value in (("object", "resolution", setting.resolution), ("sensor", "nodes", setting.nodes),
                              ("press", "frames", setting.frames)):
        if value is not None:
            tree[table][key] = value
    return dataclasses.replace(loaded, tree=tree)
