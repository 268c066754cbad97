"""What the page shows of one object: a table of plain values that its script reads.

Lengths are metres in the world frame, forces newtons, pressures pascals. Coordinates and moduli are 16-bit numbers
(`quantised`): of an object of 300 mm to 2.3 um, of a modulus over four decades to 0.01 %.
"""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from vsfsim.core.errors import VsfsimError
from vsfsim.core.shape import ProbeShape, Sphere
from vsfsim.data.dataset import Dataset
from vsfsim.data.formats.export import png
from vsfsim.data.records import ObjectView, Touch, View
from vsfsim.generate.inspect import draw_view
from vsfsim.sensing.cut import Elements, facing

if TYPE_CHECKING:
    from vsfsim.generate.effector import Drawing
    from vsfsim.generate.press_result import PressResult

_SAME = 1e-6  # between a dataset's elements and those that are built again [m]
_JUMP = 0.02  # in depth between neighbouring pixels that lie on two surfaces [m]

STEPS = 65535
"""The largest number of 16 bits: a length is kept to the span of its column over this."""


def of_view(data: Dataset, shown: ObjectView) -> dict[str, Any]:
    """An object of a dataset: its elements, built again from the recipe (the visible surface where its truth is
    withheld or it cannot be built), touches and picture."""
    told, drawing = f"{shown.split}, {len(shown.touches)} touches", None
    try:
        drawing = draw_view(data, shown) if shown.truth is not None else None
    except VsfsimError:
        pass
    if drawing is not None and drawing.body is not None and shown.truth is not None and not (
            len(drawing.body.tets) == len(shown.truth.points) and np.allclose(
                drawing.body.points[drawing.body.tets].mean(axis=1), shown.truth.points, rtol=0, atol=_SAME)):
        drawing = None
    if drawing is None:
        told += "; the visible surface, because its inside is not known here"
    body = of_visible(shown.view) if drawing is None else of_body(drawing)
    return {"name": shown.name, "about": told, **body,
            "touches": [touch_table(touch, shown.probe_of(touch)) for touch in shown.touches],
            "picture": picture_table(shown.view)}


def of_press(name: str, result: PressResult) -> dict[str, Any]:
    """What was pressed, frame by frame, and the touch.

    Raises:
        VsfsimError: the result has no elements.
    """
    if result.body is None:
        raise VsfsimError("--picture NAME.html draws the elements of a solid, and this press has none; give NAME.png.")
    body, moved, probe, pressure = result.body
    return {"name": name, "about": result.headline, **of_elements(body, result.touch.target),
            "frames": [quantised(body.points + u) for u in moved], "pressure": quantised(pressure.reshape(-1, 1)),
            "touches": [touch_table(result.touch, probe)], "picture": None}


def of_body(drawing: Drawing) -> dict[str, Any]:
    """The elements of a drawing, or its surface where it has none."""
    if drawing.body is not None:
        return of_elements(drawing.body)
    return of_cells(drawing.surface.vertices, drawing.surface.triangles, drawing.young_modulus)


def of_elements(body: Elements, place: np.ndarray | None = None) -> dict[str, Any]:
    """Tetrahedra, opened through a ``place`` (3,) [m], or through what is hidden in them."""
    at = body.hidden() if place is None else place
    axis = 1 if facing(body, at)[1] else 0
    return {**of_cells(body.points, body.tets, body.young_modulus), "open": {"axis": axis, "at": float(at[axis])}}


def of_visible(view: View, values: np.ndarray | None = None, places: np.ndarray | None = None) -> dict[str, Any]:
    """The visible surface: neighbouring pixels joined by triangles, but not across a jump in depth.

    Args:
        view: the picture.
        values: at some places (k,) [Pa], of which a triangle has that of the nearest; None for grey.
        places: (k, 3) [m].
    """
    number = np.cumsum(view.mask).reshape(view.mask.shape) - 1
    seen, deep, four = (sliding_window_view(a, (2, 2)).reshape(-1, 4) for a in (view.mask, view.depth, number))
    four = four[seen.all(axis=1) & (np.ptp(deep, axis=1) < _JUMP)]
    triangles = np.concatenate([four[:, [0, 2, 1]], four[:, [1, 2, 3]]])
    points = view.points()
    if values is None or places is None:
        return of_cells(points, triangles, None)
    return of_cells(points, triangles, values[cKDTree(places).query(points[triangles].mean(axis=1))[1]])


def of_cells(points: np.ndarray, cells: np.ndarray, young_modulus: np.ndarray | None) -> dict[str, Any]:
    """Tetrahedra or triangles that are not cut open.

    Args:
        points: nodes (n, 3) [m].
        cells: their indices (m, 4) or (m, 3).
        young_modulus: of each cell (m,) [Pa], or None to draw it grey.
    """
    return {"points": quantised(points), "cells": base64_of(cells.astype(np.uint32)), "corners": cells.shape[1],
            "log_modulus": None if young_modulus is None else quantised(np.log10(young_modulus)[:, None]),
            "open": {"axis": 1, "at": None}}


def touch_table(touch: Touch, probe: ProbeShape) -> dict[str, Any]:
    """One touch, frame by frame. Of a bubble also the nodes of its skin and the force on each."""
    table = {"probe_radius": probe.radius if isinstance(probe, Sphere) else None,
             "target": rounded(touch.target, 5), "axis": rounded(touch.axis, 4),
             "place": rounded(touch.probe_pose()[:, :3, 3], 5), "force": rounded(touch.force, 4),
             "normal_force": rounded(touch.normal_force(), 4), "touched": bool(touch.touched),
             "travel": rounded((touch.mount_pose[:, :3, 3] - touch.mount_pose[0, :3, 3]) @ touch.axis, 6),
             "converged": [bool(good) for good in touch.converged],
             "pressure": None if touch.pressure is None else rounded(touch.pressure - (touch.rest_pressure or 0.0), 3)}
    if touch.node_position is not None and touch.node_force is not None:
        where, push = (np.nan_to_num(np.asarray(a, float)).reshape(-1, 3)
                       for a in (touch.node_position, touch.node_force))
        table["skin"] = {"nodes": touch.node_position.shape[1], "position": quantised(where), "force": quantised(push)}
    return table


def picture_table(view: View) -> dict[str, Any]:
    """Colour and depth as PNG. Depth is darker the further away, and clear where there is no object."""
    seen = view.depth[view.mask]
    near, far = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)
    grey = 235 - np.clip(200 * (view.depth - near) / max(far - near, 1e-9), 0, 200)
    depth = np.stack([np.where(view.mask, grey, 0), np.where(view.mask, 255, 0)], axis=2).astype(np.uint8)
    return {"rgb": png_uri(view.rgb), "depth": png_uri(depth), "near": round(near, 4),
            "far": round(far, 4), "intrinsics": view.intrinsics.tolist(),
            "to_camera": np.linalg.inv(view.camera_pose).tolist()}


def png_uri(image: np.ndarray) -> str:
    """An image as the address of a PNG that it holds itself; sRGB (H, W, 3), or grey and opacity (H, W, 2), uint8."""
    return "data:image/png;base64," + base64.b64encode(png(image)).decode()


def base64_of(array: np.ndarray) -> str:
    """The bytes of an array in row-major order, numbers of several bytes in little-endian order, as base64."""
    return base64.b64encode(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes()).decode()


def quantised(values: np.ndarray) -> dict[str, Any]:
    """Rows (n, k) as 16-bit numbers: value = low + data / `STEPS` * span, to half a step, column by column.

    Returns:
        ``low`` (k,), ``span`` (k,) and ``data``, the base64 of (n, k) uint16.
    """
    values = np.asarray(values, float)
    low = values.min(axis=0) if len(values) else np.zeros(values.shape[1])
    span = np.maximum(values.max(axis=0) - low, 1e-12) if len(values) else np.ones(values.shape[1])
    return {"low": low.tolist(), "span": span.tolist(),
            "data": base64_of(np.rint((values - low) / span * STEPS).astype(np.uint16))}


def rounded(values: np.ndarray, digits: int) -> Any:
    """Numbers as lists, rounded to ``digits`` decimals; None where there is none (NaN, infinite)."""
    values = np.asarray(values, float)
    if values.ndim:
        return [rounded(part, digits) for part in values]
    return round(float(values), digits) + 0.0 if np.isfinite(values) else None
