"""The same touches of a scene under one setting after another: their curves, what they cost, and their limits."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from measurements.measurement import factorise
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.data.manifest import NOISE
from vsfsim.data.records import Touch
from vsfsim.data.verify import unresolved_frames
from vsfsim.generate.aim import Aim
from vsfsim.generate.effector import effector_of
from vsfsim.generate.job import jobs_of
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.solid import Subject, prepare
from vsfsim.generate.trade.buy import ground_of
from vsfsim.generate.trade.setting import LIMIT_TIER, RATIO, Setting
from vsfsim.generate.truth import probe_stiffness
from vsfsim.physics import tiers
from vsfsim.physics.convergence import Limit, curve_limit, frames_limit
from vsfsim.physics.linear.rest_factor import forget_all
from vsfsim.physics.mesh.scan import forget_fillings

REFINED = ((1, 0), (0, 0), (-1, 0), (-2, 1))
"""Settings with small elements where each touch meets the object: those elsewhere as the scene's own times `RATIO` to
such a power, and the level there."""
CANDIDATES = 3
"""Touches that are drawn for each that is taken."""
LARGEST = 0.03
"""Error of a limit from which it counts as unknown [-]."""
WHOLE = 0.75
"""Share of the frames of a touch that must have an equilibrium on all meshes of its limit [-]."""


@dataclass(frozen=True)
class Curve:
    """Readings of one touch on its way in."""

    share: np.ndarray
    """Of the depth in each frame (T,), rising to 1 [-]."""
    readings: Mapping[str, np.ndarray]
    """By name, each (T, ...), zero without contact: force = its normal component [N], direction = the force as a vector
    (T, 3) [N], torque = moment about the mount (T, 3) [N m], pressure = its change [Pa], dense = force on every node of
    a bubble (T, N, 3) [N]; stiffness = of a small tip where the touch aims (1,) [N/m]."""
    converged: np.ndarray
    """(T,) bool."""
    marked: np.ndarray
    """Frames in contact that did not converge, or are not resolved by the mesh (T,) bool."""


def of_touch(touch: Touch, aim: Aim, stiffness: np.ndarray) -> Curve:
    """The way in of a touch that was aimed so; the first of several frames at full depth is its last. ``stiffness`` is
    that of a small tip (1,) [N/m]."""
    share = (touch.mount_pose[:, :3, 3] - aim.contact) @ aim.axis / aim.depth
    stop = int(np.argmax(share > 1.0 - 1e-6)) + 1
    on = np.arange(stop)[share[:stop] > 1e-6]
    readings = {"force": touch.normal_force()[on], "direction": touch.force[on], "stiffness": stiffness}
    if touch.moment is not None and touch.pressure is not None and touch.node_force is not None:
        readings |= {"torque": touch.moment[on], "pressure": touch.pressure[on]
                     - touch.rest_pressure, "dense": touch.node_force[on].astype(float)}
    return Curve(share[on], readings, touch.converged[on], (~touch.converged | unresolved_frames(touch))[on])


@dataclass(frozen=True)
class Run:
    """The touches under one setting."""

    curves: tuple[Curve, ...]
    """One a touch."""
    once: float
    """CPU time of what is made once an object: mesh, factor and the truth's stiffness [s]."""
    cpu: float
    """CPU time of all touches, without that, but with meshes that are made for one touch [s]."""
    frames: int
    """Frames that were solved, the way back too."""
    edge: tuple[float, ...] = ()
    """Of the elements that matter to each touch [m]."""

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return msgspec.to_builtins(self, enc_hook=np.ndarray.tolist)

    @classmethod
    def read(cls, table: Any) -> Run:
        """As `table` gave it."""
        return msgspec.convert(table, cls, dec_hook=lambda _, values: np.array(values))


class DatasetTouches:
    """Touches of objects of a scene, aimed once.

    Of `CANDIDATES` times as many that are drawn, those are taken that cover depths and places: one from each part of
    the depths, the farthest from those taken before.

    Args:
        loaded: the scene, with ``[touches]``.
        touches: of each object.
        objects: how many.
        first: number of the first.
        seed: as of `vsfsim generate`.
        device: Warp device.

    Raises:
        SceneError: the scene cannot be touched so.
    """

    def __init__(self, loaded: SceneFile, *, touches: int, objects: int = 1, first: int = 0, seed: int = 0,
                 device: str = "cpu"):
        recipe = make_recipe(loaded, seed=seed, objects=first + objects, views=1, touches=CANDIDATES * touches)
        scene, whole = loaded.sample(0), make_recipe(loaded)
        self.ground, self.effector = ground_of(loaded, device=device)
        self.own = Setting(recipe.tier, tiers.element_size(scene.required_object, recipe.tier, scene.probe))
        """The scene's own tier and elements."""
        self.frames = scene.required_touches.frames[1]
        """Readings on the way in."""
        self.readings = whole.views * whole.touches * sum(scene.required_touches.frames)
        """Of an object: frames of all its touches."""
        self.pressable = [name for name in tiers.TIERS if name != "fem-fine" and self._can(scene, name)]
        """Tiers at which its effector can touch."""
        self._device, self._warm = device, set[str]()
        subjects = [prepare(job, device=device) for job in jobs_of(recipe, loaded.path, ".")[first:]]
        drawn = [(subject, self.effector.aim(subject, device=device)) for subject in subjects]
        self._drawn = [(subject, [aims[k] for k in spread([a.depth for a in aims], np.stack([a.target for a in aims]),
                                                          touches)]) for subject, aims in drawn]
        self.drawn = [(subject, a) for subject, own in self._drawn for a in own]
        """Of each touch, its object and how it was aimed."""
        self.count = len(self.drawn)
        depths = sorted({f"{1e3 * a.depth:.1f}" for _, a in self.drawn}, key=float)
        self.what = (f"{self.count} touch{'es' * (self.count > 1)} of {objects} object{'s' * (objects > 1)}, "
                     f"{' to '.join(dict.fromkeys((depths[0], depths[-1])))} mm deep")
        """The touches in words."""

    def _can(self, scene: Scene, tier: str) -> bool:
        try:  # what a tier that does not show the scene's needs errs is measured, too
            return effector_of(scene).check(dataclasses.replace(scene, needs=()), tier) == tier
        except SceneError:
            return False

    def run(self, setting: Setting) -> Run:
        """All touches.

        Raises:
            VsfsimError: the setting cannot be built.
        """
        if setting.tier not in self._warm:  # what loads kernels and packages before the clock runs
            self._warm.add(setting.tier)
            subject, aims = self._drawn[0]
            self._run(subject, aims[:1], dataclasses.replace(setting, frames=1, tolerance=0.05))
        parts = [self._run(subject, aims, setting) for subject, aims in self._drawn]
        return Run(tuple(c for p in parts for c in p.curves), sum(p.once for p in parts), sum(p.cpu for p in parts),
                   sum(p.frames for p in parts), tuple(h for p in parts for h in p.edge))

    def near(self, number: int, setting: Setting) -> Run:
        """Touch ``number`` alone, on a mesh of its own that is finer where it is touched."""
        subject, a = self.drawn[number]
        return self._run(subject, [a], setting)

    def _run(self, subject: Subject, aims: list[Aim], setting: Setting) -> Run:
        """The touches as those of a new object: no factor and no filling that was kept for another setting serves."""
        effector, once, cpu, touches, soft, edge = self.effector, 0.0, 0.0, list[Touch](), list[float](), list[float]()
        forget_all()
        forget_fillings()
        for some in [aims] if setting.level is None else [[a] for a in aims]:
            began = time.process_time()
            own = effector.on(subject, some[0], setting)
            factorise(own.model)
            built = time.process_time()
            touches += effector.touch(own, some, device=self._device)
            done = time.process_time()
            soft += probe_stiffness(own.model, *(np.stack([getattr(a, key) for a in some])
                                                 for key in ("target", "normal"))).tolist()
            edge += [own.model.element_size if setting.level is None
                     else effector.contact_edge(subject.scene, a, setting.level)[1] for a in some]
            # a mesh for one touch is its own; one for all touches is made once for the object, as the truth's stiffness
            cpu += done - built + (built - began) * (setting.level is not None)
            once += time.process_time() - done + (built - began) * (setting.level is None)
        curves = tuple(of_touch(t, a, np.array([s])) for t, a, s in zip(touches, aims, soft, strict=True))
        return Run(curves, once, cpu, sum(len(t.time) for t in touches), tuple(edge))


def sweep(of: DatasetTouches) -> list[Setting]:
    """Each tier by element size, small elements at the contact; then the tolerance, the frames and a bubble's nodes
    alone."""
    tier, size, nodes = of.ground.tier, of.ground.resolution, of.ground.nodes
    out = [Setting(name, size * RATIO**power) for name in of.pressable
           for power in ((-1, -2) if name == LIMIT_TIER else (1, 0, -1))]
    if LIMIT_TIER in of.pressable:
        out += [Setting(LIMIT_TIER, size * RATIO**power, level=level) for power, level in REFINED]
    loose = 10.0 * tiers.TIERS[tier].tolerance
    out += [Setting(tier, size, tolerance=value) for value in (loose, loose / 100.0)]
    out += [Setting(tier, size, frames=count)
            for count in sorted({max(1, of.frames // 2), 2 * of.frames} - {of.frames})]
    return out if nodes is None else [*out, *(Setting(tier, size, nodes=count) for count in (nodes // 2, 2 * nodes))]


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


def limits(ladder: Sequence[Run]) -> tuple[dict[str, Limit], np.ndarray]:
    """The limit of every reading of a touch, and its depths over the deepest (T,) [-].

    Frames that have no equilibrium on one of the meshes are left out if there are few; else no limit is known.

    Args:
        ladder: the touch alone on each mesh, coarsest first, with frames at the same depths.
    """
    curves = [run.curves[0] for run in ladder]
    found = {name: np.stack([c.readings[name] for c in curves]) for name in curves[0].readings}
    on = np.all([c.converged for c in curves], axis=0)
    few = on.mean() >= WHOLE and on[-1]
    nothing = not np.any(found["force"])
    for name, values in found.items():
        if name != "stiffness":
            found[name] = values[:, on] if few else np.where(on.reshape(-1, *[1] * (values.ndim - 2)), values, np.nan)
    if nothing:
        found["force"] = np.full(found["force"].shape, np.nan)
    edge, tolerance = [run.edge[0] for run in ladder], tiers.TIERS[LIMIT_TIER].tolerance
    out = {name: frames_limit(edge, values, NOISE, tolerance=tolerance) if name == "force" else
           curve_limit(edge, values, tolerance=tolerance) for name, values in found.items()}
    if nothing:
        out["force"] = dataclasses.replace(out["force"], why="it met nothing")
    return (out, curves[-1].share[on] if few else curves[-1].share)


def unsure(limit: Limit) -> float:
    """Root mean square of the error of a limit over its largest value [-]."""
    return float(np.sqrt(np.mean(limit.error**2)) / max(float(np.abs(limit.value).max(initial=0.0)), 1e-300))


def is_known(limit: Limit) -> bool:
    """Whether a limit is sure enough to measure by."""
    return unsure(limit) <= LARGEST
