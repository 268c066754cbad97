"""One picture of a dataset: for each object view its image, depth, touched points and force curves.

Object views, views and touches are those of `vsfsim.data.records`, which calls this module and is not imported here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.core.system.interactive import new_figure
from vsfsim.data.disk import write_figure

ObjectView: TypeAlias = Any
View: TypeAlias = Any
Touch: TypeAlias = Any

def contact_sheet(views: Sequence[ObjectView], out_png: str | Path | None = None, *, title: str = "") -> Any:
    """Draw one row an object view: RGB, depth, where it was touched, and force over travel.

    A touch has the same colour in both panels on the right: a dot at the target with the last 20 mm of the approach,
    and its curve. A touch without contact is a cross without a curve; a frame that did not converge is a black cross.
    For a bubble the sheet also shows pressure over travel, and the picture of the camera inside in the frame of largest
    force, if it is recorded.

    Args:
        views: one or more.
        out_png: the file to write, or None.
        title: above everything.

    Returns:
        The `matplotlib.figure.Figure`.

    Raises:
        DatasetError: there is no view.
    """
    if not views:
        raise DatasetError("contact_sheet: there is no object view to draw; give at least one.")
    import matplotlib

    air = any(touch.pressure is not None for object_view in views for touch in object_view.touches)
    inside = any(touch.inside_rgb is not None for object_view in views for touch in object_view.touches)
    columns = 4 + air + inside
    figure = new_figure(figsize=(3.5 * columns, 3.0 * len(views) + (0.4 if title else 0.0)), dpi=90,
                        layout="constrained", facecolor="white")
    if title:
        figure.suptitle(title, fontsize=11)
    panels = figure.subplots(len(views), columns, squeeze=False)
    for row, object_view in zip(panels, views):
        colours = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, max(len(object_view.touches), 1)))
        window = _window(object_view.view)
        seen = object_view.view
        _image(row[0], seen.rgb, window, f"{object_view.name}  ({object_view.split})")
        depth = _image(row[1], np.where(seen.mask, seen.depth, np.nan), window, "depth [m]", cmap="magma_r")
        row[1].set_facecolor("0.92")
        figure.colorbar(depth, ax=row[1], fraction=0.04, pad=0.01).ax.tick_params(labelsize=7)
        _targets(row[2], object_view, colours, window)
        _curves(row[3], object_view, colours, "normal force [N]", lambda touch: touch.normal_force())
        if air:
            _curves(row[4], object_view, colours, "pressure change [Pa]",
                    lambda touch: touch.pressure - touch.rest_pressure)
        if inside:
            _inside(row[-1], object_view)
    if out_png is not None:
        write_figure(figure, out_png)
    return figure


def _window(view: View) -> tuple[int, int, int, int]:
    """Rows and columns to show: the object and a tenth around it, in panels of about 4:3 so that the rows line up."""
    mask = view.mask if view.mask.any() else np.ones_like(view.mask)
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    tall = 1.15 * max(np.ptp(rows) + 1, 0.75 * (np.ptp(columns) + 1)) + 8
    shown = []
    for places, length, limit in ((rows, tall, len(mask)), (columns, tall / 0.75, mask.shape[1])):
        start = min(max(round(0.5 * (places[0] + places[-1] - length)), 0), max(limit - int(length), 0))
        shown += [start, min(start + int(length), limit)]
    top, bottom, left, right = shown
    return top, bottom, left, right


def _image(axes, pixels: np.ndarray, window: tuple[int, int, int, int], title: str, **options: Any) -> Any:
    """A picture cut to the window."""
    top, bottom, left, right = window
    shown = axes.imshow(pixels, **options)
    axes.set(xlim=(left - 0.5, right - 0.5), ylim=(bottom - 0.5, top - 0.5), xticks=[], yticks=[])
    axes.set_title(title, fontsize=9, loc="left")
    return shown


def _targets(axes, object_view: ObjectView, colours: np.ndarray, window: tuple[int, int, int, int]) -> None:
    faded = 0.65 * object_view.view.rgb.mean(axis=2, keepdims=True) + 0.35 * 255.0
    touched = sum(bool(touch.touched) for touch in object_view.touches)
    _image(axes, np.repeat(faded.astype(np.uint8), 3, axis=2), window,
           f"{len(object_view.touches)} touches, {touched} in contact")
    to_camera = np.linalg.inv(object_view.view.camera_pose)
    for touch, colour in zip(object_view.touches, colours):
        ends = np.stack([touch.target, touch.target - 0.02 * touch.axis])
        camera = ends @ to_camera[:3, :3].T + to_camera[:3, 3]
        pixel = camera @ object_view.view.intrinsics.T
        pixel = pixel[:, :2] / pixel[:, 2:]
        axes.plot(*pixel.T, color=colour, lw=1.2)
        axes.plot(*pixel[0], "o" if touch.touched else "x", color=colour, ms=5,
                  mec="black" if touch.touched else colour, mew=0.6 if touch.touched else 1.5)


def _curves(axes, object_view: ObjectView, colours: np.ndarray, title: str, of: Callable[[Touch], np.ndarray]) -> None:
    for touch, colour in zip(object_view.touches, colours):
        if not touch.touched:
            continue
        # Travel along the press from the first frame; loading and unloading lie over each other if nothing slips.
        travel = 1e3 * (touch.mount_pose[:, :3, 3] - touch.mount_pose[0, :3, 3]) @ touch.axis
        value, good = of(touch), np.asarray(touch.converged, bool)
        # what did not converge is no reading: it is marked on the axis, and does not stretch it
        axes.plot(travel, np.where(good, value, np.nan), ".-", color=colour, lw=1.0, ms=3)
        axes.plot(travel[~good], np.zeros((~good).sum()), "kx", ms=6)
    axes.tick_params(labelsize=7)
    axes.grid(color="0.9")
    axes.set_xlabel("travel along the press [mm]", fontsize=8)
    axes.set_title(title, fontsize=9, loc="left")


def _inside(axes, object_view: ObjectView) -> None:
    """What the camera in the bubble saw in the converged frame of largest force of all touches."""
    axes.set(xticks=[], yticks=[])
    size = [np.where(touch.converged, np.linalg.norm(np.nan_to_num(touch.force), axis=1), -1.0)
            for touch in object_view.touches]
    number = int(np.argmax([values.max(initial=-1.0) for values in size])) if size else 0
    if size and object_view.touches[number].inside_rgb is not None:
        frame = int(np.argmax(size[number]))
        axes.imshow(object_view.touches[number].inside_rgb[frame])
        axes.set_title(f"from inside, touch {number}, frame {frame}", fontsize=9, loc="left")
