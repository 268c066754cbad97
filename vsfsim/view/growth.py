"""What a method makes of an object touch by touch: true and estimated modulus of the body cut open, as a GIF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.bench.method import Action, Reading, Specimen, build_method, find_method, parameters_of
from vsfsim.core.errors import DatasetError, MethodError
from vsfsim.core.system.interactive import new_figure
from vsfsim.data.dataset import Dataset
from vsfsim.data.disk import write_animation
from vsfsim.data.records import ObjectView
from vsfsim.generate.inspect import Progress, draw_view
from vsfsim.sensing.camera import fitting_camera, render
from vsfsim.sensing.colours import of_modulus
from vsfsim.sensing.cut import opened
from vsfsim.sensing.surface import flat_coloured

MOST = 5
"""Touches that are given, at most."""
_SIZE = (920, 640)  # of a view [px], drawn at half that size
_NORMAL = np.array([0.0, -1.0, 0.0])  # of the cut


def growth(folder: str, out: Path, *, method: str, settings: dict[str, Any], device: str = "cpu",
           progress: Progress = lambda done, total, what: None) -> tuple[list[str], dict[str, Any]]:
    """Draw what a method makes of the first test object of a dataset after 0, 1, ... `MOST` of its touches.

    The method learns from the training objects first. It reads the exact normal forces, and runs in this process.

    Args:
        folder: of a dataset of probes on solids.
        out: GIF to write.
        method: its name, or module:attribute; it must have ``stiffness``.
        settings: parameters of its constructor.
        device: Warp device of the ray caster.
        progress: called with (done, in all, what).

    Returns:
        The lines to print, and the same for JSON.

    Raises:
        DatasetError: no training or test object, or no elements to show.
        MethodError: the method is unknown, raises, or estimates no stiffness.
    """
    data = Dataset.open(folder)
    learned, asked = data.names("train"), data.names("test")
    if not learned or not asked:
        raise DatasetError(f"{folder}: --method needs training and test objects; it has {len(learned)} and "
                           f"{len(asked)}. Give [dataset] splits in the scene.")
    factory = find_method(method)
    estimator = build_method(factory, parameters_of(factory, settings))
    if not hasattr(estimator, "stiffness"):
        raise MethodError(f"{method} has no function stiffness(); it estimates no stiffness that could be drawn.")
    progress(0, MOST + 2, f"{method} learns from {len(learned)} objects")
    estimator.meta_fit([Specimen(name, view.view, readings(view)) for name in learned for view in [data.load(name)]])
    shown = data.load(asked[0])
    drawing = draw_view(data, shown)
    if drawing.body is None:
        raise DatasetError(f"{folder}: --method draws elements of a solid, and {shown.name} has none.")
    body, given = drawing.body, readings(shown)[:MOST]
    found = []
    for k in range(len(given) + 1):
        progress(k + 1, MOST + 2, f"{method} adapts to {k} touches")
        estimator.adapt(shown.view, given[:k])
        found.append(np.maximum(estimator.stiffness(body.points[body.tets].mean(axis=1)).mean, 1e-12))
    # a method's unit is its own: one factor for all frames
    factor = float(np.exp(np.median(np.log(body.young_modulus / found[-1]))))
    off = [float(np.exp(np.abs(np.log(factor * one / body.young_modulus)).mean())) for one in found]
    _write(out, shown, body, [factor * one for one in found], off, method, device)
    return ([f"{shown.name}: {method} is off by a factor of {', '.join(f'{v:.2f}' for v in off)} in the mean after 0 "
             f"to {len(given)} touches, scaled by one factor", f"animation: {out}"],
            {"object": shown.name, "method": method, "off_by": off, "picture": str(out)})


def readings(shown: ObjectView) -> tuple[Reading, ...]:
    """The normal forces of an object's touches."""
    return tuple(Reading(Action(touch.time, touch.probe_pose(), touch.axis, shown.probe_of(touch), "normal-force", 1),
                         np.where(touch.converged, touch.normal_force(), np.nan)[:, None], touch.converged)
                 for touch in shown.touches)


def _write(out: Path, shown: ObjectView, body: Any, found: list[np.ndarray], off: list[float], method: str,
           device: str) -> None:
    at, colours = body.hidden(), of_modulus(body.young_modulus)
    surface, shows = opened(body, _NORMAL, at)
    kept = surface.vertices[(surface.vertices - at) @ _NORMAL < 1e-3]
    eye, pose = fitting_camera(kept, kept, *_SIZE, azimuth=-1.2, elevation=0.45)
    places = np.array([touch.target for touch in shown.touches[:len(found) - 1]]).reshape(-1, 3)
    seen = (places - pose[:3, 3]) @ pose[:3, :3] @ eye.T
    frames = []
    for k, one in enumerate(found):
        figure = new_figure(figsize=(9.8, 3.7), dpi=100, facecolor="white", layout="constrained")
        axes = figure.subplots(1, 2)
        for panel, values, title in ((axes[0], body.young_modulus, "true, hidden from the method"),
                                     (axes[1], one, f"estimate of {method} after {k} touch{'es' * (k != 1)}: off by a "
                                                    f"factor of {off[k]:.2f}")):
            rgb = colours.rgb(np.where(shows < 0, np.nan, values[shows]))
            panel.imshow(render(flat_coloured(surface.vertices, surface.triangles, rgb), eye, pose, *_SIZE,
                                device=device, shading=0.45, background=(255, 255, 255)).rgb)
            panel.set_title(title, fontsize=10)
            for number, (x, y, w) in enumerate(seen[:k], 1):
                panel.plot(x / w, y / w, "o", ms=11, mfc="white", mec="#d81b60", mew=1.5)
                panel.annotate(str(number), (x / w, y / w), ha="center", va="center", fontsize=8)
            panel.set_axis_off()
        colours.bar(figure, axes, shrink=0.85, aspect=18)
        frames.append(figure)
    write_animation(out, frames, [1200] * (len(frames) - 1) + [3000])
