"""One picture of an object from all around, and of how stiff it is."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from vsfsim.core.scene import CameraSpec
from vsfsim.data.disk import write_figure
from vsfsim.sensing.camera import look_at, render
from vsfsim.sensing.surface import RenderError, Surface, flat_coloured


def turntable(surface: Surface, out_png: str | Path, *, frames: int = 8, columns: int = 4, size: int = 320,
              elevation: float = 0.5, young_modulus: np.ndarray | None = None, title: str = "",
              device: str = "cpu", renderer: str = "warp") -> None:
    """Draw an object from ``frames`` azimuths around it.

    Args:
        surface: the object.
        out_png: the file to write.
        frames: how many views, evenly round.
        columns: views a row.
        size: edge of one view [px].
        elevation: of the camera over the horizon [rad].
        young_modulus: of each triangle (f,) [Pa]; given, each row of views gets a second row below, coloured by it
            on a log scale, with a colour bar.
        title: above everything.
        device, renderer: as in `vsfsim.sensing.camera.render`.

    Raises:
        RenderError: no frames, a modulus that is not positive or not one a triangle, or what `render` refuses.
    """
    if frames < 1 or columns < 1 or size < 16:
        raise RenderError(f"turntable: frames {frames}, columns {columns}, size {size}; give at least 1, 1 and 16.")
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    looks = [(surface, 1.0)]
    scale = None
    if young_modulus is not None:
        modulus = np.asarray(young_modulus, np.float64)
        if modulus.shape != (len(surface.triangles),) or not (np.isfinite(modulus).all() and (modulus > 0.0).all()):
            raise RenderError(f"turntable: young_modulus has shape {modulus.shape}; give a positive number of pascals "
                              f"a triangle, ({len(surface.triangles)},).")
        # A body of one modulus still gets a bar with two ends, and a power of ten on it to read.
        room = 1.05 if modulus.max() > 10.0 * modulus.min() else 3.5
        low, high = modulus.min() / room, modulus.max() * room
        scale = matplotlib.cm.ScalarMappable(matplotlib.colors.LogNorm(low, high), "viridis")
        # Little shade, so that a colour can be found again on the bar.
        looks.append((flat_coloured(surface.vertices, surface.triangles, scale.to_rgba(modulus)[:, :3],
                                    surface.rest_vertices), 0.45))
    columns = min(columns, frames)
    rows = math.ceil(frames / columns)
    middle = 0.5 * (surface.vertices.min(axis=0) + surface.vertices.max(axis=0))
    distance = 4.0 * max(float(np.linalg.norm(surface.vertices - middle, axis=1).max()), 1e-6)
    poses = [look_at(CameraSpec(size, size, 0.5, distance, azimuth, elevation), middle)[1]
             for azimuth in 2.0 * math.pi * np.arange(frames) / frames]
    intrinsics, tall = _framing(surface.vertices, poses, size)
    inch, high_inch = size / 100.0, tall / 100.0
    head, bar = 0.35, 0.9 if scale is not None else 0.0
    figure = Figure(figsize=(columns * inch + bar, rows * len(looks) * high_inch + head), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    width, height = figure.get_size_inches()
    for k, pose in enumerate(poses):
        for j, (look, shading) in enumerate(looks):
            row = (k // columns) * len(looks) + j
            axes = figure.add_axes(((k % columns) * inch / width, 1.0 - (head + (row + 1) * high_inch) / height,
                                    inch / width, high_inch / height))
            axes.imshow(render(look, intrinsics, pose, size, tall, device=device, renderer=renderer,
                               shading=shading).rgb)
            axes.set_axis_off()
            if j == 0:
                axes.text(0.03, 0.96, f"{360.0 * k / frames:.0f}°", transform=axes.transAxes, va="top", fontsize=9,
                          color="0.25")
    extent = surface.vertices.max(axis=0) - surface.vertices.min(axis=0)
    name = f"{title}   " if title else ""
    figure.text(0.01, 1.0 - 0.5 * head / height,
                f"{name}{' × '.join(f'{1e3 * e:.0f}' for e in extent)} mm, {len(surface.triangles)} triangles",
                va="center", fontsize=10)
    if scale is not None:
        length = min(4.0, height - head - 0.4)
        axes = figure.add_axes(((width - bar + 0.12) / width, 0.5 - 0.5 * (length + head) / height, 0.16 / width,
                                length / height))
        figure.colorbar(scale, cax=axes).set_label("Young's modulus [Pa]", fontsize=9)
        # powers of ten alone leave room for the label
        axes.yaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
    write_figure(figure, out_png)


def _framing(vertices: np.ndarray, poses: list[np.ndarray], size: int) -> tuple[np.ndarray, int]:
    """Intrinsics (3, 3) and picture height [px] that fit the object tightly into every view of width ``size``."""
    reach = np.zeros(2)
    for pose in poses:
        camera = (vertices - pose[:3, 3]) @ pose[:3, :3]
        reach = np.maximum(reach, np.abs(camera[:, :2] / camera[:, 2:]).max(axis=0))
    reach = np.maximum(1.12 * reach, 1e-6)
    focal = 0.5 * size / max(reach[0], reach[1] / 1.5)
    # Room for the angle's label above a flat object, and no picture taller than one and a half times its width.
    tall = max(round(2.0 * focal * reach[1]), 48)
    return np.array([[focal, 0.0, 0.5 * (size - 1)], [0.0, focal, 0.5 * (tall - 1)], [0.0, 0.0, 1.0]]), tall
