"""The rigid probe of a scene's ``[probe]``: it goes in along the normal that the camera sees, or tilted from it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import ProbeShape
from vsfsim.data.records import Touch
from vsfsim.generate import rigid_touch
from vsfsim.generate.aim import Aim, aim_probe, in_kinds
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.press_result import PressResult
from vsfsim.generate.presses import probe as one_press
from vsfsim.generate.solid import Manner, Subject
from vsfsim.physics import tiers
from vsfsim.physics.contact import sdf
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.vsf.stick_slip import stick_slip


class Probe(OnSolids):
    """A rigid probe of simple shape; see `vsfsim.generate.effector.Effector`."""

    table = "probe"

    def check(self, scene: Scene, tier: str | None) -> str:
        """The tier that the scene's needs ask for."""
        return tiers.choose(scene, tier)

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """The force on the probe is all that is read; every touch has it."""
        return ("min_det_f",)

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the solver, and of the oracle VSF's stick and slip."""
        own = tiers.elements(scene, tiers.choose(scene))
        return [*solver_kernels(own), stick_slip]

    def shapes(self, subject: Subject, aims: Sequence[Aim]) -> tuple[ProbeShape, list[ProbeShape], float]:
        """The scene's own probe, that of each kind of press, and the object's friction."""
        scene = subject.scene
        return (scene.probe, [scene.presses[a.press].probe for a in aims], scene.required_object.friction)

    def manner(self, scene: Scene) -> Manner:
        """With its largest radius, at every tier."""
        return Manner(min(sdf.reach(scene.probe), 1.0), tuple(tiers.TIERS))

    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """Along the normals, or tilted from them."""
        return aim_probe(subject.scene, subject.model, subject.view, subject.stream, device=device)

    def touch(self, subject: Subject, aims: Sequence[Aim], *, device: str,
              progress: Callable[[int], None] | None = None) -> list[Touch]:
        """See `rigid_touch.solve`; touches of one kind of press together."""
        presses = subject.scene.presses

        def make(press: Scene, mine: list[int]) -> list[Touch]:
            solved = rigid_touch.solve(press, subject.model, [aims[k] for k in mine], tier=subject.job.recipe.tier,
                                       device=device, options=subject.limits(), progress=progress)
            found = [touch for _, _, touches in solved for touch in touches]
            return found if len(presses) == 1 else [dataclasses.replace(touch, press=aims[k].press)
                                                    for k, touch in zip(mine, found, strict=True)]

        return in_kinds(presses, aims, make)

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """See `vsfsim.generate.presses.probe`."""
        return one_press.press(loaded.sample(request.seed), request)

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """See `vsfsim.generate.presses.probe`."""
        return one_press.finer(loaded, request, meshes)


EFFECTOR = Probe()
