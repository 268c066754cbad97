"""The press of an air-filled bubble: force and pressure against depth, its dent, and its convergence."""

from __future__ import annotations

import dataclasses
from typing import Any, cast

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import SceneFile
from vsfsim.core.shape import Capsule, Plane, Sphere
from vsfsim.generate.press_result import (
    BodyPanel,
    Camera,
    Colours,
    Column,
    Curves,
    ImagePanel,
    MapPanel,
    MeshSeries,
    PressRequest,
    PressResult,
)
from vsfsim.generate.presses.boundary import deformed_surface
from vsfsim.generate.presses.bubble_solve import OPTIONS, Solved, in_mount, solve
from vsfsim.generate.presses.dent import dent, inward_distance
from vsfsim.generate.presses.verdict import (
    FORCES,
    direction,
    force_columns,
    of_mesh,
    path_notes,
    series,
    solved,
    solver_columns,
    statement,
)
from vsfsim.physics.bubble.sensor import SHARE
from vsfsim.physics.mesh.membrane import TriangleMesh
from vsfsim.sensing.bubble import readout_of
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside
from vsfsim.sensing.camera import fitting_camera
from vsfsim.sensing.surface import Surface
from vsfsim.sensing.tessellate import tessellate

PICTURE = (640, 512)  # width and height of a view [px]
_ELEVATION = 0.35  # of the camera outside [rad]: it looks at the dome's side, not at the back of what presses it
_NEAR = 1.6  # what is farther from the dome than this many times its size is not drawn


def press(loaded: SceneFile, request: PressRequest) -> PressResult:
    """Carry out the ``[press]`` of a scene with a ``[sensor]`` and an object, or obstacles.

    Raises:
        SceneError: no path, both an object and obstacles, a tier that a sensor cannot press, or something that cannot
            be built.
    """
    return result_of(solve(loaded.sample(request.seed), request), request)


def result_of(s: Solved, request: PressRequest) -> PressResult:
    """What `vsfsim press` needs of the frames."""
    model, frames, full = s.model, s.frames, s.full
    edge, wrench = model.element_size, s.wrench
    depth, force = np.maximum(s.way - s.gap, 0.0), np.einsum("tij,tj->ti", s.mount[:, :3, :3], wrench[:, :3])
    change, volume = s.pressure - model.pressure, s.volume + model.dead_volume
    said = statement(frames, edge=edge, tolerance=s.tolerance, det_f=False)
    fields, more = solved(frames)
    apex, dome = float(model.mesh.points[:, 2].max()), float(model.mesh.volume[0])
    triangles, nodes = len(model.mesh.faces), len(model.mesh.points)
    more |= {"body_force": s.body_force, "bodies": s.bodies, "friction": s.friction, "wrench": wrench,
             "pressure": s.pressure, "pressure_change": change, "volume": volume,
             "cg_iterations": frames.cg_iterations[:, 0], "apex": apex, "dome_volume": dome, "edge": edge,
             "build_seconds": s.build_seconds, "triangles": triangles, "nodes": nodes, "device": request.device,
             "precision": "float64", "tolerance": s.tolerance, "inward": full + 1, "statement": said}
    axis = direction(s.path)
    normal = -(force @ axis)
    at_full = wrench[full] + 0.0
    words = (FORCES, f"At full depth, wrench of the contact at the mount, in its frame: "
             f"({', '.join(f'{v:.4f}' for v in at_full[:3])}) N, ({', '.join(f'{v:.5f}' for v in at_full[3:])}) N m; "
             f"{100 * more['slipping'][full]:.0f} % of the points in contact slip.", said,
             f"Free dome: apex {1e3 * apex:.2f} mm, {1e6 * dome:.2f} mL, {model.pressure:.1f} Pa gauge. {triangles} "
             f"triangles, {nodes} nodes, mean edge where it is touched {1e3 * edge:.2f} mm, on {request.device}; "
             f"built in {s.build_seconds:.1f} s, solved in {frames.seconds.sum():.1f} s.")
    return PressResult(
        depth=depth, force=force, axis=axis, reaction=s.reaction, **fields, deepest=full, more=more,
        columns=(*force_columns(depth, force, axis), Column("pressure Pa", s.pressure, ".2f"),
                 Column("change Pa", change, ".2f"), Column("volume mL", 1e6 * volume, ".4f"),
                 Column("balance", frames.force_balance[:, 0], ".1e"), *solver_columns(frames, edge)),
        words=words, notes=(*path_notes(s.gap, float(s.way.max())), *s.notes),
        plot=(Curves("normal force [N]", {"force on the sensor": normal}),
              Curves("pressure change [Pa]", {"gas": change})),
        abscissa="depth past first contact [mm]", model=f"bubble of {nodes} nodes",
        headline=f"depth {1e3 * depth[full]:.2f} mm, normal force {normal[full]:.4g} N, pressure change "
                 f"{change[full]:.4g} Pa",
        caption="left: from outside; middle: how far the skin went in along the free dome's normal, dots: nodes in "
                "contact, larger with their force; right: from the camera inside",
        panels=(lambda t: _panels(s, t, request.device)) if request.keep else None,
        arrays={**_arrays(s, change, volume), **series(depth, force, s.reaction, fields, "of the mount, world")}
        if request.keep else {})


def _arrays(s: Solved, change: np.ndarray, volume: np.ndarray) -> dict[str, tuple[np.ndarray, str]]:
    mesh, read_out = cast(TriangleMesh, s.model.mesh), s.model.read_out
    return {
        "node_position": (read_out.positions(s.position), "read-out mesh, mount frame (T, 390, 3) [m]"),
        "node_force": (readout_of(s.model).forces(s.position, s.push),
                       "contact force transferred to its nodes, mount frame (T, 390, 3) [N]"),
        "free_node_position": (read_out.positions(mesh.points), "read-out mesh of the free dome (390, 3) [m]"),
        "faces": (read_out.faces, "triangles of the read-out mesh, wound outwards (714, 3)"),
        "rim": (read_out.rim, "its clamped nodes in order (64,)"),
        "fine_position": (s.position, "fine mesh, mount frame (T, n, 3) [m]"),
        "fine_force": (s.push, "contact force on its nodes, mount frame (T, n, 3) [N]"),
        "free_fine_position": (mesh.points, "fine mesh of the free dome (n, 3) [m]"),
        "fine_faces": (mesh.faces, "its triangles (f, 3)"), "fine_rim": (mesh.rim, "its clamped nodes in order (r,)"),
        "mount_pose": (s.mount, "mount to world (T, 4, 4) [m]"),
        "wrench": (s.wrench, "of the contact at the mount's origin, mount frame: force, moment (T, 6) [N, N m]"),
        "pressure": (s.pressure, "gauge (T,) [Pa]"), "pressure_change": (change, "since the free dome (T,) [Pa]"),
        "volume": (volume, "of the gas (T,) [m^3]")}


def _panels(s: Solved, t: int, device: str) -> tuple[BodyPanel, MapPanel, ImagePanel]:
    """The dent of frame ``t`` from outside, over the rim plane, and seen by the camera inside; in the colours of the
    frame of full depth."""
    mesh = s.model.mesh
    inward, most = (1e3 * inward_distance(s.model, s.position[k]) for k in (t, s.full))
    colours = Colours("RdBu_r", min(float(most.min()), -1e-6), max(float(most.max()), 1e-6))
    inside = look_inside(s.position[t:t + 1], mesh.faces, s.model.flat, BubbleCamera(), device=device).rgb[0]
    return (outside(s, t, inward[mesh.faces].mean(axis=1), colours),
            MapPanel(1e3 * mesh.points[:, :2], mesh.faces, inward, np.nan_to_num(np.linalg.norm(s.push[t], axis=1)),
                     dataclasses.replace(colours, label="inwards [mm]"), ("x of the mount, free dome [mm]", "y [mm]")),
            ImagePanel(inside))


def outside(s: Solved, t: int, values: np.ndarray, colours: Colours) -> BodyPanel:
    """The skin in frame ``t``, dome up, with one value a triangle (f,), and what presses it."""
    skin = s.position[t]
    size = float(np.ptp(skin, axis=0).max())
    if s.object is not None:
        assert s.moved is not None
        turn, at = s.mount[t, :3, :3], s.mount[t, :3, 3]
        vertices, triangles, *_ = deformed_surface(s.object.mesh, s.moved[t])
        solids, plates = [((vertices - at) @ turn, triangles)], [False]
    else:
        solids = [(v @ pose[:3, :3].T + pose[:3, 3], f)
                  for (v, f), pose in zip((tessellate(shape, 2.0 * size) for shape in s.scene.bodies),
                                          in_mount(s.scene, s.mount[t:t + 1])[0], strict=True)]
        plates = [isinstance(shape, Plane) for shape in s.scene.bodies]
    close = [(v, _within(v, f, skin.mean(axis=0), _NEAR * size)) for v, f in solids]
    intrinsics, pose = fitting_camera(skin, np.concatenate([skin, *(v[np.unique(f)] for v, f in close)]), *PICTURE,
                                      elevation=_ELEVATION)
    # A plate between the camera and the dome would hide it.
    rigid = tuple((v, f) for (v, f), plate in zip(close, plates, strict=True)
                  if not (plate and pose[2, 3] > v[:, 2].max()))
    surface = Surface(skin, s.model.mesh.faces, np.zeros(len(s.model.mesh.faces), int), None, skin)
    return BodyPanel(surface, Camera(intrinsics, pose, *PICTURE), rigid, values, colours)


def _within(vertices: np.ndarray, triangles: np.ndarray, middle: np.ndarray, reach: float) -> np.ndarray:
    """The triangles (g, 3) with a corner within ``reach`` [m] of ``middle`` (3,)."""
    return triangles[(np.linalg.norm(vertices - middle, axis=1) < reach)[triangles].any(axis=1)]


def refine(loaded: SceneFile, request: PressRequest, meshes: int) -> MeshSeries:
    """The press on rigid bodies with finer and finer triangles where they touch.

    Edges at the contact are halved from mesh to mesh; the mesh before the last is that of `press`.

    Raises:
        SceneError: an object is pressed, or bodies without a radius and no contact_edge is given.
    """
    scene = loaded.sample(request.seed)
    bubble = scene.required_sensor
    if scene.object is not None:
        raise SceneError(f"{scene.source}: --refine refines a [sensor] where rigid bodies touch it; with an [object] "
                         f"set nodes in [sensor] and resolution in [object], and compare.")
    edge = bubble.contact_edge
    if edge is None:
        radii = [body.radius for body in scene.bodies if isinstance(body, (Sphere, Capsule))]
        if not radii:
            raise SceneError(f"{scene.source}: --refine halves the edges where bodies touch, which follow the radius "
                             f"of balls and capsules; for other bodies give contact_edge in [sensor].")
        edge = SHARE * min(radii)
    results, rows = [], []
    for k in range(meshes):
        asked = dataclasses.replace(request, keep=request.keep and k == meshes - 1,
                                    progress=of_mesh(request.progress, k, meshes))
        sensor = dataclasses.replace(bubble, contact_edge=edge * 2.0 ** (meshes - 2 - k))
        found = solve(dataclasses.replace(scene, sensor=sensor), asked)
        results.append(result_of(found, asked))
        rows += _rows(found, results[-1])
    force, change = ([float(values) for values in column] for column in
                     zip(*((r.normal_force[r.deepest], r.more["pressure_change"][r.deepest]) for r in results),
                         strict=True))

    def column(heading: str, key: str, form: str, scale: float = 1.0) -> Column:
        return Column(heading, [scale * row[key] for row in rows], form)

    columns = (Column("nodes", [row["nodes"] for row in rows], "d"), column("edge mm", "edge", ".2f", 1e3),
               column("depth mm", "depth", ".2f", 1e3), column("normal N", "normal_force", ".4f"),
               column("change Pa", "pressure_change", ".1f"), column("dent radius mm", "dent_radius", ".2f", 1e3),
               column("bulge mm", "bulge", ".3f", 1e3), column("s a frame", "seconds", ".2f"),
               column("Newton a frame", "newton", ".1f"))
    return MeshSeries(tuple(results), tuple(r.more["edge"] for r in results),
                      {"normal force": ("N", force), "pressure change": ("Pa", change)}, OPTIONS.tolerance,
                      f"The press on {meshes} meshes, at half and at full depth:", columns, rows,
                      f"{', '.join(str(r.more['nodes']) for r in results)} nodes",
                      "give fewer meshes, or a smaller contact_edge in [sensor]")


def _rows(s: Solved, r: PressResult) -> list[dict[str, Any]]:
    """Numbers of one mesh at half and at full depth."""
    axis = -s.mount[0, :3, :3].T @ direction(s.path)  # way of the bodies into the dome, mount frame
    half = int(np.abs(r.depth[:r.deepest + 1] - 0.5 * r.depth[r.deepest]).argmin())
    out = []
    for t in (half, r.deepest):
        shape = dent(s.model, s.position[t], axis)
        out.append({"nodes": r.more["nodes"], "edge": r.more["edge"], "depth": float(r.depth[t]),
                    "normal_force": float(r.normal_force[t]), "pressure_change": float(r.more["pressure_change"][t]),
                    "dent_depth": shape.depth, "dent_radius": shape.radius, "bulge": shape.bulge,
                    "converged": bool(r.converged[t]), "seconds": float(r.more["seconds"].mean()),
                    "newton": float(r.iterations.mean())})
    return out
