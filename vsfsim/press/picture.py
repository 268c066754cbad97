"""A press as a picture: the deformed body at full depth, once with the rigid bodies and coloured by displacement, once
without and coloured by contact pressure."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from vsfsim.core.scene import CameraSpec
from vsfsim.core.shape import Box, Capsule, Cylinder, MeshFile, Plane, ProbeShape, Sphere
from vsfsim.core.solid import Appearance
from vsfsim.physics.contact import sdf
from vsfsim.physics.mesh.quadratic import QuadraticMesh
from vsfsim.press.probe import PressResult
from vsfsim.sensing.camera import look_at, render
from vsfsim.sensing.surface import Surface

SIZE, TALL = 640, 512  # of one view [px]
ROUND = 48  # sides of a round probe
# Of a quadratic triangle (corners 0 1 2, edges 3 4 5) at three by three by three barycentric points a side: drawn as it
# bends
_SPLIT = 3


def picture(result: PressResult, title: str, path: Path, *, device: str = "cpu") -> None:
    """Draw the frame of full depth into ``path`` (PNG).

    Args:
        result: of a press that kept its state. title: above everything. device: of the ray caster.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    state = result.state
    assert state is not None
    t = result.inward - 1
    mesh = state.model.mesh
    vertices, triangles, owner, values = deformed_surface(mesh, state.displacement[t])
    pressure = face_pressure(mesh, state.surface_force[t])[owner]
    size = float(np.ptp(vertices, axis=0).max())
    rigid = [tessellate(shape, 1.2 * size) for shape in state.bodies.shapes]
    placed = [v @ pose[:3, :3].T + pose[:3, 3] for (v, _), pose in zip(rigid, state.poses[t], strict=True)]
    looks = [(1e3 * values, "displacement [mm]", "viridis", True),
             (pressure / 1e3, "contact pressure [kPa]", "inferno_r", False)]
    intrinsics, pose = fitting_camera(vertices, np.concatenate(placed))
    # a wall or a plate between the camera and the body would hide all there is to see: it is left out
    hides = [isinstance(shape, Plane) and float((pose[:3, 3] - p[:3, 3]) @ p[:3, 2]) < 0.0 for shape,
             p in zip(state.bodies.shapes, state.poses[t], strict=True)]
    placed, faces = ([x for x, h in zip(every, hides, strict=True) if not h]
                     for every in (placed, [f for _, f in rigid]))
    figure = Figure(figsize=(2 * (SIZE / 100 + 0.9), TALL / 100 + 0.7), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    width, height = figure.get_size_inches()
    for k, (value, label, colours, with_rigid) in enumerate(looks):
        scale = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0.0, max(float(value.max()), 1e-12)), colours)
        colour = scale.to_rgba(value)[:, :3]
        if not with_rigid:
            colour[value <= 0.0] = 0.82  # free surface
        shown = coloured(vertices, triangles, colour)
        if with_rigid:
            shown = shown if not placed else with_bodies(shown, placed, faces)
        image = render(shown, intrinsics, pose, SIZE, TALL, device=device, shading=0.55, background=(255, 255, 255)).rgb
        left = k * 0.5
        axes = figure.add_axes((left, 0.08, SIZE / 100 / width, TALL / 100 / height))
        axes.imshow(image)
        axes.set_axis_off()
        bar = figure.add_axes((left + (SIZE / 100 + 0.05) / width, 0.25, 0.14 / width, 0.5))
        figure.colorbar(scale, cax=bar).set_label(label, fontsize=9)
    force = np.linalg.norm(result.force[t])
    mark = "" if result.converged[t] else "   NOT CONVERGED"
    figure.text(0.01, 1.0 - 0.22 / height, f"{title}: depth {1e3 * result.depth[t]:.2f} mm, force {force:.4g} N{mark}",
                va="center", fontsize=12)
    figure.text(0.01, 0.2 / height,
                f"tier {result.tier}, {result.tets} tetrahedra; left: with the rigid bodies; right: the body alone",
                va="center", fontsize=9, color="0.35")
    figure.savefig(path, dpi=100)


def deformed_surface(mesh: QuadraticMesh, displacement: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray,
                                                                             np.ndarray]:
    """The boundary as it bends: every quadratic triangle cut into nine.

    Args:
        mesh: the body. displacement: of its nodes (n, 3) [m].

    Returns:
        vertices (v, 3) [m]; triangles (g, 3); the boundary triangle each lies on (g,); length of the displacement at
        its middle (g,) [m].
    """
    from vsfsim.physics.contact.patch import shape_values

    n = _SPLIT
    at = np.array([(i, j, n - i - j) for i in range(n, -1, -1) for j in range(n - i, -1, -1)]) / n
    number = {tuple(np.rint(n * row).astype(int)): k for k, row in enumerate(at)}
    cut = []
    for i in range(n):
        for j in range(n - i):
            k = n - 1 - i - j
            a, b, c = number[i + 1, j, k], number[i, j + 1, k], number[i, j, k + 1]
            cut.append((a, b, c))
            if k > 0:
                cut.append((number[i + 1, j + 1, k - 1], number[i, j + 1, k], number[i + 1, j, k]))
    moved = mesh.points + displacement
    shape = shape_values(at)
    points = np.einsum("sa,fac->fsc", shape, moved[mesh.faces])
    length = np.linalg.norm(np.einsum("sa,fac->fsc", shape, displacement[mesh.faces]), axis=2)
    faces = len(mesh.faces)
    triangles = (np.array(cut)[None] + len(at) * np.arange(faces)[:, None, None]).reshape(-1, 3)
    # the copies of a corner in neighbouring triangles become one again, so that the shading is smooth
    _, first, same = np.unique(np.round(points.reshape(-1, 3) / (1e-7 * np.ptp(moved, axis=0).max())).astype(np.int64),
                               axis=0, return_index=True, return_inverse=True)
    vertices = points.reshape(-1, 3)[first]
    middle = length[:, np.array(cut)].mean(axis=2).reshape(-1)
    return vertices, same.reshape(-1)[triangles], np.repeat(np.arange(faces), len(cut)), middle


def face_pressure(mesh: QuadraticMesh, surface_force: np.ndarray) -> np.ndarray:
    """Mean contact pressure on every boundary triangle (f,) [Pa], smeared over about one element.

    A nodal force is shared by the triangles around its node, by area; under a uniform pressure that gives it back
    exactly where edges are inside the patch, because the corners of a quadratic triangle then carry nothing.

    Args:
        mesh: the body. surface_force: on the nodes of ``mesh.surface_nodes()`` (s, 3) [N].
    """
    force = np.zeros_like(mesh.points)
    force[mesh.surface_nodes()] = surface_force
    area = mesh.face_area()
    around = np.zeros(len(mesh.points))
    np.add.at(around, mesh.faces, area[:, None])
    share = force / np.where(around > 0.0, around, 1.0)[:, None]
    return np.linalg.norm(share[mesh.faces].sum(axis=1), axis=1)


def tessellate(shape: ProbeShape, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of a rigid shape in its own frame: vertices (v, 3) [m], corners (g, 3); a plane is a square of edge
    ``size`` [m]."""
    half = 0.5 * size
    match shape:
        case MeshFile():
            grid = sdf.grid(shape)
            return grid.vertices, grid.faces
        case Box(edges):
            return _block(*(0.5 * e for e in edges))
        case Plane():
            vertices, faces = _block(half, half, 0.01 * size)
            return vertices - [0.0, 0.0, 0.01 * size], faces
        case Sphere(radius):
            angle = np.linspace(0.0, math.pi, ROUND // 2 + 1)
            return _revolved(radius * np.sin(angle), radius * np.cos(angle))
        case Capsule(radius, length):
            angle = np.linspace(0.0, math.pi, ROUND // 2 + 2)
            lift = 0.5 * length * np.where(angle < 0.5 * math.pi, 1.0, -1.0)
            return _revolved(radius * np.sin(angle), radius * np.cos(angle) + lift)
        case Cylinder(radius, height):
            return _revolved(np.array([0.0, radius, radius, 0.0]), 0.5 * height * np.array([1.0, 1.0, -1.0, -1.0]))
    raise AssertionError(shape)


def _block(x: float, y: float, z: float) -> tuple[np.ndarray, np.ndarray]:
    corners = np.array([(i, j, k) for i in (-x, x) for j in (-y, y) for k in (-z, z)])
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])


def _revolved(radius: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A profile, from the top to the bottom, turned about z."""
    turn = 2.0 * math.pi * np.arange(ROUND) / ROUND
    vertices = np.stack([np.outer(radius, np.cos(turn)), np.outer(radius, np.sin(turn)),
                         np.repeat(height[:, None], ROUND, axis=1)], axis=-1).reshape(-1, 3)
    i, k = np.meshgrid(np.arange(len(radius) - 1), np.arange(ROUND), indexing="ij")
    a, b = i * ROUND + k, i * ROUND + (k + 1) % ROUND
    faces = np.concatenate([np.stack([a, a + ROUND, b + ROUND], axis=-1).reshape(-1, 3),
                            np.stack([a, b + ROUND, b], axis=-1).reshape(-1, 3)])
    size = np.linalg.norm(np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]],
                                   vertices[faces[:, 2]] - vertices[faces[:, 0]]), axis=1)
    return vertices, faces[size > 0.0]


def fitting_camera(vertices: np.ndarray, probe: np.ndarray, *, elevation: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) [px] and pose (4, 4) of a camera so far above the horizon [rad], that fits ``vertices`` and the
    ``probe`` (k, 3) [m] next to them tightly."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    middle, reach = 0.5 * (low + high), float(np.linalg.norm(high - low))
    # the part of the probe that is near the body; a plane or a long handle would push the camera away
    near = np.concatenate([vertices, probe[np.linalg.norm(probe - middle, axis=1) < 0.75 * reach]])
    pose = look_at(CameraSpec(SIZE, TALL, 0.5, 3.0 * reach, -1.0, elevation), middle)[1]
    seen = (near - pose[:3, 3]) @ pose[:3, :3]
    seen = seen[:, :2] / seen[:, 2:]
    first, last = seen.min(axis=0), seen.max(axis=0)
    focal = 0.92 * float((np.array([SIZE, TALL]) / (last - first)).min())
    centre = 0.5 * np.array([SIZE - 1, TALL - 1]) - focal * 0.5 * (first + last)
    return np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]]), pose


def coloured(vertices: np.ndarray, triangles: np.ndarray, colour: np.ndarray) -> Surface:
    """A surface in plain colours (g, 3) sRGB, one a triangle."""
    shades, region = np.unique(np.rint(colour * 255).astype(int), axis=0, return_inverse=True)
    plain = len(shades)
    # the renderer works in linear light
    return Surface(vertices, triangles, region.reshape(-1), Appearance((shades / 255.0) ** 2.2, ("plain",) * plain,
                                                                       np.ones(plain), np.zeros(plain)), vertices)


def with_bodies(body: Surface, placed: list[np.ndarray], faces: list[np.ndarray]) -> Surface:
    """The body and grey rigid bodies in one surface."""
    look = body.appearance
    assert look is not None
    start = np.cumsum([len(body.vertices), *(len(v) for v in placed)])
    vertices = np.concatenate([body.vertices, *placed])
    triangles = np.concatenate([body.triangles, *(f + s for f, s in zip(faces, start, strict=False))])
    grey = len(look.texture)
    region = np.concatenate([body.region, np.full(sum(len(f) for f in faces), grey)])
    return Surface(vertices, triangles, region, Appearance(np.vstack([look.albedo, [0.35, 0.37, 0.40]]),
                                                           (*look.texture, "plain"), np.ones(grey + 1),
                                                           np.zeros(grey + 1)), vertices)
