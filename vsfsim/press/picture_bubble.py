"""A press of a bubble as a picture of its deepest frame: from outside, as a map of the dent over the rim plane, and as
the camera inside sees it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.core.scene import Scene
from vsfsim.core.shape import Plane
from vsfsim.press.bubble import BubblePress, BubbleState, in_mount
from vsfsim.press.picture import (
    SIZE,
    TALL,
    coloured,
    deformed_surface,
    fitting_camera,
    tessellate,
    with_bodies,
)
from vsfsim.sensing.bubble_camera import BubbleCamera, look_inside
from vsfsim.sensing.camera import render
from vsfsim.sensing.membrane_fe import nodal_normals

if TYPE_CHECKING:
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

_LOW = 0.35  # rad: the camera outside looks up to the dome's side, not down on what presses it
_NEAR = 1.6  # of the dome's size: what is farther from it is left out
_DOT = 30.0  # square points: of the node with the greatest force
_COLOURS = "RdBu_r"  # of the dent: white where the skin is where it was


def picture(result: BubblePress, scene: Scene, title: str, path: Path, *, device: str = "cpu") -> None:
    """Draw the frame of full depth into ``path`` (PNG).

    Args:
        result: of a press that kept its state. scene: what was pressed. title: above everything. device: of the ray
        casters.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    state = result.state
    assert state is not None
    t = result.inward - 1
    mesh = state.model.mesh
    dent = 1e3 * inwards(state, t)
    # a scale of its own on either side: the skin bulges a tenth of what it is dented, all around
    norm = matplotlib.colors.TwoSlopeNorm(0.0, min(float(dent.min()), -1e-6), max(float(dent.max()), 1e-6))
    scale = matplotlib.cm.ScalarMappable(norm, _COLOURS)
    camera = BubbleCamera()
    height = TALL / 100 + 0.7
    widths = np.array([SIZE, 1.15 * SIZE, camera.width / camera.height * TALL]) / 100
    figure = Figure(figsize=(float(widths.sum()), height), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    left = np.concatenate([[0.0], np.cumsum(widths)]) / widths.sum()

    def panel(k: int, image: np.ndarray) -> None:
        axes = figure.add_axes((left[k], 0.4 / height, left[k + 1] - left[k], TALL / 100 / height))
        axes.imshow(image)
        axes.set_axis_off()

    panel(0, outside(state, scene, t, scale.to_rgba(dent[mesh.faces].mean(axis=1))[:, :3], device))
    _map(figure, (left[1] + 0.75 / widths.sum(), 0.95 / height, (widths[1] - 1.9) / widths.sum(),
                  (TALL / 100 - 0.75) / height), state, t, dent, norm)
    panel(2, look_inside(state.node_position[t:t + 1], mesh.faces, state.model.flat, camera, device=device).rgb[0])
    mark = "" if result.converged[t] else "   NOT CONVERGED"
    figure.text(0.01, 1.0 - 0.22 / height,
                f"{title}: depth {1e3 * result.depth[t]:.2f} mm, force {np.linalg.norm(result.force[t]):.4g} N, "
                f"pressure change {result.pressure_change[t]:.4g} Pa{mark}",
                va="center", fontsize=12)
    figure.text(0.01, 0.2 / height,
                f"bubble of {result.nodes} nodes; left: from outside; middle: how far the skin went in along the free "
                f"dome's normal, dots: nodes in contact, larger with their force; "
                "right: from the camera inside", va="center", fontsize=9, color="0.35")
    figure.savefig(path, dpi=100)


def inwards(state: BubbleState, t: int) -> np.ndarray:
    """How far every node of the skin (n,) [m] has gone in along the free dome's normal in frame ``t``; less than 0
    where it bulges out."""
    mesh = state.model.mesh
    return -((state.node_position[t] - mesh.points) * nodal_normals(mesh.points, mesh.faces)).sum(axis=1)


def outside(state: BubbleState, scene: Scene, t: int, colour: np.ndarray, device: str) -> np.ndarray:
    """The skin, one ``colour`` (f, 3) sRGB a triangle, and what presses it in grey, dome up (H, W, 3) uint8."""
    skin = state.node_position[t]
    size = float(np.ptp(skin, axis=0).max())
    if state.object is not None:
        assert state.object_displacement is not None
        turn, at = state.mount[t, :3, :3], state.mount[t, :3, 3]
        vertices, triangles, *_ = deformed_surface(state.object.mesh, state.object_displacement[t])
        solids = [((vertices - at) @ turn, triangles)]
    else:
        rigid = [tessellate(shape, 2.0 * size) for shape in scene.bodies]
        solids = [(v @ pose[:3, :3].T + pose[:3, 3], f) for (v, f),
                  pose in zip(rigid, in_mount(scene, state.mount[t:t + 1])[0], strict=True)]
    kept = [_within(v, f, skin.mean(axis=0), _NEAR * size) for v, f in solids]
    intrinsics, pose = fitting_camera(skin, np.concatenate([skin, *(v[np.unique(f)] for v, f in kept)]), elevation=_LOW)
    # a plate between the camera and the dome would hide all there is to see: it is left out
    flat = [isinstance(shape, Plane) for shape in scene.bodies] if state.object is None else [False]
    shown = [(v, f) for (v, f), plate in zip(kept, flat, strict=True) if not (plate and pose[2, 3] > v[:, 2].max())]
    body = coloured(skin, state.model.mesh.faces, colour)
    body = with_bodies(body, [v for v, _ in shown], [f for _, f in shown]) if shown else body
    return render(body, intrinsics, pose, SIZE, TALL, device=device, shading=0.55, background=(255, 255, 255)).rgb


def _within(vertices: np.ndarray, triangles: np.ndarray, middle: np.ndarray,
            reach: float) -> tuple[np.ndarray, np.ndarray]:
    """The triangles with a corner within ``reach`` [m] of ``middle`` (3,)."""
    near = np.linalg.norm(vertices - middle, axis=1) < reach
    return vertices, triangles[near[triangles].any(axis=1)]


def _map(figure: Figure, place: tuple[float, float, float, float], state: BubbleState, t: int, dent: np.ndarray,
         norm: Normalize) -> None:
    """The dent (n,) [mm] over the rim plane, and the nodes in contact."""
    mesh = state.model.mesh
    axes = figure.add_axes(place)
    x, y = 1e3 * mesh.points[:, 0], 1e3 * mesh.points[:, 1]
    drawn = axes.tripcolor(x, y, mesh.faces, dent, shading="gouraud", cmap=_COLOURS, norm=norm)
    force = np.linalg.norm(state.node_force[t], axis=1)
    touching = force > 0.0
    if touching.any():
        axes.scatter(x[touching], y[touching], s=_DOT * force[touching] / force.max(), color="k", linewidths=0.0)
    axes.set_aspect("equal")
    axes.set_xlabel("x of the mount, free dome [mm]")
    axes.set_ylabel("y [mm]")
    ticks = [norm.vmin, 0.5 * norm.vmin, 0.0, 0.5 * norm.vmax, norm.vmax]
    figure.colorbar(drawn, ax=axes, fraction=0.04, pad=0.02, ticks=ticks, format=lambda value,
                    _: f"{value:.2g}").set_label("inwards [mm]")
