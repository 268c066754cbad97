"""What all effectors that touch solids do alike."""

from __future__ import annotations

import abc
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.scene import Scene
from vsfsim.core.shape import ProbeShape
from vsfsim.data.records import ObjectView, Touch, Truth
from vsfsim.generate.aim import Aim
from vsfsim.generate.effector import Drawing
from vsfsim.generate.job import Job
from vsfsim.generate.solid import Subject, prepare, surface_of
from vsfsim.generate.trade.near import audited
from vsfsim.generate.truth import truth_of
from vsfsim.generate.workers import make_each
from vsfsim.physics import tiers
from vsfsim.physics.mesh.quadratic import quadratic_mesh


@dataclass(frozen=True)
class Manner:
    """How an effector meets a solid."""

    reach: float
    """Radius of what leads, about [m]."""
    tiers: tuple[str, ...]
    """At which it can press the solid, cheapest first."""
    nodes: int | None = None
    """Of its own mesh; None if it is rigid."""


class OnSolids(abc.ABC):
    """An effector that touches solids, whose touches can be made again, as they were aimed, on another model of the
    object; see `vsfsim.generate.effector.Effector`."""

    @abc.abstractmethod
    def manner(self, scene: Scene) -> Manner:
        """How it meets the solid of a scene."""

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
        touches = audited(self.touch, self.manner(subject.scene).reach, subject, aims, device=device)
        probe, each, friction = self.shapes(subject, aims)
        truth = truth_of(subject.model, subject.view, touches, each, friction=friction, device=device)
        return ObjectView(job.name, job.object_index, job.view_index, job.split, probe, subject.recorded,
                          tuple(touches), truth, tuple(press.probe for press in subject.scene.presses[1:]))

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[str]:
        """Each view in a process of its own."""
        return make_each(jobs, device=device, workers=workers)

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object of a scene with its Young's modulus, and what it is made of in words."""
        tier = tiers.choose(scene)
        solid, values = tiers.body(scene, tier, seed=seed)
        mean = values.mean(axis=1)
        volume = quadratic_mesh(solid).volume
        lines = [f"{len(solid.tets)} tetrahedra, {1e6 * volume.sum():.1f} cm^3, E {mean.min():.3g} to "
                 f"{mean.max():.3g} Pa, tier {tier}"]
        for index, region in enumerate(solid.region_names):
            inside = np.asarray(solid.region) == index
            if inside.any():
                lines.append(f"  {region:<14} E {np.average(mean[inside], weights=volume[inside]):9.3g} Pa  "
                             f"{1e6 * volume[inside].sum():8.1f} cm^3")
        lines.extend(f"note: {sentence}" for sentence in solid.notes)
        surface = surface_of(solid, scene)
        truth = Truth(points=surface.vertices[solid.tets].mean(axis=1), young_modulus=mean,
                      region=np.asarray(solid.region), region_names=solid.region_names)
        return Drawing(surface, mean[solid.surface()[1]], None, tuple(lines), truth)
