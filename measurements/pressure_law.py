"""Error of the pressure laws in use against the gas of a sealed bubble: `vsfsim measure pressure-law`.

    sum|f|     SBML eq. 8: dp = sum_i K_i |u_i|, the sum of the sizes of the contact forces; K takes up its unit, so the
               law has a free scale
    F_n / A    openvsf: dp = F_n / A_base, the force along the dome's axis over the area inside the rim

A_base is 7.1827e-3 m^2 for openvsf's mesh of the bubble alone and 6.6019e-3 m^2 for its mesh on the arm
(`references/openvsf_base_area.json`). Both laws get the simulator's true contact forces, so what remains is the law's
own error and not that of a stiffness estimate. The truth is the gas: p V^gamma constant under the membrane's
equilibrium, as the dataset stores it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

import references
from measurements.dense_force import Plan, Spot, simulate
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.bubble import Bubble
from vsfsim.core.dome import Dome
from vsfsim.core.errors import DatasetError
from vsfsim.core.shape import Sphere
from vsfsim.data.dataset import Dataset
from vsfsim.data.records import ObjectView, Touch
from vsfsim.physics.bubble.sensor import build_bubble
from vsfsim.sensing.membrane_fe import SensorError

BASE_AREA = references.load("openvsf_base_area")["bubble_alone"]["area_m2"]
"""Area inside the Punyo's rim [m^2], of openvsf's mesh of the bubble alone; that of the ellipse is 0.2 % larger."""

SEMI_AXIS = Bubble().semi_axes[0]
"""The Punyo's long one [m]."""

CONTACT = 0.05
"""Force [N] from which a frame counts: a third of a real sensor's noise."""

# edges of the bins by distance of the contact's centre from the dome's axis, over the long semi-axis
_RINGS = (0.0, 0.2, 0.4, 1.0)


@dataclass(frozen=True)
class LawReadings:
    """Frames in contact of all touches."""

    change: np.ndarray
    """Change of the chamber's pressure (k,) [Pa]."""
    normal: np.ndarray
    """Force into the dome along its axis (k,) [N]."""
    summed: np.ndarray
    """Sum of the sizes of the nodes' forces (k,) [N]; NaN if the dataset keeps none."""
    distance: np.ndarray
    """Distance of the contact's centre from the dome's axis (k,) [m]; NaN likewise."""
    touch: np.ndarray
    """Number of the touch (k,)."""


@dataclass(frozen=True)
class Law:
    """One law on one set of frames."""

    name: str
    """Of the law."""
    scale: float
    """Pressure per force that it claims [Pa/N]."""
    bias: float
    """Mean error as it stands, over the mean pressure change [-]."""
    best_scale: float
    """Scale that fits these frames best [Pa/N]."""
    scatter: float
    """Standard deviation of the error with the best scale [Pa]."""
    relative: float
    """That over the RMS pressure change [-]."""
    rms: float
    """Error as it stands, RMS [Pa]."""
    frames: int
    """Number of frames [-]."""


def readings(views: Iterable[ObjectView]) -> LawReadings:
    """The frames in contact of all touches of ``views``.

    Raises:
        DatasetError: no touch has a pressure, or no frame is in contact.
    """
    parts: list[tuple[np.ndarray, ...]] = []
    touch_number = count = 0
    for view in views:
        for touch in view.touches:
            count += 1
            if touch.pressure is None or touch.rest_pressure is None:
                continue
            parts.append(_of_touch(touch, touch_number))
            touch_number += 1
    if not parts:
        raise DatasetError(f"pressure law: none of {count} touches has a pressure; the dataset must be made with a "
                           f"bubble, a [sensor] in the scene.")
    out = LawReadings(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if not len(out.change):
        raise DatasetError(f"pressure law: no frame of {touch_number} touches is converged and pushed by more than "
                           f"{CONTACT} N; press deeper.")
    return out


def rim_of_dataset(view: ObjectView) -> tuple[float, float]:
    """Area inside the rim [m^2] and the long semi-axis [m] of the bubble that touched ``view``; a Punyo's where the
    file does not say."""
    if isinstance(view.probe, Dome):
        return view.probe.base_area, float(view.probe.points[:, 0].max())
    return BASE_AREA, SEMI_AXIS


def _of_touch(touch: Touch, number: int) -> tuple[np.ndarray, ...]:
    axis = touch.mount_pose[:, :3, 2]  # out of the dome
    used = touch.converged & (np.linalg.norm(np.nan_to_num(touch.force), axis=1) > CONTACT)
    normal = -np.einsum("ti,ti->t", touch.force, axis)
    summed = distance = np.full(len(used), np.nan)
    if touch.node_force is not None and touch.node_position is not None:
        size = np.linalg.norm(touch.node_force.astype(float), axis=2)
        summed = size.sum(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            centre = np.einsum("tn,tni->ti", size, touch.node_position.astype(float)) / summed[:, None]
        arm = centre - touch.mount_pose[:, :3, 3]
        distance = np.linalg.norm(arm - np.einsum("ti,ti->t", arm, axis)[:, None] * axis, axis=1)
    return ((touch.pressure - touch.rest_pressure)[used], normal[used], summed[used], distance[used],
            np.full(int(used.sum()), number))


LAW_PRESSES: Plan = (
    (Sphere(0.015), tuple(Spot(f"x {1e3 * x:.0f}, y {1e3 * y:.0f} mm", x, y) for x, y in
                          ((0.0, 0.0), (0.010, 0.0), (0.020, 0.0), (0.030, 0.0), (0.0, 0.010), (0.0, 0.020),
                           (-0.015, 0.015), (-0.030, 0.010)))),
)
"""Presses on a rigid ball, all over one half of the dome, for when there is no dataset."""


def rigid_presses(*, nodes: int | None = None, device: str = "cpu", progress: Progress = lambda _: None) -> LawReadings:
    """Frames in contact of a Punyo pressed on a rigid ball at eight places; ``nodes`` of its mesh, None for the
    default."""
    model = build_bubble(Bubble() if nodes is None else Bubble(nodes=nodes))
    parts = []
    for number, press in enumerate(simulate(model, LAW_PRESSES, device=device, progress=progress)):
        total = press.force.sum(axis=1)
        used = np.linalg.norm(total, axis=1) > CONTACT
        size = np.linalg.norm(press.force[used], axis=2)
        centre = np.einsum("tn,tni->ti", size, press.position[used]) / size.sum(axis=1, keepdims=True)
        parts.append((press.pressure[used] - model.pressure, -total[used, 2], size.sum(axis=1),
                      np.linalg.norm(centre[:, :2], axis=1), np.full(int(used.sum()), number)))
    out = LawReadings(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if not len(out.change):
        raise SensorError(f"pressure law: no press on the mesh of {len(model.mesh.points)} nodes found an equilibrium; "
                          f"take another number of nodes.")
    return out


def law(name: str, force: np.ndarray, change: np.ndarray, *, scale: float | None) -> Law:
    """Score dp = scale * force on frames (k,); ``scale`` [Pa/N] None for the best one.

    The best scale minimises the squared error. Scatter is about that line, so it holds nothing that a calibration could
    take away.
    """
    best = float(force @ change / (force @ force))
    used = best if scale is None else scale
    error, left = used * force - change, best * force - change
    size = float(np.sqrt(np.mean(change**2)))
    return Law(name, used, float(error.mean() / change.mean()), best, float(left.std()), float(left.std() / size),
               float(np.sqrt(np.mean(error**2))), len(change))


def judge(found: LawReadings, *, area: float = BASE_AREA, semi_axis: float = SEMI_AXIS) -> dict[str, Any]:
    """All laws on all frames, and by the distance of the contact from the dome's axis.

    Args:
        found: frames.
        area: A_base [m^2].
        semi_axis: the long one [m]; the bins are shares of it.

    Returns:
        "laws": list of `Law` as dictionaries. "rings": list of {"from", "to" [m], "frames", "normal": best scale of
        F_n, "summed": of sum|f| [Pa/N]}. "frames", "touches": numbers of them. "area" [m^2].
    """
    laws = [law("F_n / A_base", found.normal, found.change, scale=1.0 / area),
            law("F_n / A fitted", found.normal, found.change, scale=None)]
    rings: list[dict[str, Any]] = []
    if np.isfinite(found.summed).all():
        laws.append(law("sum|f|, scale fitted", found.summed, found.change, scale=None))
        for low, high in pairwise(_RINGS):
            inside = (found.distance >= low * semi_axis) & (found.distance < high * semi_axis)
            if inside.any():
                rings.append({"from": low * semi_axis, "to": high * semi_axis, "frames": int(inside.sum()),
                              "normal": law("", found.normal[inside], found.change[inside], scale=None).best_scale,
                              "summed": law("", found.summed[inside], found.change[inside], scale=None).best_scale})
    return {"laws": [asdict(x) for x in laws], "rings": rings, "frames": len(found.change),
            "touches": len(np.unique(found.touch)), "area": area}


def report(settings: dict[str, Any], result: dict[str, Any]) -> Measurement:
    """The result of `judge` as a measurement."""
    tables = [Table(f"{result['frames']} frames in contact of {result['touches']} touches; bias and RMS error of each "
                    f"law as it stands, scatter about its best scale", (
        Column("name", "law"), Column("scale", "scale", "Pa/N", form=".1f"), Column("bias", "bias", "1", "%", "+.1f"),
        Column("rms", "RMS", "Pa", form=".1f"), Column("best_scale", "best scale", "Pa/N", form=".1f"),
        Column("scatter", "scatter", "Pa", form=".1f"), Column("relative", "of the change", "1", "%", ".1f")),
        result["laws"], name="laws")]
    if result["rings"]:
        tables.append(Table("best scales by the distance of the contact's centre from the dome's axis", (
            Column("from", "from", "m", "mm", ".0f"), Column("to", "to", "m", "mm", ".0f"),
            Column("frames", "frames", "1"), Column("normal", "of F_n", "Pa/N", form=".1f"),
            Column("summed", "of sum|f|", "Pa/N", form=".1f")), result["rings"], name="rings"))
    notes = [] if result["rings"] else [
        "The dataset keeps no forces on the sensor's nodes (node_force), so sum|f| and the distance of the contact are "
        "not known."]
    return Measurement.of("pressure-law", settings, tables, notes=notes, numbers=result)


def measure(dataset: Dataset | None = None, *, nodes: int = 390, area: float | None = None, plot: Path | None = None,
            progress: Progress = lambda _: None) -> Measurement:
    """The laws on the touches of a dataset, or on eight presses on a rigid ball.

    Args:
        dataset: made with a bubble; None for the presses.
        nodes: of the membrane, without a dataset.
        area: A_base [m^2]; None for the area inside the rim.
        plot: PNG to draw, or None.
        progress: called with what is going on.

    Raises:
        DatasetError: no touch has a pressure, or no frame is in contact.
        SensorError: no press found an equilibrium.
    """
    if dataset is None:
        found, rim = rigid_presses(nodes=nodes, progress=progress), (BASE_AREA, SEMI_AXIS)
    else:
        found, rim = readings(dataset), rim_of_dataset(dataset.load(dataset.names()[0]))
    result = judge(found, area=rim[0] if area is None else area, semi_axis=rim[1])
    if plot is not None:
        draw(found, result, plot)
    return report({"dataset": None if dataset is None else str(dataset.path), "nodes": nodes, "area": result["area"]},
                  result)


def draw(found: LawReadings, result: dict[str, Any], out_png: str | Path) -> None:
    """Each law's pressure against the gas's, coloured by the distance of the contact from the dome's axis."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    laws = result["laws"]
    figure = Figure(figsize=(4.6 * len(laws), 4.2), dpi=100, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    top = 1.05 * float(found.change.max())
    known = np.isfinite(found.distance).all()
    panels = figure.subplots(1, len(laws), squeeze=False)[0]
    for axes, x in zip(panels, laws, strict=True):
        force = found.summed if x["name"].startswith("sum") else found.normal
        shown = axes.scatter(found.change, x["scale"] * force, c=1e3 * found.distance if known else "tab:blue", s=18,
                             cmap="viridis", linewidths=0)
        axes.plot([0, top], [0, top], color="0.4", lw=1)
        axes.set(xlim=(0, top), ylim=(0, max(top, 1.05 * float((x["scale"] * force).max()))),
                 xlabel="pressure change of the gas [Pa]", ylabel="of the law [Pa]")
        axes.set_title(f"{x['name']}: {x['scale']:.0f} Pa/N\nbias {100 * x['bias']:+.1f} %, scatter "
                       f"{100 * x['relative']:.1f} %", fontsize=10)
        axes.grid(color="0.9")
    if known:
        figure.colorbar(shown, ax=panels[-1]).set_label("contact's distance from the axis [mm]", fontsize=9)
    figure.savefig(out_png)
