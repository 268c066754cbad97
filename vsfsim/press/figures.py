"""The plot of a press against depth, and the picture of its frame of full depth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.tri import Triangulation

from vsfsim.core.system.interactive import new_figure
from vsfsim.data.disk import write_animation, write_figure
from vsfsim.generate.press_result import BodyPanel, MapPanel, PressResult
from vsfsim.sensing.camera import render
from vsfsim.sensing.surface import flat_coloured, with_rigid

DPI = 100
_GIF_DPI = 60
_WORDS = 0.7  # height of title and caption [inch]
_BAR = 0.9  # width of a colour bar with its label [inch]
_MAP = 1.45  # width of a map with its axes over its height
_DOT = 30.0  # area of the largest dot [square points]
_SHADING = 0.55  # of a body that is coloured by values, so that a colour can be found again on the bar


def plot(result: PressResult, title: str, path: str | Path | None = None) -> Figure:
    """Draw the curves of a result against depth, into ``path`` (PNG) if it is given; frames that did not converge are
    crossed out."""
    count = len(result.plot)
    figure = new_figure(figsize=(6.4, 1.2 + 3.0 * count), dpi=130, facecolor="white", layout="tight")
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    depth, bad = 1e3 * result.depth, ~result.converged
    for axes, (label, curves) in zip(panels, result.plot.items(), strict=True):
        for name, values in curves.items():
            axes.plot(depth, values, ".-", ms=5, label=name)
            # there is no value of an equilibrium to show: the cross lies on the axis
            axes.plot(depth[bad], np.nan_to_num(values[bad]), "x", ms=9, color="tab:red")
        if bad.any():
            axes.plot([], [], "x", ms=9, color="tab:red", label="not converged")
        axes.set_ylabel(label)
        axes.legend(frameon=False, fontsize=8, ncols=-(-len(curves) // 4))
        axes.grid(alpha=0.3)
    panels[-1].set_xlabel(result.abscissa)
    panels[0].set_title(f"{title}: {result.model}", fontsize=10)
    if path is not None:
        write_figure(figure, path)
    return figure


def animation(result: PressResult, title: str, path: Path, *, device: str = "cpu",
              progress: Callable[[int, int, str], None] = lambda *_: None) -> None:
    """Write the pictures of all frames as a GIF that repeats, 0.2 s each and 1.2 s at full depth, 256 colours a frame.

    Args:
        result: of the press.
        title: above everything.
        path: GIF to write.
        device: Warp device of the ray caster.
        progress: called with (done, in all, what).

    Raises:
        VsfsimError: the file cannot be written.
    """
    def frame(t: int) -> Figure:
        progress(t, count, "pictures")
        return picture(result, title, frame=t, device=device)

    count = len(result.depth)
    write_animation(path, map(frame, range(count)), [1200 if t == result.deepest else 200 for t in range(count)],
                    dpi=_GIF_DPI)


def picture(result: PressResult, title: str, path: str | Path | None = None, *,
            frame: int | None = None, device: str = "cpu") -> Figure:
    """Draw the panels of a frame, side by side; returns the figure.

    Args:
        result: of the press.
        title: above everything.
        path: PNG to write, or None.
        frame: number of the frame; None for that of full depth.
        device: Warp device of the ray caster.

    Raises:
        VsfsimError: the file cannot be written.
    """
    t = result.deepest if frame is None else frame
    shown = result.panels(t)
    tall = max(panel.size[1] for panel in shown if isinstance(panel, BodyPanel)) / DPI
    bars = [panel.colours if isinstance(panel, BodyPanel) and panel.colours is not None and panel.colours.label
            else None for panel in shown]
    widths = [tall * (_MAP if isinstance(panel, MapPanel) else panel.size[0] / panel.size[1]
                      if isinstance(panel, BodyPanel) else panel.shape[1] / panel.shape[0]) + _BAR * (bar is not None)
              for panel, bar in zip(shown, bars, strict=True)]
    figure = new_figure(figsize=(sum(widths), tall + _WORDS), dpi=DPI, facecolor="white", layout="constrained")
    places = figure.subplots(1, len(shown), squeeze=False, width_ratios=widths)[0]
    for panel, bar, axes in zip(shown, bars, places, strict=True):
        if isinstance(panel, MapPanel):
            _map(axes, panel)
            continue
        axes.imshow(rendered(panel, device) if isinstance(panel, BodyPanel) else panel)
        axes.set_axis_off()
        if bar is not None:
            bar.bar(figure, axes, shrink=0.7)
    mark = f"   {result.marks()[t]}".rstrip()
    head = result.headline if frame is None else (f"depth {1e3 * result.depth[t]:.2f} mm, normal "
                                                  f"force {result.normal_force[t]:.3g} N")
    figure.suptitle(f"{title}: {head}{mark}", x=0.01, ha="left", fontsize=12)
    caption = f"{result.model}; {result.caption}" if result.caption else result.model
    figure.supxlabel(caption, x=0.01, ha="left", fontsize=9, color="0.35")
    if path is not None:
        write_figure(figure, path)
    return figure


def rendered(panel: BodyPanel, device: str) -> np.ndarray:
    """The panel's body and rigid bodies as sRGB (H, W, 3) uint8."""
    surface, shading = panel.surface, 1.0
    if panel.values is not None and panel.colours is not None:
        surface = flat_coloured(surface.vertices, surface.triangles, panel.colours.rgb(panel.values))
        shading = _SHADING
    return render(with_rigid(surface, panel.rigid), *panel.camera, *panel.size, device=device,
                  shading=shading, background=(255, 255, 255)).rgb


def _map(axes: Axes, panel: MapPanel) -> None:
    scale = panel.colours.scale()
    x, y = panel.points.T
    axes.tripcolor(Triangulation(x, y, panel.triangles), panel.values, shading="gouraud",
                    cmap=scale.cmap, norm=scale.norm)
    on = panel.dots > 0.0
    if on.any():
        axes.scatter(x[on], y[on], s=_DOT * panel.dots[on] / panel.dots.max(), color="k", linewidths=0.0)
    axes.set_aspect("equal")
    axes.set_xlabel(panel.labels[0])
    axes.set_ylabel(panel.labels[1])
    panel.colours.bar(axes.figure, axes, fraction=0.04, pad=0.02)
