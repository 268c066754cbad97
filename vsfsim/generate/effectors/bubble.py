"""The air-filled bubble of a scene's ``[sensor] kind = "bubble"``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.bubble import Bubble
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import ProbeShape
from vsfsim.data.records import Touch
from vsfsim.generate.aim import Aim
from vsfsim.generate.bubble_touch import aim, dome_of, solve, solver_options, tier_for
from vsfsim.generate.effector import Drawing
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.press_result import PressResult
from vsfsim.generate.presses import bubble as one_press
from vsfsim.generate.solid import Manner, Subject
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.bubble.shape import punyo_rms, stretches
from vsfsim.physics.contact.pair.response import SENSOR_NODES
from vsfsim.physics.elements import gas
from vsfsim.physics.solve.kernels import coupled_kernels
from vsfsim.sensing.surface import Surface


class BubbleEffector(OnSolids):
    """A soft-bubble sensor on a mount; see `vsfsim.generate.effector.Effector`."""

    table = "sensor"

    def check(self, scene: Scene, tier: str | None) -> str:
        """The tier of the object: as `tiers.choose`, at least ``fem-coarse``.

        Raises:
            SceneError: a tier that a bubble cannot press, too many nodes, a bubble that cannot be inflated, or
                a depth of more than the dome's height.
        """
        sensor, depth = scene.required_sensor, scene.required_touches.depth
        chosen = tier_for(scene, tier)
        if sensor.nodes > SENSOR_NODES:
            raise SceneError(f"{scene.source} [sensor]: nodes is {sensor.nodes}; against an object up to "
                             f"{SENSOR_NODES} are allowed, since the skin's compliance is kept whole. Give fewer.")
        height = float(build_bubble(sensor, where=f"{scene.source} [sensor]").mesh.points[:, 2].max())
        if depth > height:
            raise SceneError(f"{scene.source} [touches]: depth is {depth:g} m, but the free dome of the "
                             f"[sensor] is {height:.4f} m high; its rim would go into the object. Give less.")
        return chosen

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Pressure, moment and the read-out mesh; the solved mesh and the camera's pictures if the scene asks."""
        sensor = scene.required_sensor
        out = ("min_det_f", "pressure", "rest_pressure", "moment", "node_position", "node_force", "node_rest",
               "node_reference", "node_triangles")
        fine = ("fine_position", "fine_force", "fine_rest", "fine_triangles") if sensor.fine else ()
        return (*out, *fine, *(("inside_depth", "inside_rgb") if sensor.camera else ()))

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the coupled solver and of the camera inside; its oracle VSF sticks to the dome without a kernel."""
        from vsfsim.sensing import render_bubble

        camera = [render_bubble.inside_kernel] if scene.required_sensor.camera else []
        own = [] if scene.object is None else tiers.elements(scene, tier_for(scene, None))
        return [*coupled_kernels([*own, ("triangle", ""), ("hinge", ""), ("gas", "")]), *camera]

    def shapes(self, subject: Subject, aims: Sequence[Aim]) -> tuple[ProbeShape, list[ProbeShape], float]:
        """The free dome, to whose skin the object sticks."""
        dome = dome_of(_sensor_of(subject))
        return dome, [dome] * len(aims), float("inf")

    def manner(self, scene: Scene) -> Manner:
        """With the short semi-axis of its rim, at the tiers that bend far."""
        sensor = scene.required_sensor
        able = tuple(name for name, tier in tiers.TIERS.items() if tier.nonlinear)
        return Manner(sensor.semi_axes[1], able if scene.object is not None else (), sensor.nodes)

    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """Along the normals, or tilted from them."""
        return aim(subject.scene, subject.model, _sensor_of(subject), subject.view, subject.stream)

    def touch(self, subject: Subject, aims: Sequence[Aim], *, device: str,
              progress: Callable[[int], None] | None = None) -> list[Touch]:
        """See `bubble_touch.solve`."""
        return [touch for solved in solve(subject.scene, subject.model, _sensor_of(subject), aims,
                                          options=solver_options(subject.limits(), device), device=device,
                                          progress=progress)
                for touch in solved.touches(device)]

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """See `vsfsim.generate.presses.bubble`."""
        return one_press.press(loaded.sample(request.seed), request)

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """See `vsfsim.generate.presses.bubble`."""
        return one_press.finer(loaded, request, meshes)

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object, or the free dome where there is none."""
        return _draw_dome(scene) if scene.object is None else super().draw(scene, seed)


EFFECTOR = BubbleEffector()


def _sensor_of(subject: Subject) -> BubbleModel:
    return _built(subject.scene.required_sensor, str(subject.scene.source), subject.job.cache)


@functools.lru_cache(maxsize=1)
def _built(spec: Bubble, source: str, cache: Path | None) -> BubbleModel:
    return build_bubble(spec, where=f"{source} [sensor]", cache=cache)


def _draw_dome(scene: Scene) -> Drawing:
    spec = scene.required_sensor
    model = build_bubble(spec, where=f"{scene.source} [sensor]")
    mesh = model.mesh
    apex = int(mesh.points[:, 2].argmax())
    largest, least = stretches(model)[(mesh.faces == apex).any(axis=1)].mean(axis=0)
    rate = gas.at_rest(model.blocks[2])[2]
    lines = [f"a bubble of {len(mesh.points)} nodes and {len(mesh.faces)} triangles, mean edge "
             f"{1e3 * model.element_size:.2f} mm; "
             f"read-out mesh of {len(model.read_out.flat)} nodes, {len(model.read_out.faces)} triangles, "
             f"{len(model.read_out.rim)} on the rim",
             f"  rim            {2e3 * spec.semi_axes[0]:.1f} x {2e3 * spec.semi_axes[1]:.1f} mm, E h "
             f"{spec.modulus:.0f} N/m, pre-stretch {spec.pre_stretch:g}",
             f"  free dome      apex {1e3 * mesh.points[apex, 2]:.2f} mm, volume {1e6 * mesh.volume[0]:.2f} mL, at "
             f"{model.pressure:.0f} Pa gauge; stretch at the apex {least:.3f} x {largest:.3f}",
             f"  gas            {1e6 * spec.gas_volume:.1f} mL, gamma {spec.gamma:g}, "
             + (f"sealed: dp/dV {-1e-9 * rate:.3f} kPa/mL" if spec.sealed else "open")]
    if spec.semi_axes == type(spec)().semi_axes:
        lines.append(f"  height map     rms {1e3 * punyo_rms(model):.2f} mm from h = 30.89 mm (1 - rho^2)^0.763, a "
                     f"real Punyo's")
    surface = Surface(mesh.points, mesh.faces, np.zeros(len(mesh.faces), np.int64), None, mesh.points)
    return Drawing(surface, None, "free dome", tuple(lines))
