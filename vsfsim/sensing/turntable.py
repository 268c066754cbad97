"""One picture of an object from all around, and of how stiff it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vsfsim.core.scene import CameraSpec
from vsfsim.core.system.interactive import new_figure
from vsfsim.data.disk import write_figure
from vsfsim.sensing.camera import look_at, render
from vsfsim.sensing.surface import Surface, flat_coloured

ROWS, COLUMNS = 2, 4  # of views, evenly round the object
SIZE = 320  # width of a view [px]
ELEVATION = 0.5  # of the camera over the horizon [rad]
_DPI = 100


def turntable(surface: Surface, out_png: str | Path, *, young_modulus: np.ndarray | None = None, title: str = "",
              device: str = "cpu") -> None:
    """Draw an object from `ROWS` x `COLUMNS` azimuths around it.

    Args:
        surface: the object.
        out_png: the file to write.
        young_modulus: of each triangle (f,) [Pa]; given, each row of views gets a second row below, coloured by it
            on a log scale, with a colour bar.
        title: above everything.
        device: as in `vsfsim.sensing.camera.render`.

    Raises:
        RenderError: what `render` refuses.
    """
    import matplotlib

    looks, scale = [(surface, 1.0)], None
    if young_modulus is not None:
        # A body of one modulus still gets a bar with two ends, and a power of ten on it to read.
        room = 1.05 if young_modulus.max() > 10.0 * young_modulus.min() else 3.5
        scale = matplotlib.cm.ScalarMappable(matplotlib.colors.LogNorm(
            young_modulus.min() / room, young_modulus.max() * room), "viridis")
        # Little shade, so that a colour can be found again on the bar.
        looks.append((flat_coloured(surface.vertices, surface.triangles, scale.to_rgba(young_modulus)[:, :3],
                                    surface.rest_vertices), 0.45))
    low, high = surface.vertices.min(axis=0), surface.vertices.max(axis=0)
    middle, angles = 0.5 * (low + high), 2.0 * np.pi * np.arange(ROWS * COLUMNS) / (ROWS * COLUMNS)
    distance = 4.0 * max(float(np.linalg.norm(surface.vertices - middle, axis=1).max()), 1e-6)
    poses = [look_at(CameraSpec(SIZE, SIZE, 0.5, distance, azimuth, ELEVATION), middle)[1] for azimuth in angles]
    intrinsics, tall = _framing(surface.vertices, poses)
    figure = new_figure(figsize=(COLUMNS * SIZE / _DPI + 1.0, ROWS * len(looks) * (tall / _DPI + 0.2) + 0.4), dpi=_DPI,
                        facecolor="white", layout="constrained")
    axes = figure.subplots(ROWS * len(looks), COLUMNS, squeeze=False, gridspec_kw={"wspace": 0.0, "hspace": 0.0})
    for k, (angle, pose) in enumerate(zip(angles, poses, strict=True)):
        for j, (look, shading) in enumerate(looks):
            panel = axes[k // COLUMNS * len(looks) + j, k % COLUMNS]
            panel.imshow(render(look, intrinsics, pose, SIZE, tall, device=device, shading=shading).rgb)
            panel.set_axis_off()
        axes[k // COLUMNS * len(looks), k % COLUMNS].set_title(f"{np.degrees(angle):.0f}°", fontsize=9, color="0.25")
    figure.suptitle(f"{title}   {' × '.join(f'{1e3 * e:.0f}' for e in high - low)} mm, "
                    f"{len(surface.triangles)} triangles".strip(), fontsize=10)
    if scale is not None:
        bar = figure.colorbar(scale, ax=axes, shrink=0.6, aspect=25)
        bar.set_label("Young's modulus [Pa]", fontsize=9)
        bar.ax.yaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())  # powers of ten leave room for the label
    write_figure(figure, out_png)


def _framing(vertices: np.ndarray, poses: list[np.ndarray]) -> tuple[np.ndarray, int]:
    """Intrinsics (3, 3) and picture height [px] that fit the object tightly into every view."""
    reach = np.full(2, 1e-6)
    for pose in poses:
        camera = (vertices - pose[:3, 3]) @ pose[:3, :3]
        reach = np.maximum(reach, 1.12 * np.abs(camera[:, :2] / camera[:, 2:]).max(axis=0))
    focal = 0.5 * SIZE / max(reach[0], reach[1] / 1.5)  # no picture is taller than one and a half times its width
    tall = max(round(2.0 * focal * reach[1]), 48)
    return np.array([[focal, 0.0, 0.5 * (SIZE - 1)], [0.0, focal, 0.5 * (tall - 1)], [0.0, 0.0, 1.0]]), tall
