"""The air-filled bubble of a scene's ``[sensor] kind = "bubble"``, on an object or, in a press, on rigid obstacles."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Capsule, Plane, ProbeShape, Sphere
from vsfsim.data.records import Touch
from vsfsim.generate import bubble_touch, effects
from vsfsim.generate.aim import Aim, clearance
from vsfsim.generate.boundary import deformed_surface
from vsfsim.generate.bubble_touch import LEADING, Solved, in_mount
from vsfsim.generate.effector import Drawing
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.press_result import (
    PICTURE,
    BodyPanel,
    Column,
    MapPanel,
    Panel,
    PressResult,
    direction,
    frames_done,
    limited,
)
from vsfsim.generate.solid import Subject
from vsfsim.physics import tiers
from vsfsim.physics.bubble.sensor import SHARE, BubbleModel, build_bubble, wishes
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.pair.contact import SENSOR_NODES
from vsfsim.physics.elements.block import elements_of
from vsfsim.physics.mesh.membrane import TriangleMesh
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.coupled import free_way
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.robot.path import pose_at, press_path
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside
from vsfsim.sensing.camera import fitting_camera
from vsfsim.sensing.colours import Colours
from vsfsim.sensing.surface import Surface
from vsfsim.sensing.tessellate import tessellate

OPTIONS = SolverOptions(tolerance=5e-4)
"""Against rigid bodies. As tier fem: with friction, a smaller residual is not always reached where a point is at the
limit of contact."""
_INTO_HOUSING = 1e-4  # how far an obstacle may reach into it [m]
_ELEVATION = 0.35  # of the camera outside [rad]: it looks at the dome's side, not at the back of what presses it
_NEAR = 1.6  # what is farther from the dome than this many times its size is not drawn


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
        chosen = bubble_touch.tier_for(scene, tier)
        if sensor.nodes > SENSOR_NODES:
            raise SceneError(f"{scene.source} [sensor]: nodes is {sensor.nodes}; against an object "
                             f"up to {SENSOR_NODES} are allowed, since the skin's compliance is "
                             "kept whole. Give fewer.")
        height = float(build_bubble(sensor, where=f"{scene.source} [sensor]").mesh.points[:, 2].max())
        if depth > height:
            raise SceneError(f"{scene.source} [touches]: depth is {depth:g} m, but the free dome "
                             f"of the [sensor] is {height:.4f} m high; its rim would go into the "
                             "object. Give less.")
        return chosen

    def channels(self, scene: Scene) -> tuple[str, ...]:
        """Pressure, moment and the read-out mesh; the solved mesh and the camera's pictures if the scene asks."""
        sensor = scene.required_sensor
        out = ("min_det_f", "pressure", "rest_pressure", "moment", "node_position", "node_force",
               "node_rest", "node_reference", "node_triangles")
        fine = ("fine_position", "fine_force", "fine_rest", "fine_triangles") if sensor.fine else ()
        return (*out, *fine, *(("inside_depth", "inside_rgb") if sensor.camera else ()))

    def kernels(self, scene: Scene) -> list[Any]:
        """Those of the coupled solver; its oracle VSF sticks to the dome without a kernel."""
        own = [] if scene.object is None else tiers.elements(scene, bubble_touch.tier_for(scene, None))
        return solver_kernels([*own, ("triangle", ""), ("hinge", ""), ("gas", "")], None)

    def shapes(self, subject: Subject, aims: Sequence[Aim]) -> tuple[ProbeShape, list[ProbeShape], float]:
        """The free dome, to whose skin the object sticks."""
        dome = bubble_touch.dome_of(_sensor_of(subject))
        return dome, [dome] * len(aims), float("inf")

    def reach(self, scene: Scene) -> float:
        """The short semi-axis of its rim."""
        return scene.required_sensor.semi_axes[1]

    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """Along the normals, or tilted from them."""
        return bubble_touch.aim(subject.scene, subject.model, _sensor_of(subject), subject.view, subject.stream)

    def touch(self, subject: Subject, aims: Sequence[Aim], *, device: str) -> list[Touch]:
        """See `bubble_touch.solve`."""
        return [touch for solved in bubble_touch.solve(
            subject.scene, subject.model, _sensor_of(subject), aims,
            options=bubble_touch.solver_options(subject.limits(), device), device=device)
                for touch in solved.touches(device)]

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """One touch of the scene that is kept; the mount's origin follows ``[press]``, its +z leads."""
        return result_of(solve(loaded.sample(request.seed), request), request)

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """The scene with edges at the contact that are halved from mesh to mesh; the mesh before the last is the
        scene's own.

        Raises:
            SceneError: an object is pressed, or bodies without a radius and no contact_edge is given.
        """
        scene = loaded.sample(request.seed)
        edge = scene.required_sensor.contact_edge
        if scene.object is not None:
            raise SceneError(f"{scene.source}: --refine refines a [sensor] where rigid bodies "
                             "touch it; with an [object] set nodes in [sensor] and resolution in "
                             "[object], and compare.")
        if edge is None:
            radii = [body.radius for body in scene.bodies if isinstance(body, (Sphere, Capsule))]
            if not radii:
                raise SceneError(f"{scene.source}: --refine halves the edges where bodies touch, "
                                 "which follow the radius of balls and capsules; for other bodies "
                                 "give contact_edge in [sensor].")
            edge = SHARE * min(radii)
        return [loaded.varied("sensor", contact_edge=edge * 2.0 ** (meshes - 2 - k)) for k in range(meshes)]

    def draw(self, scene: Scene, seed: np.random.SeedSequence) -> Drawing:
        """The object, or the free dome where there is none."""
        return bubble_touch.draw_dome(scene) if scene.object is None else super().draw(scene, seed)


EFFECTOR = BubbleEffector()


def _sensor_of(subject: Subject) -> BubbleModel:
    return build_bubble(subject.scene.required_sensor, where=f"{subject.scene.source} [sensor]")


@dataclass(frozen=True)
class Made:
    """A press that is solved."""

    solved: Solved
    """One touch."""
    gap: float
    """Way of the mount to first contact [m]."""
    tolerance: float
    """Of the residual [-]."""
    notes: tuple[str, ...]
    build_seconds: float
    """Spent on inflation and factorisation [s]."""


def solve(scene: Scene, request: Request) -> Made:
    """Solve the ``[press]`` of a scene with a ``[sensor]`` and an object, or obstacles.

    Args:
        scene: concrete.
        request: tier, of the object; seed; device; progress.

    Raises:
        SceneError: no path, both an object and obstacles, a tier that a sensor cannot press, something that cannot be
            built, or that has no effect.
    """
    spec, sensor, where = scene.press, scene.required_sensor, f"{scene.source} [sensor]"
    if spec is None:
        raise SceneError(f"{scene.source}: a scene with a [sensor] needs a [press]: the path of "
                         "the middle of its rim, e.g. from = [0, 0, 0.05], to = [0, 0, 0.02].")
    if scene.object is not None and scene.obstacles:
        raise SceneError(f"{scene.source}: a [sensor] presses an [object] or [[obstacles]]; this "
                         "scene has both. Take one of them out.")
    if scene.object is None and request.tier is not None:
        raise SceneError(f"--tier {request.tier}: this scene has a [sensor] and no [object], and tiers are of objects; "
                         f"the sensor's mesh is set by nodes in [sensor]. Leave --tier out.")
    began, axis = time.perf_counter(), direction(spec)
    path, first = press_path(spec, LEADING), pose_at(spec, LEADING, 0)
    aim = Aim(np.array(spec.stop), -axis, axis, np.array(spec.start), 0.0, path=path, start=first)
    model, body, notes = build_bubble(sensor, where=where), None, []
    if scene.object is None:
        poses, bodies = in_mount(scene, path), RigidBodies(scene.bodies)
        finer = wishes(model.mesh.points, model.element_size, bodies, poses, sensor.contact_edge)
        if finer:
            model = build_bubble(sensor, finer=finer, where=where)
            notes = [f"{sensor.nodes} nodes became {len(model.mesh.points)}: triangles are smaller "
                     "where bodies touch; contact_edge in [sensor] says how small."]
        _before_housing(scene, model, poses)
        kernels, options = solver_kernels(elements_of(model.blocks)), OPTIONS
        gap = min(clearance(model, shape, pose, -first[:3, :3].T @ axis)
                  for shape, pose in zip(scene.bodies, in_mount(scene, first[None])[0], strict=True))
    else:
        tier = bubble_touch.tier_for(scene, request.tier)
        body = tiers.build(scene, tier, seed=request.seed)
        effects.check_body(scene, body)
        notes = [*body.solid.notes,
                 f"object at tier {tier}: {len(body.mesh.tets)} tetrahedra; reaction and balance are the object's"]
        kernels = solver_kernels(elements_of([*body.blocks, *model.blocks]), None)
        options = bubble_touch.solver_options(tiers.options(tier), request.device)
        gap = free_way(body, model, first, axis)
    built = time.perf_counter() - began
    compile_kernels(kernels, request.device, progress=request.progress)
    (solved,) = bubble_touch.solve(scene, body, model, [aim], options=limited(options, request), device=request.device,
                                   progress=frames_done(request.progress, len(path)))
    skin = solved.in_mount()[0]
    moved = skin - model.mesh.points
    if body is None:
        effects.check_contact(scene, _names(solved), solved.frames.body_force[:, 0],
                              effects.nearest(bodies, poses, skin), moved)
    else:
        effects.check_contact(scene, _names(solved), solved.frames.force, lambda _: gap, moved)
    return Made(solved, gap, options.tolerance, tuple(notes), built)


def _names(solved: Solved) -> tuple[str, ...]:
    """Of what the skin is pressed on."""
    return (("object",) if solved.object is not None else
            tuple(f"obstacle {i + 1}" for i in range(len(solved.scene.obstacles))))


def _before_housing(scene: Scene, model: BubbleModel, poses: np.ndarray) -> None:
    """Refuse obstacles that reach into the housing: the rim, and a rigid floor `Bubble.chamber` behind its plane.

    Args:
        poses: of the obstacles in the mount frame (T, K, 4, 4).

    Raises:
        SceneError: an obstacle is behind the rim, or behind the floor within it.
    """
    bodies, chamber = RigidBodies(scene.bodies), model.spec.chamber
    plate = np.column_stack([model.flat, np.full(len(model.flat), -chamber)])
    plate[cast(TriangleMesh, model.mesh).rim, 2] = 0.0
    for t, frame in enumerate(poses):
        for k, pose in enumerate(frame):
            depth = -float(bodies.distance(k, (plate - pose[:3, 3]) @ pose[:3, :3]).min())
            if depth > _INTO_HOUSING:
                raise SceneError(f"{scene.source}: in frame {t} of [press] obstacle {k + 1} is "
                                 f"{1e3 * depth:.2g} mm behind the plane of the sensor's rim or "
                                 f"the floor of its chamber, {1e3 * chamber:g} mm behind it. The "
                                 f"free dome is {1e3 * float(model.mesh.points[:, 2].max()):.1f} "
                                 "mm high; let the path end before, or give the depth of the "
                                 "chamber, chamber in [sensor].")


def result_of(made: Made, request: Request) -> PressResult:
    """What `vsfsim press` needs of the frames."""
    s = made.solved
    model, frames, spec, (touch,) = s.sensor, s.frames, s.scene.press, s.touches(request.device)
    assert spec is not None and touch.pressure is not None
    full, axis, edge, wrench = spec.inward - 1, touch.axis, model.element_size, s.wrench()
    way = (s.mount[:, 0, :3, 3] - np.array(spec.start)) @ axis
    depth, normal = np.maximum(way - made.gap, 0.0), touch.normal_force()
    pressure, volume = s.pressure[:, 0], s.volume[:, 0] + model.dead_volume
    change = pressure - model.spec.gauge_pressure
    apex, dome = float(model.mesh.points[:, 2].max()), float(model.mesh.volume[0])
    triangles, nodes = len(model.mesh.faces), len(model.mesh.points)
    more: dict[str, Any] = {
        "slipping": frames.slipping[:, 0], "seconds": frames.seconds,
        "body_force": frames.body_force[:, 0] if s.object is None else -frames.force,
        "bodies": _names(s), "wrench": wrench, "pressure": pressure, "pressure_change": change,
        "volume": volume, "cg_iterations": frames.cg_iterations[:, 0], "apex": apex,
        "friction": s.scene.frictions if s.object is None else (s.scene.required_sensor.friction,),
        "dome_volume": dome, "edge": edge, "build_seconds": made.build_seconds,
        "triangles": triangles, "nodes": nodes, "device": request.device,
        "tolerance": made.tolerance, "inward": spec.inward}
    at_full = wrench[full] + 0.0
    said = ("At full depth, wrench of the contact at the mount, in its frame: "
            f"({', '.join(f'{v:.4f}' for v in at_full[:3])}) N, "
            f"({', '.join(f'{v:.5f}' for v in at_full[3:])}) N m; "
            f"{100 * more['slipping'][full]:.0f} % of the points in contact slip.",
            f"Free dome: apex {1e3 * apex:.2f} mm, {1e6 * dome:.2f} mL, "
            f"{model.spec.gauge_pressure:.1f} Pa gauge. {triangles} triangles, {nodes} nodes, "
            f"mean edge where it is touched {1e3 * edge:.2f} mm, on {request.device}; "
            f"built in {made.build_seconds:.1f} s, solved in {frames.seconds.sum():.1f} s.")
    mesh = cast(TriangleMesh, model.mesh)
    return PressResult(
        touch, depth, full, edge=edge, more=more,
        readings=(Column("pressure Pa", pressure, ".2f"), Column("change Pa", change, ".2f"),
                  Column("volume mL", 1e6 * volume, ".4f")), said=said, notes=made.notes,
        plot={"normal force [N]": {"force on the sensor": normal},
              "pressure change [Pa]": {"gas": change}}, model=f"bubble of {nodes} nodes",
        headline=f"depth {1e3 * depth[full]:.2f} mm, normal force {normal[full]:.4g} N, pressure "
        f"change {change[full]:.4g} Pa",
        caption="left: from outside; middle: how far the skin went in along the free dome's "
        "normal, dots: nodes in contact, larger with their force; right: from the camera inside",
        panels=lambda t: _panels(s, t, full, request.device),
        arrays={"volume": (volume, "of the gas (T,) [m^3]"),
                "fine_position": (s.position[..., 0], "fine mesh, world (T, n, 3) [m]"),
                "fine_force": (s.force[..., 0], "contact force on its nodes, world (T, n, 3) [N]"),
                "fine_rest": (mesh.points, "fine mesh of the free dome, mount frame (n, 3) [m]"),
                "fine_triangles": (mesh.faces, "its triangles (f, 3)"),
                "fine_rim": (mesh.rim, "its clamped nodes in order (r,)")})


def inward_distance(model: BubbleModel, position: np.ndarray) -> np.ndarray:
    """How far every node (n,) [m] has moved inwards along the free dome's normal, from its ``position`` in the mount
    frame (n, 3) [m]; negative where it bulges out."""
    points, faces = model.mesh.points, model.mesh.faces
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.zeros_like(points)
    np.add.at(area, faces, np.cross(b - a, c - a)[:, None])
    return -((position - points) * area).sum(axis=1) / np.linalg.norm(area, axis=1)


def _panels(s: Solved, t: int, full: int, device: str) -> tuple[Panel, ...]:
    """The dent of frame ``t`` from outside, over the rim plane, and seen by the camera inside; in the colours of the
    frame of full depth."""
    mesh, (position, push) = s.sensor.mesh, s.in_mount()
    inward, most = (1e3 * inward_distance(s.sensor, position[k]) for k in (t, full))
    colours = Colours("RdBu_r", min(float(most.min()), -1e-6), max(float(most.max()), 1e-6))
    _, (inside,) = look_inside(position[t:t + 1], mesh.faces, s.sensor.flat, BubbleCamera(), device=device)
    return (outside(s, t, inward[mesh.faces].mean(axis=1), colours),
            MapPanel(1e3 * mesh.points[:, :2], mesh.faces, inward,
                     np.nan_to_num(np.linalg.norm(push[t], axis=1)),
                     dataclasses.replace(colours, label="inwards [mm]"),
                     ("x of the mount, free dome [mm]", "y [mm]")), inside)


def outside(s: Solved, t: int, values: np.ndarray, colours: Colours) -> BodyPanel:
    """The skin in frame ``t``, dome up, with one value a triangle (f,), and what presses it."""
    skin = s.in_mount()[0][t]
    size = float(np.ptp(skin, axis=0).max())
    if s.object is not None:
        assert s.moved is not None
        turn, at = s.mount[t, 0, :3, :3], s.mount[t, 0, :3, 3]
        vertices, triangles, *_ = deformed_surface(s.object.mesh, s.moved[t, ..., 0])
        solids, plates = [((vertices - at) @ turn, triangles)], [False]
    else:
        solids = [(v @ pose[:3, :3].T + pose[:3, 3], f)
                  for (v, f), pose in zip((tessellate(shape, 2.0 * size) for shape in s.scene.bodies),
                                          in_mount(s.scene, s.mount[t])[0], strict=True)]
        plates = [isinstance(shape, Plane) for shape in s.scene.bodies]
    close = [(v, _within(v, f, skin.mean(axis=0), _NEAR * size)) for v, f in solids]
    camera = fitting_camera(skin, np.concatenate([skin, *(v[np.unique(f)] for v, f in close)]),
                            *PICTURE, elevation=_ELEVATION)
    # A plate between the camera and the dome would hide it.
    rigid = tuple((v, f) for (v, f), plate in zip(close, plates, strict=True)
                  if not (plate and camera[1][2, 3] > v[:, 2].max()))
    surface = Surface(skin, s.sensor.mesh.faces, np.zeros(len(s.sensor.mesh.faces), int), None, skin)
    return BodyPanel(surface, camera, PICTURE, rigid, values, colours)


def _within(vertices: np.ndarray, triangles: np.ndarray, middle: np.ndarray, reach: float) -> np.ndarray:
    """The triangles (g, 3) with a corner within ``reach`` [m] of ``middle`` (3,)."""
    return triangles[(np.linalg.norm(vertices - middle, axis=1) < reach)[triangles].any(axis=1)]
