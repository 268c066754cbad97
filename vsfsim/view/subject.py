"""What the page shows of one object: a table of plain values that its script reads.

Lengths are metres in the world frame, forces newtons, pressures pascals. Coordinates and moduli are 16-bit numbers
(`quantised`): of an object of 300 mm to 2.3 um, of a modulus over four decades to 0.01 %.
"""

from __future__ import annotations

import base64
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.bench.board.templates import png_uri
from vsfsim.core.shape import ProbeShape, Sphere
from vsfsim.data.records import ObjectView, Touch, Truth, View

if TYPE_CHECKING:
    from vsfsim.generate.effector import Drawing

FILLS = 0.9
"""Radius of an element's ball over the mean distance of its four nearest neighbours: balls of tetrahedra then overlap,
and no gap shows in a cut."""
BEAD = 0.5
"""Distance of the balls along a plant's segment over their radius."""
MOST_BEADS = 40
"""Balls of one segment."""
CLOUD = 20000
"""Points of the visible cloud, which stands for an object whose truth is withheld."""
STEPS = 65535
"""The largest number of 16 bits: a length is kept to the span of its column over this."""


def of_view(shown: ObjectView) -> dict[str, Any]:
    """An object of a dataset: its truth as balls (or the visible cloud where it is withheld), touches and picture."""
    truth, cloud = shown.truth, shown.view.points()
    if truth is not None and len(truth.points):
        body = of_truth(truth)
    else:
        some = cloud[::max(1, -(-len(cloud) // CLOUD))]
        body = of_body(some, None, np.zeros(len(some), int))
    return {"name": shown.name, "about": f"{shown.split}, {len(shown.touches)} touches", **body,
            "touches": [_touch(touch, shown.probe_of(touch)) for touch in shown.touches],
            "picture": _picture(shown.view)}


def of_drawing(name: str, drawing: Drawing) -> dict[str, Any]:
    """The object of a scene, without touches; where only a surface is drawn, the corners of its triangles in grey."""
    corners = drawing.surface.vertices
    body = of_body(corners, None, np.zeros(len(corners), int)) if drawing.truth is None else of_truth(drawing.truth)
    return {"name": name, "about": drawing.lines[0], **body, "touches": [], "picture": None}


def of_truth(truth: Truth) -> dict[str, Any]:
    """The elements of a truth as balls; segments of a plant are rows of balls."""
    if truth.segment_ends is None or truth.radius is None or truth.half_width is None:
        return of_body(truth.points, truth.young_modulus, truth.region, names=truth.region_names)
    thick = np.maximum(truth.radius, truth.half_width)  # of a blade, as thick as it is wide
    return of_body(*beads(truth.segment_ends, truth.young_modulus, truth.region, thick), names=truth.region_names)


def of_body(points: np.ndarray, young_modulus: np.ndarray | None, region: np.ndarray,
            radius: np.ndarray | None = None, *, names: tuple[str, ...] = ()) -> dict[str, Any]:
    """A body as balls.

    Args:
        points: their centres (n, 3) [m].
        young_modulus: at each (n,) [Pa], or None to draw it grey.
        region: of each, an index into ``names`` (n,).
        radius: of each (n,) [m]; None for balls that fill the body.
        names: of the regions.
    """
    if radius is None:
        near = cKDTree(points).query(points, k=min(5, len(points)))[0].reshape(len(points), -1)[:, 1:]
        radius = FILLS * near.mean(axis=1) if near.shape[1] else np.full(len(points), 0.005)
    modulus = None if young_modulus is None else quantised(np.log10(young_modulus)[:, None])
    return {"points": quantised(points), "radius": quantised(radius[:, None]), "log_modulus": modulus,
            "region": base64_of(np.asarray(region).astype(np.uint8)), "regions": list(names)}


def beads(ends: np.ndarray, young_modulus: np.ndarray, region: np.ndarray,
          radius: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Segments (n, 2, 3) [m] with one modulus, region and radius each, as rows of balls: centres, moduli, regions,
    radii."""
    along = ends[:, 1] - ends[:, 0]
    count = np.clip(np.ceil(np.linalg.norm(along, axis=1) / (BEAD * radius)), 1, MOST_BEADS).astype(int)
    of = np.repeat(np.arange(len(ends)), count)
    step = np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)
    centre = ends[of, 0] + ((step + 0.5) / count[of])[:, None] * along[of]
    return centre, young_modulus[of], region[of], radius[of]


def _touch(touch: Touch, probe: ProbeShape) -> dict[str, Any]:
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


def _picture(view: View) -> dict[str, Any]:
    """Colour and depth as PNG. Depth is darker the further away, and clear where there is no object."""
    seen = view.depth[view.mask]
    near, far = (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)
    grey = 235 - np.clip(200 * (view.depth - near) / max(far - near, 1e-9), 0, 200)
    depth = np.stack([np.where(view.mask, grey, 0), np.where(view.mask, 255, 0)], axis=2).astype(np.uint8)
    return {"rgb": png_uri(view.rgb), "depth": png_uri(depth), "near": round(near, 4),
            "far": round(far, 4), "intrinsics": view.intrinsics.tolist(),
            "to_camera": np.linalg.inv(view.camera_pose).tolist()}


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
