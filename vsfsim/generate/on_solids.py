"""What all effectors that touch solids do alike: views, drawings, and touches on a mesh that is fine where they are.

The elements are small over the whole disc that a touch will meet, not at its middle alone, because its rim is where the
pressure falls with an infinite slope.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from vsfsim.core.scene import Scene
from vsfsim.core.shape import ProbeShape
from vsfsim.data.manifest import NOISE, apart
from vsfsim.data.records import ObjectView, Touch
from vsfsim.data.streams import Stream
from vsfsim.generate.aim import Aim
from vsfsim.generate.effector import Drawing
from vsfsim.generate.job import Job
from vsfsim.generate.solid import Subject, prepare, surface_of
from vsfsim.generate.trade.setting import LIMIT_TIER, LOCAL, MESHES, RATIO, Setting
from vsfsim.generate.truth import truth_of
from vsfsim.generate.workers import make_each
from vsfsim.physics import tiers
from vsfsim.physics.convergence import frames_limit
from vsfsim.physics.mesh.edge_refine import EdgePath
from vsfsim.physics.mesh.quadratic import quadratic_mesh
from vsfsim.sensing.cut import Elements


class OnSolids(abc.ABC):
    """An effector that touches solids, whose touches can be made again, as they were aimed, on another model of the
    object; see `vsfsim.generate.effector.Effector`."""

    @abc.abstractmethod
    def reach(self, scene: Scene) -> float:
        """Radius of what meets the solid of a scene, about [m]."""

    @abc.abstractmethod
    def shapes(self, subject: Subject, aims: Sequence[Aim]) -> tuple[ProbeShape, list[ProbeShape], float]:
        """The shape that a dataset names, that of each touch, and their friction with the oracle's particles [-]."""

    @abc.abstractmethod
    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """The touches of a subject, one for each that its scene counts.

        Raises:
            SceneError: nothing is visible, or no target can be reached.
        """

    @abc.abstractmethod
    def touch(self, subject: Subject, aims: Sequence[Aim], *, device: str) -> list[Touch]:
        """What is read of some touches.

        Args:
            subject: the object; its recipe says the tier and the tolerance.
            aims: the touches, which may have been aimed at another model of it.
            device: Warp device.
        """

    def make_view(self, job: Job, *, device: str) -> ObjectView:
        """Build, look, aim, press."""
        subject = prepare(job, device=device)
        aims = self.aim(subject, device=device)
        promise, share = job.recipe.options.get("accuracy"), subject.scene.required_touches.contact_edge
        edge = tiers.element_size(subject.scene.required_object, job.recipe.tier, subject.scene.probe)
        if promise is not None:
            touches = self._promised(subject, aims, promise, device=device)
        elif share is not None:
            own = Setting(job.recipe.tier, edge, level=math.log(LOCAL / share, RATIO))
            touches = self.touched(subject, aims, own, device=device)
        else:
            touches = self.touch(subject, aims, device=device)
        probe, each, friction = self.shapes(subject, aims)
        finer = () if promise is None else [subject.again(Setting(job.recipe.tier, edge / RATIO**k)).model
                                            for k in range(1, MESHES)]
        truth = truth_of(subject.model, subject.view, touches, each, friction=friction, device=device, finer=finer)
        return ObjectView(job.name, job.object_index, job.view_index, job.split, probe,
                          subject.recorded, tuple(touches), truth,
                          tuple(press.probe for press in subject.scene.presses[1:]))

    def contact_edge(self, scene: Scene, a: Aim, level: float) -> tuple[float, float]:
        """Radius of the disc that a touch will meet, sqrt(r d) of a ball of radius r that is pressed d deep (Hertz),
        and longest edge of the elements in it on a ``level``, see `LOCAL` [m]."""
        radius = float(np.sqrt(self.reach(scene) * (a.depth + a.late)))
        return radius, LOCAL * radius / RATIO**level

    def on(self, subject: Subject, a: Aim, setting: Setting) -> Subject:
        """The object under a setting; where that has a level, with small elements where a touch meets it.

        Raises:
            SceneError, MeshError: it cannot be built.
        """
        if setting.level is None:
            return subject.again(setting)
        scene, tier = subject.scene, setting.tier
        radius, size = self.contact_edge(scene, a, setting.level)
        own = tiers.element_size(dataclasses.replace(scene.required_object, resolution=None), tier, scene.probe)
        # what `tiers.body` makes of the half-width of an edge
        share = tiers.TIERS[tier].probe * min(1.0, setting.resolution / own)
        side = np.cross(a.axis, np.eye(3)[np.abs(a.axis).argmin()])
        side /= np.linalg.norm(side)
        at = a.target + size * _disc(radius / size) @ np.stack([side, np.cross(a.axis, side)])
        ends = np.stack([at - 2.0 * radius * a.axis, at + 2.0 * radius * a.axis])
        return subject.again(setting, edges=EdgePath(ends, np.full(len(at), size / share)))

    def touched(self, subject: Subject, aims: Sequence[Aim], setting: Setting, *, device: str) -> list[Touch]:
        """The touches of a subject under a setting, each on a mesh of its own where that has a level."""
        return [one for some in ([aims] if setting.level is None else [[a] for a in aims]) if some
                for one in self.touch(self.on(subject, some[0], setting), some, device=device)]

    def reference(self, subject: Subject, a: Aim, ladder: Sequence[Setting], *, made: Mapping[Setting, Touch],
                  device: str) -> dict[str, np.ndarray]:
        """Columns of the audit of a touch: its force extrapolated from the meshes of a ladder, its error (see
        `vsfsim.physics.convergence.frames_limit`), and the frames with an equilibrium on all; ``made`` is there."""
        each = [made.get(setting) or self.touched(subject, [a], setting, device=device)[0] for setting in ladder]
        found = np.all([one.converged & np.isfinite(one.force).all(axis=1) for one in each], axis=0)
        value, error = np.zeros((len(found), 3)), np.zeros(len(found))
        if found.any():
            edge = [self.contact_edge(subject.scene, a, setting.level or 0)[1] for setting in ladder]
            limit = frames_limit(edge, np.stack([one.force[found] for one in each]), NOISE,
                                 tolerance=tiers.TIERS[LIMIT_TIER].tolerance)
            value[found], error[found] = limit.value, np.linalg.norm(limit.error, axis=1)
        return {"reference_force": value, "reference_error": error, "reference_converged": found}

    def _promised(self, subject: Subject, aims: list[Aim], promise: Mapping[str, Any], *, device: str) -> list[Touch]:
        """The touches under an accuracy: each goes from setting to setting until the difference of two, times the
        promise's factor, is no more than what was asked. Some are audited."""
        steps, ladder = ([Setting(**row) for row in promise[key]] for key in ("steps", "ladder"))
        out, left = self.touched(subject, aims, steps[0], device=device), list(range(len(aims)))
        for step in steps[1:]:
            again = self.touched(subject, [aims[k] for k in left], step, device=device)
            off = [promise["factor"] * apart(out[k], one) for k, one in zip(left, again, strict=True)]
            for k, one in zip(left, again, strict=True):
                out[k] = one
            # a frame that is lost is off by infinity, and 0 times that is no number
            left = [k for k, one in zip(left, off, strict=True) if not one <= promise["asked"]]
        recipe, job = subject.job.recipe, subject.job
        view, views = job.object_index * recipe.views + job.view_index, recipe.objects * recipe.views
        audits = promise["audits"] * (view + 1) // views - promise["audits"] * view // views
        rng = np.random.default_rng(job.stream(Stream.AUDIT))
        for k in rng.permutation(len(out))[:audits].tolist():
            wanted = self.reference(subject, aims[k], ladder, made={}, device=device)
            out[k] = dataclasses.replace(out[k], audit={**out[k].audit, **wanted})
        return out

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[str]:
        """Each view in a process of its own."""
        return make_each(jobs, device=device, workers=workers)

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object of a scene with its Young's modulus, and what it is made of in words."""
        tier = tiers.choose(scene)
        solid, values = tiers.body(scene, tier, seed=seed)
        mean = values.mean(axis=1)
        volume = quadratic_mesh(solid).volume
        lines = [f"{len(solid.tets)} tetrahedra, {1e6 * volume.sum():.1f} cm^3, E {mean.min():.3g} "
                 f"to {mean.max():.3g} Pa, tier {tier}"]
        for index, region in enumerate(solid.region_names):
            inside = np.asarray(solid.region) == index
            if inside.any():
                lines.append(f"  {region:<14} E {np.average(mean[inside], weights=volume[inside]):9.3g} Pa  "
                             f"{1e6 * volume[inside].sum():8.1f} cm^3")
        lines.extend(f"note: {sentence}" for sentence in solid.notes)
        surface = surface_of(solid, scene)
        body = Elements(surface.vertices, solid.tets, mean, np.arange(len(mean)))
        return Drawing(surface, mean[solid.surface()[1]], None, tuple(lines), body)


def _disc(radius: float) -> np.ndarray:
    """Points of a triangular lattice of spacing 1 in a disc (k, 2)."""
    n = int(np.ceil(2.0 * radius))
    i, j = (v.ravel() for v in np.meshgrid(np.arange(-n, n + 1), np.arange(-n, n + 1)))
    points = np.stack([i + 0.5 * j, np.sqrt(0.75) * j], axis=1)
    return points[np.linalg.norm(points, axis=1) <= radius + 1e-9]
