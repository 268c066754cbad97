"""The rigid probe of a scene's ``[probe]``: it goes in along the normal that the camera sees, or tilted from it. A
press is one touch of the scene that is kept, with the probe's parts, and with obstacles beside the object."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import Scene, SceneFile
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Capsule, MeshFile, Plane, ProbeShape
from vsfsim.data.records import Touch
from vsfsim.generate import effects, rigid_touch
from vsfsim.generate.aim import Aim, aim_probe, clearance, in_kinds
from vsfsim.generate.assume import with_press, with_probe
from vsfsim.generate.boundary import deformed_surface, face_pressure, node_pressure
from vsfsim.generate.on_solids import OnSolids
from vsfsim.generate.press_result import PICTURE, BodyPanel, Column, PressResult, direction, frames_done, limited
from vsfsim.generate.solid import Subject
from vsfsim.physics import tiers
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import inner_radius, sharp_samples
from vsfsim.physics.contact.law import contact_law_of
from vsfsim.physics.contact.patch import smooth_radius
from vsfsim.physics.elements.block import elements_of
from vsfsim.physics.mesh.edge_refine import EdgePath
from vsfsim.physics.mesh.resolved import TURNED, in_words, past_small_strain
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.increments import inside
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.robot.path import body_poses, pose_at, press_path
from vsfsim.sensing.camera import fitting_camera
from vsfsim.sensing.colours import Colours, of_modulus
from vsfsim.sensing.cut import Elements, facing, halved, opened
from vsfsim.sensing.surface import Surface
from vsfsim.sensing.tessellate import tessellate
from vsfsim.vsf.stick_slip import stick_slip

RATIO = 1.3  # of the edges of two meshes: three meshes span 1.69, the finest has 4.8 times the tetrahedra of the first
SMALLER = 0.5  # a round part under this share of the probe's reach gets elements of its own
_AZIMUTH = 0.4  # of the camera from the normal of the cut [rad]
SPACING = 0.1  # of the points of a body's edges, over its half-width


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
        return [*solver_kernels(own, contact_law_of(scene)[0]), stick_slip]

    def shapes(self, subject: Subject, aims: Sequence[Aim]) -> tuple[ProbeShape, list[ProbeShape], float]:
        """The scene's own probe, that of each kind of press, and the object's friction."""
        scene = subject.scene
        return (scene.probe, [scene.presses[a.press].probe for a in aims], scene.required_object.friction)

    def reach(self, scene: Scene) -> float:
        """The probe's largest radius, of a plane 1 m."""
        return min(sdf.reach(scene.probe), 1.0)

    def aim(self, subject: Subject, *, device: str) -> list[Aim]:
        """Along the normals, or tilted from them."""
        return aim_probe(subject.scene, subject.model, subject.view, subject.stream, device=device)

    def touch(self, subject: Subject, aims: Sequence[Aim], *, device: str) -> list[Touch]:
        """Touches of one kind of press together."""
        presses = subject.scene.presses

        def make(press: Scene, mine: list[int]) -> list[Touch]:
            solved = rigid_touch.solve(press, subject.model, [aims[k] for k in mine], tier=subject.job.recipe.tier,
                                       device=device, options=subject.limits())
            found = [touch for _, _, touches in solved for touch in touches]
            return found if len(presses) == 1 else [dataclasses.replace(touch, press=aims[k].press)
                                                    for k, touch in zip(mine, found, strict=True)]

        return in_kinds(presses, aims, make)

    def press(self, loaded: SceneFile, request: Request) -> PressResult:
        """One touch of the scene that is kept."""
        return press(loaded.sample(request.seed), request)

    def finer(self, loaded: SceneFile, request: Request, meshes: int) -> list[SceneFile]:
        """The scene with smaller and smaller elements, by `RATIO` from mesh to mesh."""
        scene, _ = with_probe(loaded.sample(request.seed))
        size = tiers.element_size(scene.required_object, tiers.choose(scene, request.tier), scene.probe)
        return [loaded, *(loaded.varied("object", resolution=size / RATIO**k) for k in range(1, meshes))]


EFFECTOR = Probe()


@dataclass(frozen=True)
class Prepared:
    """A press that is ready to be solved."""

    scene: Scene
    """With probe and path."""
    model: Model
    """Of the object."""
    tier: str
    notes: tuple[str, ...]
    """What was assumed."""
    seconds: float
    """Spent on meshing [s]."""

    @property
    def element_size(self) -> float:
        """Edge length that the mesh aims at [m]."""
        return tiers.element_size(self.scene.required_object, self.tier, self.scene.probe)


def press(scene: Scene, request: Request) -> PressResult:
    """Carry out the ``[press]`` of a scene, or a default one from above.

    Raises:
        SceneError, MeshError: the scene cannot be built, the probe begins inside the object, or something has no
            effect.
    """
    prepared = prepare(scene, request)
    result = solve(prepared, request)
    error, turned, law = (result.more[name] for name in ("mesh_error", "rotation", "law_error"))
    if not tiers.leaves(scene, request.tier, prepared.tier, past_small_strain(error, turned, law)):
        return result
    followed = dataclasses.replace(scene.required_object, tier=tiers.FOLLOWS)  # type: ignore[arg-type]
    prepared = prepare(dataclasses.replace(scene, object=followed), request)
    return solve(dataclasses.replace(prepared, notes=(*prepared.notes, (
        f"Elements {'turn' if (turned > TURNED).any() else 'stretch'} too far for small strain: "
        f"tier '{tiers.FOLLOWS}' was taken."))), request)


def prepare(scene: Scene, request: Request) -> Prepared:
    """The scene with its defaults filled in, and its model.

    Raises:
        SceneError, MeshError: the scene cannot be built.
    """
    began, tier = time.perf_counter(), tiers.choose(scene, request.tier)
    scene, notes = with_probe(scene)
    notes += RigidBodies(scene.bodies).notes  # a broken probe is refused before the object is meshed
    focus = None if scene.press is None else tip(scene, np.array(scene.press.stop), direction(scene.press))[None]

    def build(edges: EdgePath | None) -> Model:
        return tiers.build(scene, tier, seed=request.seed, focus=focus, edges=edges)

    model = build(edge_path(scene))
    given, (scene, more) = scene.press, with_press(scene, model)
    if given is None and (edges := edge_path(scene)) is not None:
        model = build(edges)
    effects.check_body(scene, model)
    return Prepared(scene, model, tier, (*notes, *more), time.perf_counter() - began)


def edge_path(scene: Scene) -> EdgePath | None:
    """The way in of points on the edges, corners and rims of the probe and its parts, close enough for every tier, and
    of the tips of round parts, for which the elements that suit the probe are too large; None without any, or without a
    path."""
    if scene.press is None:
        return None
    inward = np.stack([pose_at(scene.press, scene.probe, k) for k in range(scene.press.inward + 1)])
    places, half = [], []
    for k, shape in enumerate(scene.bodies[:1 + len(scene.parts)]):
        width = inner_radius(shape)
        pose, spot = body_poses(scene, inward)[:, k], sharp_samples(shape, SPACING * width)[0]
        if 0.0 < smooth_radius(shape) < SMALLER * sdf.reach(scene.probe):
            spot, width = _tips(shape, pose[-1, :3, :3].T @ direction(scene.press)), 1.5 * smooth_radius(shape)
        places.append(pose[:, None, :3, 3] + np.einsum("tij,kj->tki", pose[:, :3, :3], spot))
        half.append(np.full(len(spot), width))
    return EdgePath(np.concatenate(places, axis=1), np.concatenate(half)) if sum(map(len, half)) else None


def _tips(shape: ProbeShape, axis: np.ndarray) -> np.ndarray:
    """The points (k, 3) [m] of a ball or capsule that lead when it moves along ``axis`` (3,), in its own frame."""
    half = 0.5 * shape.length if isinstance(shape, Capsule) else 0.0
    line = np.linspace(-half, half, 1 + 2 * math.ceil(half / smooth_radius(shape)))
    return line[:, None] * np.array([0.0, 0.0, 1.0]) + smooth_radius(shape) * axis


def solve(prepared: Prepared, request: Request) -> PressResult:
    """Solve the frames of a prepared press.

    Raises:
        SceneError: the probe begins inside the object, or a body has no effect.
    """
    scene, model, tier = prepared.scene, prepared.model, prepared.tier
    spec = scene.press
    assert spec is not None
    first, axis, moving = pose_at(spec, scene.probe, 0), direction(spec), 1 + len(scene.parts)
    aim = Aim(tip(scene, np.array(spec.stop), axis), -axis, axis, np.array(spec.start), 0.0,
              path=press_path(spec, scene.probe), start=first)
    assert aim.path is not None
    begin, placed = body_poses(scene, first[None])[0], body_poses(scene, aim.path)
    gap = min(clearance(model, shape, pose, axis) for shape, pose in zip(scene.bodies[:moving], begin, strict=False))
    begun = overlap(model, RigidBodies(scene.bodies), begin, str(scene.source))
    effects.check_free(scene, model, RigidBodies(scene.bodies[:moving]), placed[spec.inward - 1])
    compile_kernels(solver_kernels(elements_of(model.blocks), contact_law_of(scene)[0]), request.device,
                    progress=request.progress)
    options = limited(tiers.options(tier), request)
    ((solver, frames, (touch,)),) = rigid_touch.solve(
        scene, model, [aim], tier=tier, device=request.device, options=options, keep=True,
        progress=frames_done(request.progress, len(aim.path)))
    moved = np.stack([u[:, 0].reshape(-1, 3) for u in solver.history])
    push, body_force = np.stack([f[..., 0] for f in solver.surface_force]), frames.body_force[:, 0]
    names = ("probe", *(f"part {i + 1}" for i in range(len(scene.parts))),
             *(f"obstacle {i + 1}" for i in range(len(scene.obstacles))))
    surface = model.mesh.surface_nodes()
    effects.check_contact(scene, names, body_force, effects.nearest(
        solver.bodies, placed, model.mesh.points[surface] + moved[:, surface]), moved)
    way = (aim.path[:, :3, 3] - np.array(spec.start)) @ axis
    depth, normal = np.maximum(way - gap, 0.0), touch.normal_force()
    edge, full, at_contact = model.element_size, spec.inward - 1, edge_at(model, aim.target)
    tets, nodes = len(model.mesh.tets), len(model.mesh.points)
    body = Elements.of_quadratic(model.mesh.points, model.mesh.tets, model.young_modulus.mean(axis=1))
    faces = np.stack([face_pressure(model.mesh, f) for f in push])
    pressure = np.stack([node_pressure(model.mesh, p) for p in np.nan_to_num(faces)])
    deep = [f"The probe starts {1e3 * begun:.1f} mm inside the body, so depth counts from there "
            "and not from first contact; move from in [press] back to where the probe is free."]
    deep = deep if begun > 0.05 * way.max() else []  # less is the faceting of a round body
    more: dict[str, Any] = {
        "slipping": frames.slipping[:, 0], "seconds": frames.seconds, "body_force": body_force,
        "bodies": names, "friction": scene.frictions, "build_seconds": prepared.seconds,
        "tets": tets, "nodes": nodes, "tier": tier, "device": request.device,
        "element_size": prepared.element_size, "edge": edge, "edge_at_contact": at_contact,
        "volume": float(model.mesh.volume.sum()), "tolerance": options.tolerance,
        "inward": spec.inward, "parts_error": model.solid.parts,
        **{name: getattr(frames, name)[:, 0] for name in (
            "mesh_error", "law_error", "support_error", "corner_det_f", "rotation")}}
    told = in_words(frames.mesh_error[:, 0], frames.corner_det_f[:, 0], solver.linear * frames.rotation[:, 0],
                    touch.converged, frames.law_error[:, 0], frames.support_error[:, 0])
    said = [*filter(None, [told]),
            f"Tier {tier}, {tets} quadratic tetrahedra, {nodes} nodes, "
            f"element size {1e3 * prepared.element_size:.1f} mm, on {request.device}; built in "
            f"{prepared.seconds:.1f} s, solved in {frames.seconds.sum():.1f} s."]
    if len(names) > 1 or max(scene.frictions) > 0.0:
        said.insert(0, _bodies_in_words(names, scene.frictions, body_force[full], float(frames.slipping[full, 0])))
    # the triangles of a scan are of all sizes
    scan = isinstance(scene.required_object.shape, MeshFile)
    return PressResult(
        touch, depth, full, edge=(more["volume"] / tets) ** (1.0 / 3.0) if scan else at_contact,
        more=more, readings=(Column("turn rad", frames.rotation[:, 0], ".3f"),), said=tuple(said),
        notes=(*prepared.notes, *model.solid.notes, *deep),
        plot={"normal force [N]": {"reaction of the supports": -(touch.reaction @ axis),
                                   "force on the probe": normal}},
        model=f"tier {tier}, {tets} tetrahedra",
        headline=f"depth {1e3 * depth[full]:.2f} mm, normal force {normal[full]:.4g} N",
        caption="left: cut open where it is pressed; right: the whole body",
        panels=_panels(model, body, scene.bodies, placed, moved, pressure / 1e3, full),
        body=(body, moved, scene.probe, pressure), arrays={
            **_arrays(model, placed, moved, push, faces),
            "law_error": (more["law_error"], "part of mesh_error by small strain (T,) [-]"),
            "support_error": (more["support_error"], "part of mesh_error by the box that holds the body (T,) [-]")})


def _bodies_in_words(names: tuple[str, ...], friction: tuple[float, ...], force: np.ndarray, slipping: float) -> str:
    """The force on each body (K, 3) [N] at full depth, and the share of points that slip."""
    each = [f"{name}{f' (friction {mu:g})' if mu else ''} ({', '.join(f'{v:.4f}' for v in f + 0.0)}) N"
            for name, mu, f in zip(names, friction, force, strict=True)]
    end = f"; {100 * slipping:.0f} % of the points in contact slip." if max(friction) > 0.0 else "."
    return f"At full depth: {'; '.join(each)}{end}"


def _panels(model: Model, body: Elements, shapes: tuple[ProbeShape, ...], poses: np.ndarray, moved: np.ndarray,
            pressure: np.ndarray, full: int) -> Callable[[int], tuple[BodyPanel, ...]]:
    """Of a frame, the body cut open where it is pressed, with the rigid bodies; and whole, with the contact pressure.

    Args:
        model: the body.
        body: its elements.
        shapes: of the K rigid bodies.
        poses: of them (T, K, 4, 4) [m].
        moved: displacements (T, n, 3) [m].
        pressure: contact pressure at the nodes (T, n) [kPa].
        full: number of the frame of full depth.
    """
    mesh = model.mesh
    where = mesh.points + moved[full]
    at = (np.average(where, axis=0, weights=pressure[full]) if pressure[full].any() else poses[full, 0, :3, 3])
    normal = facing(body, at)
    size = float(np.ptp(where, axis=0).max())
    solid = [tessellate(shape, 1.2 * size) for shape in shapes]

    def placed(t: int) -> list[tuple[np.ndarray, np.ndarray]]:
        return [(v @ pose[:3, :3].T + pose[:3, 3], f) for (v, f), pose in zip(solid, poses[t], strict=True)]

    near, azimuth = np.concatenate([v for v, _ in placed(full)]), _AZIMUTH + float(np.arctan2(normal[1], normal[0]))
    left = opened(body, normal, at, moved[full])[0].vertices
    eye = fitting_camera(left[(left - at) @ normal < 0.01 * size], near, *PICTURE, azimuth=azimuth, elevation=0.35)
    above = fitting_camera(where, where, *PICTURE, azimuth=azimuth, elevation=0.8)
    modulus = of_modulus(body.young_modulus)
    label = "contact pressure, mean over elements [kPa]"
    pressures = Colours("inferno_r", 0.0, float(pressure[full].max()), label, True)

    def panels(t: int) -> tuple[BodyPanel, ...]:
        inside, shows = opened(body, normal, at, moved[t])
        # A wall between the camera and the body would hide it.
        shown = [halved(*part, normal, at) for part, shape, p in zip(placed(t), shapes, poses[t], strict=True)
                 if not (isinstance(shape, Plane) and float((eye[1][:3, 3] - p[:3, 3]) @ p[:3, 2]) < 0.0)]
        vertices, triangles, _, value = deformed_surface(mesh, moved[t], pressure[t], parts=6)
        surface = Surface(vertices, triangles, np.zeros(len(triangles), int), None, vertices)
        return (BodyPanel(inside, eye, PICTURE, tuple(shown),
                          np.where(shows < 0, np.nan, body.young_modulus[shows]), modulus),
                BodyPanel(surface, above, PICTURE, (), value, pressures))

    return panels


def _arrays(model: Model, poses: np.ndarray, moved: np.ndarray, push: np.ndarray,
            pressure: np.ndarray) -> dict[str, tuple[np.ndarray, str]]:
    mesh = model.mesh
    return {
        "points": (mesh.points, "nodes at rest, world (n, 3) [m]"),
        "tets": (mesh.tets, "quadratic tetrahedra (m, 10): corners, then the edges 01 12 20 03 13 23"),
        "faces": (mesh.faces, "boundary triangles (f, 6): corners, then the edges 01 12 20"),
        "surface_nodes": (mesh.surface_nodes(), "nodes on the boundary (s,)"),
        "displacement": (moved, "of every node (T, n, 3) [m]"),
        "contact_force": (push, "on every surface node (T, s, 3) [N]"),
        "contact_pressure": (pressure, "mean over every boundary triangle (T, f) [Pa]"),
        "young_modulus": (model.young_modulus.mean(axis=1), "mean of every tetrahedron (m,) [Pa]"),
        "poses": (poses, "rigid bodies to world (T, K, 4, 4) [m]")}


def edge_at(model: Model, point: np.ndarray) -> float:
    """Mean edge [m] of the two dozen boundary triangles nearest to ``point`` (3,) [m], of the body at rest."""
    corners = model.mesh.points[model.mesh.faces[:, :3]]
    near = np.argsort(np.linalg.norm(corners.mean(axis=1) - point, axis=1))[:24]
    return float(np.linalg.norm(corners[near] - np.roll(corners[near], 1, axis=1), axis=2).mean())


def overlap(model: Model, bodies: RigidBodies, pose: np.ndarray, where: str) -> float:
    """How deep the body's surface at rest lies inside the probe, the first of ``bodies`` (K), where the path begins at
    ``pose`` (K, 4, 4) [m]; 0 if they are apart.

    Raises:
        SceneError: a rigid body begins inside the object, see `increments.inside`. ``where`` is the scene file.
    """
    surface = model.mesh.points[model.mesh.surface_nodes()]
    depth = [-float(bodies.distance(k, (surface - at[:3, 3]) @ at[:3, :3]).min()) for k, at in enumerate(pose)]
    if inside(bodies, model, pose[None]).any():
        much = f"{1e3 * max(depth):.2g} mm of a rigid body" if max(depth) > 0.0 else "the whole probe"
        raise SceneError(f"{where} [press]: from = "
                         f"{[round(v, 6) for v in pose[0, :3, 3].tolist()]} puts {much} inside the "
                         "body, and from which side it came is not known; start outside (world "
                         "coordinates of the probe's centre, in metres).")
    return max(0.0, depth[0])


def tip(scene: Scene, centre: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """The leading point of the probe (3,) [m] when its centre is at ``centre``, moving along ``axis``."""
    assert scene.press is not None
    turn = pose_at(scene.press, scene.probe, scene.press.inward)[:3, :3]
    return centre + sdf.support(scene.probe, turn.T @ axis) * axis
