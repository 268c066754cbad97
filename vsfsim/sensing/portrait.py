"""One picture of an object: from outside, and cut open to show how stiff it is inside."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vsfsim.core.system.interactive import new_figure
from vsfsim.data.disk import write_figure
from vsfsim.sensing.camera import fitting_camera, render
from vsfsim.sensing.colours import Colours, of_modulus
from vsfsim.sensing.cut import Elements, opened
from vsfsim.sensing.surface import Surface, flat_coloured

SIZE = (920, 700)  # of a view [px], drawn at half that size
SIDES = (("from the front", -1.1, (0.0, -1.0, 0.0)), ("from the right", 0.45, (1.0, 0.0, 0.0)))
"""Name of a side, azimuth of its camera [rad], and normal of the plane that cuts the body open towards it."""
_SHADING = 0.45  # little, so that a colour can be found again on the bar
_DPI = 100


def portrait(surface: Surface, body: Elements | None, out_png: str | Path, *, young_modulus: np.ndarray | None = None,
             title: str = "", device: str = "cpu") -> None:
    """Draw an object from two sides, and below it, cut open to the same sides, coloured by Young's modulus.

    Args:
        surface: the object.
        body: its elements; None for one that is coloured without being cut.
        out_png: the file to write.
        young_modulus: of each triangle of the surface (f,) [Pa]; None for no colours, if there are no elements either.
        title: above everything.
        device: as in `vsfsim.sensing.camera.render`.

    Raises:
        RenderError: what `render` refuses.
    """
    values = young_modulus if body is None else body.young_modulus
    rows = 1 if values is None else 2
    figure = new_figure(figsize=(SIZE[0] / _DPI + (rows - 1), rows * (0.5 * SIZE[1] / _DPI + 0.25) + 0.4), dpi=_DPI,
                        facecolor="white", layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False)
    colours = None if values is None else of_modulus(values)
    for column, (side, azimuth, normal) in zip(axes.T, SIDES, strict=True):
        camera = fitting_camera(surface.vertices, surface.vertices, *SIZE, azimuth=azimuth, elevation=0.5)
        column[0].imshow(render(surface, *camera, *SIZE, device=device, background=(255, 255, 255)).rgb)
        column[0].set_title(side, fontsize=9, color="0.25")
        if colours is not None:
            look, place = inside(surface, body, young_modulus, colours, np.array(normal))
            column[1].imshow(render(look, *camera, *SIZE, device=device, shading=_SHADING,
                                    background=(255, 255, 255)).rgb)
            column[1].set_title(place, fontsize=9, color="0.25")
    for panel in axes.ravel():
        panel.set_axis_off()
    figure.suptitle(f"{title}   {' × '.join(f'{1e3 * e:.0f}' for e in np.ptp(surface.vertices, axis=0))} mm".strip(),
                    fontsize=10)
    if colours is not None:
        colours.bar(figure, axes[1, :], shrink=0.85, aspect=16)
    write_figure(figure, out_png)


def inside(surface: Surface, body: Elements | None, young_modulus: np.ndarray | None, colours: Colours,
           normal: np.ndarray) -> tuple[Surface, str]:
    """The object in the colours of its moduli, cut open through what is hidden in it if it has elements, and where."""
    if body is None:
        assert young_modulus is not None
        return flat_coloured(surface.vertices, surface.triangles, colours.rgb(young_modulus), surface.rest_vertices), ""
    at = body.hidden()
    found, shows = opened(body, normal, at)
    axis = int(np.abs(normal).argmax())
    return (flat_coloured(found.vertices, found.triangles,
                          colours.rgb(np.where(shows < 0, np.nan, body.young_modulus[shows]))),
            f"cut open at {'xyz'[axis]} = {1e3 * at[axis]:.0f} mm")
