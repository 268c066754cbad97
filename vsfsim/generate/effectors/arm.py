"""The robot arm of a scene's ``[arm]``: it touches plants with its tool and its links, and reads its joint torques."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.data.records import ObjectView
from vsfsim.generate.effector import Drawing
from vsfsim.generate.job import Job
from vsfsim.generate.plants.admit import grow
from vsfsim.generate.plants.batches import make_together
from vsfsim.generate.plants.surface import plant_surface, triangles_of
from vsfsim.generate.plants.touches import make_views
from vsfsim.generate.plants.truth import segments
from vsfsim.generate.press_result import PressResult
from vsfsim.generate.presses import arm as one_press
from vsfsim.generate.workers import make_each
from vsfsim.physics.rods.kernels.advance import advance
from vsfsim.vsf.stick_slip import stick_slip


class ArmEffector:
    """An arm with seven joints; see `vsfsim.generate.effector.Effector`."""

    table = "arm"

    def check(self, scene: Scene, tier: str | None) -> str:
        """Plants are made of beams: tier "rod".

        Raises:
            SceneError: another tier was asked for.
        """
        if (tier or "rod") not in ("rod", "auto"):
            raise SceneError(f"{scene.source}: --tier is '{tier}', but what an arm touches is made of beams, "
                             f"tier 'rod'.")
        return "rod"

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Joint angles and torques, the wrenches on the links, and of a guarded move how it ended."""
        ended = ("ended",) if scene.required_arm.at_limit == "return" else ()
        return ("q", "torque", "link_force", "link_moment", "draws", *ended)

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the beams' solver, and of the oracle VSF's stick and slip."""
        return [advance, stick_slip]

    def make_view(self, job: Job, *, device: str, progress: Callable[[int], None] | None = None) -> ObjectView:
        """Grow, look, aim along lines that the arm can follow, touch."""
        return make_views([job], device=device, progress=progress)[0]

    def make_all(self, jobs: Sequence[Job], *, device: str, workers: int | None) -> Iterator[tuple[int, str]]:
        """On a CPU each view in a process of its own; on a GPU the touches of many views are solved together."""
        make = make_each if device == "cpu" else make_together
        return make(jobs, device=device, workers=workers)

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """See `vsfsim.generate.presses.arm`."""
        return one_press.press(loaded, request)

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """Raises:
            SceneError: always; a plant has the segments of its family.
        """
        raise SceneError(f"--refine {meshes}: a plant has the segments that its family gave it, and no finer mesh; "
                         f"leave --refine out, or make segment in [object.shape] smaller.")

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The plant without its pot, and the sections and moduli of its parts in words."""
        plant = grow(scene, seed)
        lines = [f"{len(plant.nodes) - 1} segments, {plant.lengths().sum():.2f} m in all, "
                 f"{plant.nodes[:, 2].max():.2f} m high, tier rod"]
        for index, region in enumerate(plant.region_names):
            mine = np.flatnonzero(plant.region[1:] == index) + 1
            if len(mine):
                e, r = plant.young_modulus[mine], plant.radius[mine]
                lines.append(f"  {region:<14} {len(mine):4d} segments, E {e.min():9.3g} to {e.max():9.3g} Pa, "
                             f"{'half thickness' if plant.half_width[mine].any() else 'radius'} {1e3 * r.min():.2g} to "
                             f"{1e3 * r.max():.2g} mm")
        lines.extend(f"note: {sentence}" for sentence in plant.notes)
        modulus = np.repeat(plant.young_modulus[1:], triangles_of(plant)[1:])
        return Drawing(plant_surface(plant, pot=False), modulus, None, tuple(lines), segments(plant))


EFFECTOR = ArmEffector()
